"""Elements of rods that may touch: gather of elements, scatter of loads.

Gather reads from one table with a row for each element, and scatter adds to such a
table. The reason is XLA's CPU compiler (0.10.1, with the fusion that `configure_cpu`
asks for): it aborts the process if each number is gathered separately and the program
is transposed. It compiles a table of rows, forward and in reverse, in loops and under
`vmap`.
"""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.contact.rod_segments import RodSegments
from jaxrod.systems.members.parts import Seen, mapped

Tree = TypeVar("Tree")


@pytree
class Elements:
    """Elements of one member at one moment; all fields have one shape."""

    first: Vec3
    """Positions of the first nodes [m]."""
    edge: Vec3
    """Vectors from the first nodes to the next [m]."""
    radii: Array
    """Radii [m]."""
    follows: Array
    """Flag: 1 where another element follows on this rod or a tied one, else 0 [1]."""
    first_velocity: Vec3 | None = None
    """Velocities of the first nodes [m/s]; `None` if they are not needed."""
    velocity_change: Vec3 | None = None
    """Velocities of the next nodes minus those of the first [m/s]."""
    first_spin: Vec3 | None = None
    """Angular velocities at the first nodes, world frame [rad/s]; `None` without
    friction."""
    spin_change: Vec3 | None = None
    """Angular velocities at the next nodes minus those at the first [rad/s]."""
    spin: Vec3 | None = None
    """Angular velocities [rad/s]; `None` without contact points or friction."""
    rods: Array | None = None
    """Number of each element's rod; `None` if it is not needed."""
    starts: Array | None = None
    """Rest arc length at the start of each element [m]."""
    rest_lengths: Array | None = None
    """Rest lengths [m]."""
    first_radii: Array | None = None
    """Radius at the first node of each element [m]; `None` without contact points."""
    first_lengths: Array | None = None
    """Rest length of the contact point at the first node [m]."""
    last: Array | None = None
    """Flag: 1 where an element is the last of its rod, else 0 [1]."""
    bulges: tuple[Vec3, Vec3] | None = None
    """Tangents of a smooth axis minus the edge, at the first node and at the next [m];
    `None` for straight elements."""
    velocity_bulges: tuple[Vec3, Vec3] | None = None
    """Rates of the bulges [m/s]."""

    @property
    def ends(self) -> Array:
        """Rest arc length at the end of each element [m]."""
        assert self.starts is not None and self.rest_lengths is not None
        return self.starts + self.rest_lengths

    def on_axis(self, fraction: Array) -> Vec3:
        """Vector from the first node to a place on the axis [m]."""
        return _on_cubic(self.edge, self.bulges, fraction)

    def velocity_at(self, place: Array) -> Vec3:
        """Velocity of a place on the axis [m/s]."""
        assert self.first_velocity is not None and self.velocity_change is not None
        change = _on_cubic(self.velocity_change, self.velocity_bulges, place)
        return vectors.add(self.first_velocity, change)

    def spin_at(self, place: Array) -> Vec3:
        """Angular velocity at a place, interpolated between the nodes [rad/s].

        So it is the same for two elements at the node between them, and terms that are
        counted twice there cancel.
        """
        assert self.first_spin is not None and self.spin_change is not None
        return vectors.add(self.first_spin, vectors.scale(place, self.spin_change))

    def tangent(self, fraction: Array) -> Vec3:
        """Derivative of the place on the axis by the fraction [m]."""
        if self.bulges is None:
            return self.edge
        first, second = self.bulges
        a, b = (1 - fraction) * (1 - 3 * fraction), fraction * (3 * fraction - 2)
        return _combined(self.edge, (a, first), (b, second))

    def bend(self, fraction: Array) -> Vec3:
        """Derivative of the tangent by the fraction, for smooth axes [m]."""
        assert self.bulges is not None
        first, second = self.bulges
        a, b = 6 * fraction - 4, 6 * fraction - 2
        x, y, z = (a * one + b * two for one, two in zip(first, second, strict=True))
        return x, y, z


def bulge_shares(fraction: Array) -> tuple[Array, Array]:
    """Factors of both bulges at a place on a smooth axis [1]."""
    rest = 1 - fraction
    return fraction * rest * rest, -fraction * fraction * rest


def farthest_from_chord(bulges: tuple[Vec3, Vec3]) -> Array:
    """Upper bound of the distance of smooth axes from their chords [m]."""
    first, second = (jnp.sqrt(vectors.dot(bulge, bulge)) for bulge in bulges)
    return 4 / 27 * (first + second)


