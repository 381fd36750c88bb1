"""Elements of rods and others that they may touch: looked up, and loads given back.

All pairs of two members are `(others, own)`, those of a list lie in one row. What is
looked up lies in one table, a row for each element, and what is given back is added to
one: XLA's CPU compiler (0.10.1, with the fusion that `configure_cpu` asks for) aborts
the process where each number is looked up by itself and the program is transposed; a
table of rows it compiles, forward and in reverse, in loops and under `vmap`.
"""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.parts import Seen, mapped
from jaxrod.systems.strands import Strands

Tree = TypeVar("Tree")


@pytree
class Elements:
    """Elements of one member at a moment; all of one shape."""

    first: Vec3
    """First nodes [m]."""
    edge: Vec3
    """From there to the next [m]."""
    radii: Array
    """Radii [m]."""
    follows: Array
    """One where another element follows, on this rod or one tied to it, or zero [1]."""
    first_velocity: Vec3 | None = None
    """Of the first nodes [m/s]; `None` where nothing is damped."""
    velocity_change: Vec3 | None = None
    """From there to the next [m/s]."""
    spin: Vec3 | None = None
    """Angular velocities, world frame [rad/s]; `None` without friction."""
    rods: Array | None = None
    """Number of the rod of each; `None` where it does not matter."""
    starts: Array | None = None
    """Rest arc length where each begins [m]."""
    rest_lengths: Array | None = None
    """Rest lengths [m]."""
    first_radii: Array | None = None
    """Radius at the first node of each; `None` where points do not matter [m]."""
    first_lengths: Array | None = None
    """Rest length that the contact point there stands for [m]."""
    last: Array | None = None
    """One where an element is the last of its rod, or zero [1]."""

    @property
    def ends(self) -> Array:
        """Rest arc length where each ends [m]."""
        assert self.starts is not None and self.rest_lengths is not None
        return self.starts + self.rest_lengths


def elements_at(
    strand: Strands,
    seen: Seen,
    *,
    moves: bool = False,
    spins: bool = False,
    placed: bool = False,
    dotted: bool = False,
) -> Elements:
    """The elements of a member.

    Args:
        strand: Its constants.
        seen: Where it is.
        moves: Whether velocities are needed.
        spins: Whether angular velocities are.
        placed: Whether places along the rod are.
        dotted: Whether contact points are, and so places.
    """
    first = mapped(strand.firsts, seen.motion.position)
    following = mapped(strand.nexts, seen.motion.position)
    velocity = change = None
    if moves:
        velocity = mapped(strand.firsts, seen.motion.velocity)
        later = mapped(strand.nexts, seen.motion.velocity)
        change = vectors.subtract(later, velocity)
    dtype, placed = strand.radii.dtype, placed or dotted
    return Elements(
        first=first,
        edge=vectors.subtract(following, first),
        radii=strand.radii,
        follows=jnp.asarray(~strand.is_end, dtype),
        first_velocity=velocity,
        velocity_change=change,
        spin=seen.angular_velocities if spins else None,
        rods=jnp.asarray(strand.segment_rods, dtype) if placed else None,
        starts=strand.starts if placed else None,
        rest_lengths=strand.rest_lengths if placed else None,
        first_radii=strand.first_radii if dotted else None,
        first_lengths=strand.first_lengths if dotted else None,
        last=jnp.asarray(strand.is_last, dtype) if dotted else None,
    )


def beside(tree: Tree) -> Tree:
    """Fields of elements along the fastest axis, to meet others."""
    return jax.tree.map(lambda leaf: leaf[None, :], tree)


def upright(tree: Tree) -> Tree:
    """Fields of all elements along the axis before."""
    return jax.tree.map(lambda leaf: leaf[:, None], tree)


def lifted(tree: Tree) -> Tree:
    """Fields of pairs with an axis for points on them before the others."""
    return jax.tree.map(lambda leaf: leaf[None], tree)


def looked_up(tree: Tree, index: Int[Array, "..."]) -> Tree:
    """Fields of elements, for those that an index names."""
    return of_table(table_of(tree)[index], tree)


def table_of(tree: Any) -> Array:
    """Fields as one table, a row for each element."""
    return jnp.stack(jax.tree.leaves(tree), axis=-1)


def of_table(rows: Array, like: Tree) -> Tree:
    """Fields of a tree like another, from rows of a table."""
    leaves, structure = jax.tree.flatten(like)
    return jax.tree.unflatten(structure, [rows[..., k] for k in range(len(leaves))])


def given_back(tree: Tree, index: Int[Array, "..."], size: int) -> Tree:
    """What was worked out for those that an index names, added up on the elements."""
    rows = table_of(tree)
    total = jnp.zeros((size, rows.shape[-1]), rows.dtype).at[index].add(rows)
    return of_table(total, tree)


@pytree
class IndexList:
    """Pairs of elements, of one member and of another."""

    own: Int[Array, " pairs"]
    """Numbers of the ones, in order."""
    other: Int[Array, " pairs"]
    """Numbers of the others."""
    there: Bool[Array, " pairs"]
    """Which entries are taken."""


@pytree
class Pairs:
    """Elements of one member and others that they may touch."""

    own: Elements
    """Of the one, `(1, own)`, or from a list, `(pairs,)`."""
    other: Elements
    """Of the other, `(others, 1)`, or from a list, `(pairs,)`."""
    listed: IndexList | None = None
    """The list; `None`: all pairs."""

    @classmethod
    def of(cls, own: Elements, other: Elements, listed: IndexList | None) -> Pairs:
        """All pairs of two rows of elements, or those on a list."""
        if listed is None:
            return cls(beside(own), upright(other))
        return cls(looked_up(own, listed.own), looked_up(other, listed.other), listed)

    def on_own(self, tree: Tree, size: int) -> Tree:
        """Sums for the one, which has so many elements."""
        if self.listed is None:
            return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), tree)
        return given_back(tree, self.listed.own, size)

    def on_other(self, tree: Tree, size: int) -> Tree:
        """Sums for the other, which has so many elements."""
        if self.listed is None:
            return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=1), tree)
        return given_back(tree, self.listed.other, size)
