"""Segments of a member's rods in one row, and their contact points in another.

A segment is an element, from its first node to its second. Every segment has equally
many contact points, the first of them at its first node; the last node of a rod is one
more. Each point represents a part of the rod's rest length (trapezoidal rule). The
layout is regular, so rows are split and joined by reshaping, without indices.

Contact of rods with rods sums over segments and subtracts the nodes between them
(inclusion-exclusion), so that each contact counts once. Where ends of rods are tied, a
node lies between segments of different rods. So all nodes but one of a group of tied
nodes are also subtracted. Only the last node of a rod can be subtracted, which is
enough for rods welded end to end and for closed rods. A free end has an end face in
contact; an end that is tied to another node has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.ends import Ends, ends_of
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.smooth_axes import from_smooth_nodes, smooth_nodes
from jaxrod.systems.coupling import AllParts, Parts, Seen, TiedPair
from jaxrod.validation import is_traced


@pytree
class RodSegments:
    """Constants of the segments and contact points of a member's rods."""

    lengths: Array
    """Rest length that each contact point represents: its quadrature weight [m]."""
    point_radii: Array
    """Radius of the rod at each contact point [m]."""
    places: Array
    """Rest arc length from the start of its rod to each contact point [m]."""
    radii: Array
    """Radius of each segment [m]."""
    starts: Array
    """Rest arc length from the start of its rod to each segment's first node [m]."""
    rest_lengths: Array
    """Rest length of each segment [m]."""
    count: int = static()
    """Number of rods."""
    per_element: int = static()
    """Number of contact points per element."""
    continued: tuple[int, ...] = static(default=())
    """Indices of the last segments of rods that continue in another rod."""
    closed: tuple[int, ...] = static(default=())
    """Indices of the rods whose last node is tied to their first node."""

    @property
    def n_elements(self) -> int:
        """Number of elements of each rod."""
        return self.radii.shape[0] // self.count

    @property
    def segment_rods(self) -> np.ndarray:
        """Index of the rod that each segment belongs to."""
        return np.repeat(np.arange(self.count), self.n_elements)

    @property
    def point_rods(self) -> np.ndarray:
        """Index of the rod that each contact point belongs to."""
        return np.repeat(np.arange(self.count), self.n_elements * self.per_element + 1)

    @property
    def first_radii(self) -> Array:
        """Radius at the first node of each segment [m]."""
        return self._rods(self.point_radii)[:, : -1 : self.per_element].reshape(-1)

    @property
    def first_lengths(self) -> Array:
        """Rest length that the point at each segment's first node represents [m]."""
        return self._rods(self.lengths)[:, : -1 : self.per_element].reshape(-1)

    @property
    def node_places(self) -> Array:
        """Rest arc length from the start of its rod to each node [m]."""
        return self._rods(self.places)[:, :: self.per_element].reshape(-1)

    @property
    def is_last(self) -> np.ndarray:
        """Whether each segment is the last of its rod."""
        return np.tile(np.arange(self.n_elements) == self.n_elements - 1, self.count)

    @property
    def is_end(self) -> np.ndarray:
        """Whether each segment is the last of its rod and no other rod continues it."""
        return self.is_last & ~np.isin(np.arange(self.is_last.size), self.continued)

    def _rods(self, row: Array) -> Array:
        """Reshapes a flat row to `(rods, entries per rod)`."""
        return row.reshape(self.count, -1)

    @property
    def is_closed(self) -> np.ndarray:
        """Whether each rod is closed, `(rods, 1)`."""
        return np.isin(np.arange(self.count), self.closed)[:, None]

    def smooth(self, nodes: Array) -> tuple[Array, Array]:
        """Positions and tangents of smooth axes at the nodes, from nodal positions."""
        place, tangent = smooth_nodes(self._rods(nodes), self.is_closed)
        return place.reshape(-1), tangent.reshape(-1)

    def from_smooth(self, places: Array, tangents: Array) -> Array:
        """Forces on nodes, from forces conjugate to smooth positions and tangents.

        It is the transpose of `smooth`.
        """
        return from_smooth_nodes(
            self._rods(places), self._rods(tangents), self.is_closed
        ).reshape(-1)

    def firsts(self, nodes: Array) -> Array:
        """Values of a nodal field at the first node of each segment."""
        return self._rods(nodes)[:, :-1].reshape(-1)

    def nexts(self, nodes: Array) -> Array:
        """Values of a nodal field at the second node of each segment."""
        return self._rods(nodes)[:, 1:].reshape(-1)

    def at_points(self, nodes: Array) -> Array:
        """Values of a nodal field at the contact points, by linear interpolation."""
        rods = self._rods(nodes)
        first, change = rods[:, :-1, None], (rods[:, 1:] - rods[:, :-1])[:, :, None]
        within = (first + self._fractions(nodes) * change).reshape(self.count, -1)
        return jnp.concatenate([within, rods[:, -1:]], axis=1).reshape(-1)

    def at_nodes(self, segments: Array) -> Array:
        """Averages of a segment field at the nodes, weighted by rest length."""
        first, last = self._shares()
        rods = self._rods(segments)
        return (
            vectors.pad(first * rods, 0, 1) + vectors.pad(last * rods, 1, 0)
        ).reshape(-1)

    def from_nodes(self, nodes: Array) -> Array:
        """Couples at nodes, divided between their segments: transpose of `at_nodes`."""
        first, last = self._shares()
        rods = self._rods(nodes)
        return (first * rods[:, :-1] + last * rods[:, 1:]).reshape(-1)

    def _shares(self) -> tuple[Array, Array]:
        """Weights of each segment in the averages at its first and second node [1]."""
        lengths = self._rods(self.rest_lengths)
        both = vectors.pad(lengths, 0, 1) + vectors.pad(lengths, 1, 0)
        return lengths / both[:, :-1], lengths / both[:, 1:]

    def of_points(self, segments: Array) -> Array:
        """Values of a segment field at the contact points; averages at the nodes."""
        within = self._rods(segments)[:, :, None]
        nodes = self._rods(self.at_nodes(segments))
        inner = jnp.repeat(within, self.per_element - 1, axis=2)
        firsts = jnp.concatenate([nodes[:, :-1, None], inner], axis=2)
        rods = firsts.reshape(self.count, -1)
        return jnp.concatenate([rods, nodes[:, -1:]], axis=1).reshape(-1)

    def from_points(self, points: Array) -> Array:
        """Forces at contact points, divided between nodes: transpose of `at_points`."""
        rods = self._rods(points)
        within = rods[:, :-1].reshape(self.count, -1, self.per_element)
        later = jnp.sum(self._fractions(points) * within, axis=2)
        first = jnp.sum(within, axis=2) - later
        none = jnp.zeros_like(rods[:, :1])
        nodes = jnp.concatenate([first, rods[:, -1:]], axis=1)
        return (nodes + jnp.concatenate([none, later], axis=1)).reshape(-1)

    def from_segments(self, firsts: Array, nexts: Array) -> Array:
        """Sums on each node of the forces at first and second nodes of segments."""
        first = jnp.pad(self._rods(firsts), ((0, 0), (0, 1)))
        following = jnp.pad(self._rods(nexts), ((0, 0), (1, 0)))
        return (first + following).reshape(-1)

    def to_segments(self, points: Array) -> Array:
        """Couples at contact points, summed on segments: transpose of `of_points`."""
        rods = self._rods(points)
        within = rods[:, :-1].reshape(self.count, -1, self.per_element)
        nodes = jnp.concatenate([within[:, :, 0], rods[:, -1:]], axis=1)
        inner = jnp.sum(within[:, :, 1:], axis=2).reshape(-1)
        return inner + self.from_nodes(nodes.reshape(-1))

    def _fractions(self, like: Array) -> Array:
        """Fractions of contact points along a segment [1], in the dtype of `like`."""
        fractions = np.arange(self.per_element) / self.per_element
        return jnp.asarray(fractions, like.dtype)[None, None, :]