def _on_cubic(edge: Vec3, bulges: tuple[Vec3, Vec3] | None, fraction: Array) -> Vec3:
    straight = vectors.scale(fraction, edge)
    if bulges is None:
        return straight
    a, b = bulge_shares(fraction)
    return _combined(straight, (a, bulges[0]), (b, bulges[1]))


def _combined(vector: Vec3, *terms: tuple[Array, Vec3]) -> Vec3:
    for factor, more in terms:
        vector = vectors.add(vector, vectors.scale(factor, more))
    return vector


def elements_at(
    segments: RodSegments,
    seen: Seen,
    *,
    moves: bool = False,
    spins: bool = False,
    placed: bool = False,
    has_contact_points: bool = False,
    smooth: bool = False,
) -> Elements:
    """Elements of a member.

    Args:
        segments: Segments and points of the member.
        seen: The member at one moment.
        moves: Whether velocities are needed.
        spins: Whether angular velocities are needed.
        placed: Whether arc lengths along the rod are needed.
        has_contact_points: Whether contact points, and so arc lengths, are needed.
        smooth: Whether elements are pieces of a smooth axis.
    """
    first, edge, bulges = _pieces(segments, seen.motion.position, smooth=smooth)
    velocity = change = velocity_bulges = None
    if moves:
        velocity, change, velocity_bulges = _pieces(
            segments, seen.motion.velocity, smooth=smooth
        )
    first_spin = spin_change = None
    if spins:
        nodes = mapped(segments.at_nodes, seen.angular_velocities)
        first_spin, spin_change, _ = _pieces(segments, nodes, smooth=False)
    dtype, placed = segments.radii.dtype, placed or has_contact_points
    return Elements(
        first=first,
        edge=edge,
        radii=segments.radii,
        follows=jnp.asarray(~segments.is_end, dtype),
        first_velocity=velocity,
        velocity_change=change,
        first_spin=first_spin,
        spin_change=spin_change,
        spin=seen.angular_velocities if spins and has_contact_points else None,
        rods=jnp.asarray(segments.segment_rods, dtype) if placed else None,
        starts=segments.starts if placed else None,
        rest_lengths=segments.rest_lengths if placed else None,
        first_radii=segments.first_radii if has_contact_points else None,
        first_lengths=segments.first_lengths if has_contact_points else None,
        last=jnp.asarray(segments.is_last, dtype) if has_contact_points else None,
        bulges=bulges,
        velocity_bulges=velocity_bulges,
    )


def _pieces(
    segments: RodSegments, nodes: Vec3, *, smooth: bool
) -> tuple[Vec3, Vec3, tuple[Vec3, Vec3] | None]:
    """A field at first nodes, its change to the next nodes, and its bulges."""
    tangents: Vec3 | None = None
    if smooth:
        (x, p), (y, q), (z, r) = (segments.smooth(component) for component in nodes)
        nodes, tangents = (x, y, z), (p, q, r)
    first = mapped(segments.firsts, nodes)
    edge = vectors.subtract(mapped(segments.nexts, nodes), first)
    if tangents is None:
        return first, edge, None
    bulges = (
        vectors.subtract(mapped(segments.firsts, tangents), edge),
        vectors.subtract(mapped(segments.nexts, tangents), edge),
    )
    return first, edge, bulges


def row_vector(tree: Tree) -> Tree:
    """Fields along the last of two axes."""
    return jax.tree.map(lambda leaf: leaf[None, :], tree)


def column_vector(tree: Tree) -> Tree:
    """Fields along the first of two axes."""
    return jax.tree.map(lambda leaf: leaf[:, None], tree)


def gather(tree: Tree, index: Int[Array, "..."]) -> Tree:
    """Fields of elements at some indices."""
    return unpack(pack(tree)[index], tree)


def pack(tree: Any) -> Array:
    """Fields as one table with a row for each element."""
    return jnp.stack(jax.tree.leaves(tree), axis=-1)


def unpack(rows: Array, like: Tree) -> Tree:
    """Tree of fields with the structure of another, from rows of a table."""
    leaves, structure = jax.tree.flatten(like)
    return jax.tree.unflatten(structure, [rows[..., k] for k in range(len(leaves))])


def scatter_add(tree: Tree, index: Int[Array, "..."], size: int) -> Tree:
    """Fields of pairs, summed on the elements at some indices."""
    rows = pack(tree)
    total = jnp.zeros((size, rows.shape[-1]), rows.dtype).at[index].add(rows)
    return unpack(total, tree)


@pytree
class NeighbourList:
    """List of pairs of elements of two members."""

    own: Int[Array, " pairs"]
    """Numbers of the first elements."""
    other: Int[Array, " pairs"]
    """Numbers of the second elements."""
    there: Bool[Array, " pairs"]
    """Mask of the entries in use."""
