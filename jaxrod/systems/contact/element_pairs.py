"""Pairs of elements of rods that may touch: gather of elements, sums, scatter of loads.

Gather reads rows of one table that has a row for each element, and scatter adds to the
rows of such a table. The reason is XLA's CPU compiler (0.10.1, with the fusion that
`configure_cpu` asks for): it aborts the process if each field is gathered separately
and the program is transposed. It compiles a table of rows, forward and in reverse, in
loops and under `vmap`.

Sums are over all pairs, or over a neighbour list. All pairs form a matrix
`(second elements, first elements)`, whose sums along rows and columns need neither
gather nor scatter. A list gathers elements and scatters loads, and is faster where most
pairs are far apart. Laws compute both kinds of pairs with the same functions.

A list has unused entries, all behind those in use. It is processed block by block, and
blocks without entries in use are skipped, so the cost of a step depends on the number
of entries in use, not on the length of the list. The number of blocks is static, and
each block is a branch of `lax.cond`, so that sums can be differentiated in reverse
mode; under `jax.vmap` both branches are computed. There are few blocks, since in
reverse mode each goes through all elements.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.lanes.choice import lanes_wanted
from jaxrod.structure import pytree
from jaxrod.systems.contact.rod_segments import RodSegments
from jaxrod.systems.coupling import Seen

Tree = TypeVar("Tree")


@pytree
class Elements:
    """Elements of one member at one moment; all arrays have the same shape."""

    first: Vec3
    """Positions of the axes at the first nodes [m]."""
    edge: Vec3
    """Vectors from the first nodes to the second nodes [m]."""
    radii: Array
    """Radii of the elements [m]."""
    follows: Array
    """Flag: 1 where another element follows on this rod or a tied one, else 0 [1]."""
    first_velocity: Vec3 | None = None
    """Velocities of the first nodes [m/s]; `None` if they are not needed."""
    velocity_change: Vec3 | None = None
    """Velocities of the second nodes minus those of the first [m/s]; `None` if they are
    not needed."""
    first_spin: Vec3 | None = None
    """Angular velocities at the first nodes, world frame [rad/s]; `None` without
    friction."""
    spin_change: Vec3 | None = None
    """Angular velocities at the second nodes minus those at the first [rad/s]; `None`
    without friction."""
    spin: Vec3 | None = None
    """Angular velocities of the elements, world frame [rad/s]; `None` without contact
    points or friction."""
    rods: Array | None = None
    """Index of the rod that each element belongs to; `None` if it is not needed."""
    starts: Array | None = None
    """Rest arc length from the start of its rod to each element [m]; `None` if it is
    not needed."""
    rest_lengths: Array | None = None
    """Rest lengths of the elements [m]; `None` if they are not needed."""
    first_radii: Array | None = None
    """Radius at the first node of each element [m]; `None` without contact points."""
    first_lengths: Array | None = None
    """Rest length that the contact point at the first node represents [m]; `None`
    without contact points."""
    last: Array | None = None
    """Flag: 1 where an element is the last of its rod, else 0 [1]; `None` without
    contact points."""
    bulges: tuple[Vec3, Vec3] | None = None
    """Tangents of a smooth axis minus the edge, at the first and at the second node
    [m]; `None` for straight elements."""
    velocity_bulges: tuple[Vec3, Vec3] | None = None
    """Time derivatives of `bulges` [m/s]; `None` for straight elements, or if
    velocities are not needed."""

    @property
    def ends(self) -> Array:
        """Rest arc length from the start of its rod to the end of each element [m]."""
        assert self.starts is not None and self.rest_lengths is not None
        return self.starts + self.rest_lengths

    def on_axis(self, fraction: Array) -> Vec3:
        """Vector from the first node to the point at a fraction along the axis [m]."""
        return _on_cubic(self.edge, self.bulges, fraction)

    def velocity_at(self, place: Array) -> Vec3:
        """Velocity of the point at a fraction along the axis [m/s]."""
        assert self.first_velocity is not None and self.velocity_change is not None
        change = _on_cubic(self.velocity_change, self.velocity_bulges, place)
        return vectors.add(self.first_velocity, change)

    def spin_at(self, place: Array) -> Vec3:
        """Angular velocity at a fraction along the axis, world frame [rad/s].

        It is interpolated between the nodes, so two elements agree at the node between
        them, and terms that are counted twice there cancel.
        """
        assert self.first_spin is not None and self.spin_change is not None
        return vectors.add(self.first_spin, vectors.scale(place, self.spin_change))

    def tangent(self, fraction: Array) -> Vec3:
        """Derivative of the point on the axis with respect to the fraction [m]."""
        if self.bulges is None:
            return self.edge
        first, second = self.bulges
        a, b = (1 - fraction) * (1 - 3 * fraction), fraction * (3 * fraction - 2)
        return _combined(self.edge, (a, first), (b, second))

    def bend(self, fraction: Array) -> Vec3:
        """Second derivative of points on the axis with respect to the fraction [m].

        The axis must be smooth.
        """
        assert self.bulges is not None
        first, second = self.bulges
        a, b = 6 * fraction - 4, 6 * fraction - 2
        x, y, z = (a * one + b * two for one, two in zip(first, second, strict=True))
        return x, y, z


@pytree
class Bounds:
    """Straight elements, each with a distance within which neighbours are searched."""

    elements: Elements
    """Straight elements, with their arc lengths along rods where these matter."""
    reach: Float[Array, " elements"]
    """Distance from the axis that includes the surface, the onset of contact and half
    the skin [m]."""
    numbers: Float[Array, " elements"]
    """Indices of the elements in their member."""

    @property
    def middle(self) -> Vec3:
        """Midpoints of the elements [m]."""
        return vectors.add(self.elements.first, vectors.scale(0.5, self.elements.edge))


def bulge_shares(fraction: Array) -> tuple[Array, Array]:
    """Hermite weights s (1 - s)^2 and -s^2 (1 - s) of the bulges at both nodes [1]."""
    rest = 1 - fraction
    return fraction * rest * rest, -fraction * fraction * rest


def farthest_from_chord(bulges: tuple[Vec3, Vec3]) -> Array:
    """Upper bound of the distance of smooth axes from their chords [m].

    It is 4/27 (|b1| + |b2|), with the bulges b1 and b2 at both nodes.
    """
    first, second = (jnp.sqrt(vectors.dot(bulge, bulge)) for bulge in bulges)
    return 4 / 27 * (first + second)


def farthest_along(bulges: tuple[Vec3, Vec3], way: Vec3) -> Array:
    """Upper bound of products of a vector with the steps from chords to smooth axes.

    It is 4/27 (max(b1 . w, 0) + max(-b2 . w, 0)), with the bulges b1 and b2 at both
    nodes and the vector w, `way`.
    """
    first, second = (vectors.dot(bulge, way) for bulge in bulges)
    return 4 / 27 * (jnp.maximum(first, 0) + jnp.maximum(-second, 0))


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
    """Elements of a member at one moment, with the fields that are needed.

    Args:
        segments: Segments and contact points of the member.
        seen: The member at one moment.
        moves: Whether velocities are needed.
        spins: Whether angular velocities are needed.
        placed: Whether rods and arc lengths along them are needed.
        has_contact_points: Whether contact points, and so arc lengths, are needed.
        smooth: Whether axes of elements are smooth curves instead of straight segments.
    """
    first, edge, bulges = _pieces(segments, seen.motion.position, smooth=smooth)
    velocity = change = velocity_bulges = None
    if moves:
        velocity, change, velocity_bulges = _pieces(
            segments, seen.motion.velocity, smooth=smooth
        )
    first_spin = spin_change = None
    if spins:
        nodes = vectors.mapped(segments.at_nodes, seen.angular_velocities)
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
    """Nodal field at first nodes, its change to second nodes, and bulges.

    With `smooth` the field is smoothed first (`smooth_nodes`), and the bulges are the
    tangents at both nodes minus the change. Without it they are `None`.
    """
    tangents: Vec3 | None = None
    if smooth:
        (x, p), (y, q), (z, r) = (segments.smooth(component) for component in nodes)
        nodes, tangents = (x, y, z), (p, q, r)
    first = vectors.mapped(segments.firsts, nodes)
    edge = vectors.subtract(vectors.mapped(segments.nexts, nodes), first)
    if tangents is None:
        return first, edge, None
    bulges = (
        vectors.subtract(vectors.mapped(segments.firsts, tangents), edge),
        vectors.subtract(vectors.mapped(segments.nexts, tangents), edge),
    )
    return first, edge, bulges


def row_vector(tree: Tree) -> Tree:
    """Each array `(n,)` of a tree, reshaped to `(1, n)`."""
    return jax.tree.map(lambda leaf: leaf[None, :], tree)


def column_vector(tree: Tree) -> Tree:
    """Each array `(n,)` of a tree, reshaped to `(n, 1)`."""
    return jax.tree.map(lambda leaf: leaf[:, None], tree)


def gather(tree: Tree, index: Int[Array, "..."]) -> Tree:
    """Entries of every array of a tree at the given indices."""
    return unpack(pack(tree)[index], tree)


def pack(tree: Any) -> Array:
    """Arrays of a tree, stacked to one table with a row for each element."""
    return jnp.stack(jax.tree.leaves(tree), axis=-1)


def unpack(rows: Array, like: Tree) -> Tree:
    """Tree of arrays with the structure of `like`, from the rows of a table."""
    leaves, structure = jax.tree.flatten(like)
    return jax.tree.unflatten(structure, [rows[..., k] for k in range(len(leaves))])


def scatter_add(tree: Tree, index: Int[Array, "..."], size: int) -> Tree:
    """Sums pair values over the pairs of each of `size` elements.

    `index` gives the element of each pair.
    """
    rows = pack(tree)
    total = jnp.zeros((size, rows.shape[-1]), rows.dtype).at[index].add(rows)
    return unpack(total, tree)


@pytree
class NeighbourList:
    """List of pairs of elements of two members that may touch."""

    own: Int[Array, " pairs"]
    """Index of the first element of each pair, in the first member."""
    other: Int[Array, " pairs"]
    """Index of the second element of each pair, in the second member."""
    there: Bool[Array, " pairs"]
    """Mask: true for entries in use."""


LEAST = 1024
"""Smallest number of list entries in a block; a shorter list is one block."""
BLOCKS = 32
"""Largest number of blocks that a list is split into."""


def sums_over_all(on_own: Any, on_other: Any) -> tuple[Any, Any]:
    """Sums pair values over all pairs, on each first and on each second element.

    Args:
        on_own: Values that pairs add to their first elements, arrays `(second elements,
            first elements)`.
        on_other: Values that pairs add to their second elements, of the same shape.
    """
    return (
        jax.tree.map(lambda field: jnp.sum(field, axis=0), on_own),
        jax.tree.map(lambda field: jnp.sum(field, axis=1), on_other),
    )


def sums_over_list(
    work: Callable[[Elements, Elements, Array], tuple[Array, tuple[Any, Any]]],
    own: Elements,
    other: Elements,
    listed: NeighbourList,
) -> tuple[Any, Any]:
    """Sums pair values over listed pairs, on each first and on each second element.

    Args:
        work: Function from first elements, second elements and the mask of entries in
            use to the mask of pairs with values, and pair values for the first elements
            and for the second.
        own: All elements of the first member.
        other: All elements of the second member.
        listed: Pairs of elements to sum over.
    """
    entries = listed.there.shape[0]
    block = max(LEAST, -(-entries // BLOCKS))
    tables = pack(own), pack(other)
    sizes = own.radii.shape[0], other.radii.shape[0]

    def worked(some: NeighbourList) -> tuple[Any, Any]:
        one = unpack(tables[0][some.own], own)
        two = unpack(tables[1][some.other], other)
        return where(*work(one, two, some.there))

    if entries <= LEAST or lanes_wanted():
        on_own, on_other = worked(listed)
        return (
            scatter_add(on_own, listed.own, sizes[0]),
            scatter_add(on_other, listed.other, sizes[1]),
        )

    def cut(number: Array) -> NeighbourList:
        # The last block begins early, so that it ends with the list. Entries that were
        # already in the block before are left out.
        due = number * block
        begin = jnp.minimum(due, entries - block)
        some: NeighbourList = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice(leaf, (begin,), (block,)), listed
        )
        fresh = begin + jnp.arange(block, dtype=begin.dtype) >= due
        return NeighbourList(some.own, some.other, some.there & fresh)

    def step(total: tuple[Array, Array], number: Array) -> tuple[Any, None]:
        def more(total: tuple[Array, Array]) -> tuple[Array, Array]:
            some = cut(number)
            on_own, on_other = worked(some)
            return (
                _with_rows(total[0], some.own, pack(on_own)),
                _with_rows(total[1], some.other, pack(on_other)),
            )

        holds = jnp.any(cut(number).there)
        return jax.lax.cond(holds, more, lambda total: total, total), None

    number = jnp.zeros((), jnp.int32)
    like = jax.eval_shape(lambda number: worked(cut(number)), number)
    none = [
        jnp.zeros((size, len(jax.tree.leaves(tree))), own.radii.dtype)
        for size, tree in zip(sizes, like, strict=True)
    ]
    numbers = jnp.arange(-(-entries // block), dtype=jnp.int32)
    on_own, on_other = jax.lax.scan(step, (none[0], none[1]), numbers)[0]
    return unpack(on_own, like[0]), unpack(on_other, like[1])


def where(there: Array, tree: Any) -> Any:
    """Copy of a tree of pair values, with zeros where the mask `there` is false."""
    return jax.tree.map(lambda field: jnp.where(there, field, 0), tree)


@jax.custom_jvp
def _with_rows(total: Array, index: Array, rows: Array) -> Array:
    """Adds rows to a table at given row indices: `total.at[index].add(rows)`.

    Its derivative uses a copy of the indices: XLA's CPU compiler (0.10.1, with the
    fusion that `configure_cpu` asks for) merges two such sums over the same indices
    into one kernel and aborts the process.
    """
    return total.at[index].add(rows)


@_with_rows.defjvp
def _with_rows_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    total, index, rows = primals
    change, _, changes = tangents
    again = jnp.clip(index, 0, total.shape[0] - 1)
    return _with_rows(total, index, rows), change.at[again].add(changes)