def rod_segments(
    parts: Parts,
    per_element: int,
    continued: tuple[int, ...] = (),
    closed: tuple[int, ...] = (),
) -> RodSegments:
    """Segments and contact points of a member, with lengths, radii and arc lengths.

    Args:
        parts: Constants of a member that consists of rods.
        per_element: Number of contact points per element.
        continued: Indices of segments that are the last of their rod but continue in
            another.
        closed: Indices of the rods whose last node is tied to their first node.
    """
    assert parts.rest_lengths is not None and parts.radii is not None
    count, n = parts.count, parts.n_elements
    lengths = parts.rest_lengths.reshape(count, n)
    radii = parts.radii.reshape(count, n)
    starts = jnp.cumsum(lengths, axis=1) - lengths
    fractions = jnp.asarray(np.arange(per_element) / per_element, lengths.dtype)
    along = starts[:, :, None] + fractions[None, None, :] * lengths[:, :, None]
    ends = starts[:, -1:] + lengths[:, -1:]
    places = jnp.concatenate([along.reshape(count, -1), ends], axis=1)
    gaps = places[:, 1:] - places[:, :-1]
    spacing = 0.5 * (jnp.pad(gaps, ((0, 0), (1, 0))) + jnp.pad(gaps, ((0, 0), (0, 1))))
    # A node between two elements has the mean of their radii, weighted by length.
    weighted = radii * lengths
    inner = (weighted[:, 1:] + weighted[:, :-1]) / (lengths[:, 1:] + lengths[:, :-1])
    at_first = jnp.concatenate([radii[:, :1], inner], axis=1)
    within = jnp.repeat(radii[:, :, None], per_element - 1, axis=2)
    of_element = jnp.concatenate([at_first[:, :, None], within], axis=2)
    at_points = jnp.concatenate([of_element.reshape(count, -1), radii[:, -1:]], axis=1)
    return RodSegments(
        lengths=spacing.reshape(-1),
        point_radii=at_points.reshape(-1),
        places=places.reshape(-1),
        radii=parts.radii,
        starts=starts.reshape(-1),
        rest_lengths=parts.rest_lengths,
        count=count,
        per_element=per_element,
        continued=continued,
        closed=closed,
    )


def segments_and_ends(
    parts: Parts, per_element: int, free: Float[Array, "rods 2"]
) -> tuple[RodSegments, Ends]:
    """Segments of a member, with points of zero length at ends, and ends of its rods.

    Args:
        parts: Constants of a member that consists of rods.
        per_element: Number of contact points per element.
        free: Flags of the ends: 1 if free, 0 where the rod continues in another rod.
    """
    made = rod_segments(parts, per_element)
    count, n = made.count, made.n_elements

    def ends(lengths: Array, radii: Array, free: Array) -> Ends:
        return ends_of(lengths, radii, per_element, free)

    each = jax.vmap(ends)(
        made.rest_lengths.reshape(count, n), made.radii.reshape(count, n), free
    )
    inner = made.lengths.reshape(count, -1)[:, 1:-1]
    shares = jnp.zeros((count, 2, n * per_element + 1), inner.dtype)
    shares = shares.at[:, :, ::per_element].set(each.shares[:, 0])
    flat = jax.tree.map(jnp.ravel, replace(each, shares=jnp.zeros(())))
    return (
        replace(made, lengths=vectors.pad(inner, 1, 1).reshape(-1)),
        replace(flat, shares=shares),
    )


@pytree
class ContactPoints:
    """Contact points of a member, or of listed elements, at one moment."""

    position: Vec3
    """Positions on the centreline [m]."""
    velocity: Vec3 | None
    """Velocities of the centreline [m/s]; `None` if they are not needed."""
    spin: Vec3 | None
    """Angular velocities of the rods at the points, world frame [rad/s]."""
    radii: Array
    """Radius of the rod at each point [m]."""
    lengths: Array
    """Rest length that each point represents [m]."""
    rods: Array
    """Index of the rod that each point belongs to."""
    places: Array
    """Rest arc length from the start of its rod to each point [m]."""
    fractions: Array | None = None
    """Fractions of the points along listed elements [1]; `None` without a list."""

    @property
    def starts(self) -> Array:
        """Rest arc lengths where the points start, equal to `places` [m]."""
        return self.places

    @property
    def ends(self) -> Array:
        """Rest arc lengths where the points end, equal to `places` [m]."""
        return self.places

    def velocity_at(self, place: Any) -> Vec3:
        """Velocities of the points [m/s]; `place` is ignored."""
        assert self.velocity is not None
        return self.velocity

    def spin_at(self, place: Any) -> Vec3:
        """Angular velocities at the points [rad/s]; `place` is ignored."""
        assert self.spin is not None
        return self.spin


def points_at(segments: RodSegments, seen: Seen, *, spins: bool) -> ContactPoints:
    """Contact points of a member at one moment, with angular velocities if `spins`."""
    turning = seen.angular_velocities if spins else None
    return ContactPoints(
        position=vectors.mapped(segments.at_points, seen.motion.position),
        velocity=vectors.mapped(segments.at_points, seen.motion.velocity),
        spin=None if turning is None else vectors.mapped(segments.of_points, turning),
        radii=segments.point_radii,
        lengths=segments.lengths,
        rods=jnp.asarray(segments.point_rods, segments.radii.dtype),
        places=segments.places,
    )


@pytree
class SegmentLoads:
    """Forces and couples on contact points and segments; `None` means zero."""

    on_points: Vec3 | None = None
    """Forces on the contact points, world frame [N]."""
    turning_points: Vec3 | None = None
    """Couples on the rod at the contact points, world frame [N m]."""
    forces: Vec3 | None = None
    """Total forces on segments, world frame [N]."""
    nexts: Vec3 | None = None
    """Parts of `forces` that act at the second nodes of the segments [N]."""
    turning: Vec3 | None = None
    """Couples on segments, world frame [N m]."""
    turning_nodes: tuple[Vec3, Vec3] | None = None
    """Couples at the first and at the second nodes of segments, world frame [N m]."""
    tangents: tuple[Vec3, Vec3] | None = None
    """Forces conjugate to tangents at first and second nodes of smooth axes [N]."""

    def added(self, more: SegmentLoads) -> SegmentLoads:
        """Sum of these loads and `more`, field by field; `None` counts as zero."""

        def both(own: tuple[Vec3, Vec3] | None, other: tuple[Vec3, Vec3] | None) -> Any:
            if own is None or other is None:
                return own or other
            return jax.tree.map(jnp.add, own, other)

        return SegmentLoads(
            vectors.add_optional(self.on_points, more.on_points),
            vectors.add_optional(self.turning_points, more.turning_points),
            vectors.add_optional(self.forces, more.forces),
            vectors.add_optional(self.nexts, more.nexts),
            vectors.add_optional(self.turning, more.turning),
            both(self.turning_nodes, more.turning_nodes),
            both(self.tangents, more.tangents),
        )


def loads_on_member(segments: RodSegments, seen: Seen, loads: SegmentLoads) -> Loads:
    """Loads on nodes, and on elements in their material frames, from segment loads."""
    nodes: Vec3 | None = None
    couples = loads.turning
    if loads.on_points is not None:
        nodes = vectors.mapped(segments.from_points, loads.on_points)
    if loads.turning_points is not None:
        on_segments = vectors.mapped(segments.to_segments, loads.turning_points)
        couples = vectors.add_optional(on_segments, couples)
    if loads.turning_nodes is not None:
        x, y, z = map(segments.from_segments, *loads.turning_nodes)
        couples = vectors.add_optional(
            vectors.mapped(segments.from_nodes, (x, y, z)), couples
        )
    if loads.forces is not None and loads.nexts is not None:
        firsts = vectors.subtract(loads.forces, loads.nexts)
        x, y, z = map(segments.from_segments, firsts, loads.nexts)
        nodes = vectors.add_optional(nodes, (x, y, z))
    if loads.tangents is not None:
        assert nodes is not None
        tangents = map(segments.from_segments, *loads.tangents)
        x, y, z = map(segments.from_smooth, nodes, tangents)
        nodes = x, y, z
    if couples is None:
        return Loads(nodes)
    frame = directors(seen.motion.orientation)
    return Loads(nodes, to_material(frame, couples))


def points_needed(coupling: str, name: str, own: Parts, spacing: float) -> int:
    """Number of contact points per element, at most `spacing` radii apart.

    Args:
        coupling: Name of the coupling's factory, for the error message.
        name: Name of the member.
        own: Constants of the member.
        spacing: Largest distance between neighbouring points divided by the radius [1].

    Raises:
        ValueError: If lengths or radii are traced.
    """
    if is_traced(own.rest_lengths, own.radii):
        raise ValueError(
            f"{coupling}: lengths or radii of {name!r} are traced: give "
            "points_per_element"
        )
    ratio = np.asarray(own.rest_lengths) / np.asarray(own.radii)
    return max(1, math.ceil(float(np.max(ratio)) / spacing - 1e-6))


def last_but_continued(
    member: str, parts: AllParts, tied: Sequence[TiedPair]
) -> tuple[int, ...]:
    """Indices of the last segments of rods whose last node has to be subtracted.

    These nodes are tied to others. One node of each group of tied nodes is not
    subtracted.

    Args:
        member: Name of the member.
        parts: Constants of all members.
        tied: Pairs of nodes that are tied together, in both orders.
    """

    def elements(name: str) -> int:
        return parts[name].n_elements

    def is_last(place: tuple[str, int]) -> bool:
        n = elements(place[0])
        return place[1] % (n + 1) == n

    fellows: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for one, i, other, j in tied:
        fellows.setdefault((one, i), []).append((other, j))
    n, found = elements(member), []
    for rod in range(parts[member].count):
        here = (member, rod * (n + 1) + n)
        others = fellows.get(here, [])
        # One node of a group is not subtracted: one that is not a last node, or else
        # the first by name.
        stays = others and all(map(is_last, others)) and here < min(others)
        if others and not stays:
            found.append(rod * n + n - 1)
    return tuple(found)


def closed_rods(
    member: str, parts: AllParts, tied: Sequence[TiedPair]
) -> tuple[int, ...]:
    """Indices of a member's rods whose last node is tied to its first and to no other.

    Args:
        member: Name of the member.
        parts: Constants of all members.
        tied: Pairs of nodes that are tied together, in both orders.
    """
    n, found = parts[member].n_elements, []
    for rod in range(parts[member].count):
        ends = (member, rod * (n + 1)), (member, rod * (n + 1) + n)
        fellows = [{(p[2], p[3]) for p in tied if p[:2] == end} for end in ends]
        if n > 1 and fellows == [{ends[1]}, {ends[0]}]:
            found.append(rod)
    return tuple(found)
