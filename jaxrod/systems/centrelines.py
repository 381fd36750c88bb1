"""Centrelines of rods of a system in one row: contact points and segments.

All nodes of the named members lie in one row, member after member. A segment is an
element, from its first node to its next. A contact point is on a segment at a fraction
of its length and stands for some of the rod's rest length (trapezoidal rule).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllParts, AllSeen
from jaxrod.systems.places import Indices
from jaxrod.systems.rows import gathered_sum


@dataclass(frozen=True)
class Layout:
    """Numbering of the points and segments of several members."""

    members: tuple[str, ...]
    """Names of the members."""
    first_nodes: Indices
    """First node of each segment."""
    rods: Indices
    """Number of the rod of each segment."""
    is_last: Indices
    """One for the last segment of each rod, else zero."""
    point_segments: Indices
    """Segment of each point."""
    point_fractions: tuple[float, ...]
    """Fraction of the segment at each point."""
    node_counts: tuple[int, ...]
    """Nodes of each member."""
    element_counts: tuple[int, ...]
    """Elements of each member."""


def layout_of(
    members: Sequence[str], parts: AllParts, per_element: Sequence[int]
) -> Layout:
    """Numbers nodes, segments and points.

    Args:
        members: Names of the members, rods all.
        parts: Their constants.
        per_element: Contact points per element, of each member.
    """
    first, rods, last, segments = [], [], [], []
    fractions: list[float] = []
    nodes = elements = rod = 0
    for name, per in zip(members, per_element, strict=True):
        own = parts[name]
        n = own.n_elements
        first.append(own.first_nodes + nodes)
        rods.append(rod + np.repeat(np.arange(own.count), n))
        last.append(np.tile(np.arange(n) == n - 1, own.count))
        for k in range(own.count):
            begin = elements + k * n
            for e in range(begin, begin + n):
                segments += [e] * per
                fractions += [j / per for j in range(per)]
            segments.append(begin + n - 1)
            fractions.append(1.0)
        nodes += own.n_nodes
        elements += own.count * n
        rod += own.count
    return Layout(
        members=tuple(members),
        first_nodes=Indices(np.concatenate(first)),
        rods=Indices(np.concatenate(rods)),
        is_last=Indices(np.concatenate(last)),
        point_segments=Indices(segments),
        point_fractions=tuple(fractions),
        node_counts=tuple(parts[name].n_nodes for name in members),
        element_counts=tuple(parts[m].count * parts[m].n_elements for m in members),
    )


@pytree
class Centrelines:
    """Constants of contact between rods."""

    lengths: Array
    """Rest length that each point stands for [m]."""
    radii: Array
    """Radius of each segment [m]."""
    point_radii: Array
    """Radius at each point [m]."""
    places: Array
    """Rest arc length of each point along its rod [m]."""
    starts: Array
    """Rest arc length at the start of each segment [m]."""
    rest_lengths: Array
    """Rest length of each segment [m]."""
    layout: Layout = static()
    """Numbering."""


def centrelines(layout: Layout, parts: AllParts) -> Centrelines:
    """Works out the constants of contact points and segments."""
    own = [parts[name] for name in layout.members]
    lengths = jnp.concatenate([_known(p.rest_lengths) for p in own])
    radii = jnp.concatenate([_known(p.radii) for p in own])
    segment = layout.point_segments.values
    fraction = np.asarray(layout.point_fractions)
    rods = layout.rods.values
    begins = np.concatenate([[True], rods[1:] != rods[:-1]])
    before = jnp.concatenate([jnp.zeros(1, lengths.dtype), jnp.cumsum(lengths)[:-1]])
    heads = np.flatnonzero(begins)
    starts = before - before[heads][np.cumsum(begins) - 1]
    # A node between two elements has the mean of their radii, by length.
    previous = np.where(begins, np.arange(len(rods)), np.arange(len(rods)) - 1)
    at_start = (radii * lengths + radii[previous] * lengths[previous]) / (
        lengths + lengths[previous]
    )
    spacing = _spacing(lengths, segment, fraction, rods)
    at_node = (fraction == 0) | (fraction == 1)
    point_radii = jnp.where(
        at_node,
        jnp.where(fraction == 0, at_start[segment], radii[segment]),
        radii[segment],
    )
    return Centrelines(
        lengths=spacing,
        radii=radii,
        point_radii=point_radii,
        places=starts[segment] + fraction * lengths[segment],
        starts=starts,
        rest_lengths=lengths,
        layout=layout,
    )


def _known(array: Array | None) -> Array:
    assert array is not None
    return array


def _spacing(
    lengths: Array, segment: np.ndarray, fraction: np.ndarray, rods: np.ndarray
) -> Array:
    """Half the rest length to the neighbouring points of the same rod, on each side."""
    place = jnp.cumsum(lengths)[segment] + (fraction - 1) * lengths[segment]
    gaps = place[1:] - place[:-1]
    rod = rods[segment]
    same = rod[1:] == rod[:-1]
    gaps = jnp.where(same, gaps, 0)
    none = jnp.zeros(1, lengths.dtype)
    return 0.5 * (jnp.concatenate([none, gaps]) + jnp.concatenate([gaps, none]))


@pytree
class Lines:
    """Points and segments at a moment; component arrays."""

    first: Vec3
    """First node of each segment [m]."""
    edge: Vec3
    """From there to the next [m]."""
    first_velocity: Vec3
    """Of the first nodes [m/s]."""
    next_velocity: Vec3
    """Of the next [m/s]."""
    spin: Vec3
    """Angular velocity of each segment, world frame [rad/s]."""


def lines_at(layout: Layout, seen: AllSeen, *, spins: bool) -> Lines:
    """Segments of all members.

    Args:
        layout: Numbering.
        seen: The members.
        spins: Whether angular velocities are needed.
    """

    def row(of: Any) -> Vec3:
        fields = [of(seen[name]) for name in layout.members]
        x, y, z = (jnp.concatenate([f[k] for f in fields]) for k in range(3))
        return x, y, z

    position = row(lambda own: own.motion.position)
    velocity = row(lambda own: own.motion.velocity)
    index = layout.first_nodes.values

    def at(field: Vec3, shift: int) -> Vec3:
        x, y, z = (component[index + shift] for component in field)
        return x, y, z

    first = at(position, 0)
    spin = row(lambda own: own.angular_velocities) if spins else velocity
    return Lines(
        first=first,
        edge=vectors.subtract(at(position, 1), first),
        first_velocity=at(velocity, 0),
        next_velocity=at(velocity, 1),
        spin=spin,
    )


def at_points(layout: Layout, first: Vec3, change: Vec3) -> Vec3:
    """A field on the nodes at the points: its value at first nodes, and its change."""
    segment = layout.point_segments.values
    fraction = jnp.asarray(layout.point_fractions, first[0].dtype)
    x, y, z = (
        a[segment] + fraction * b[segment] for a, b in zip(first, change, strict=True)
    )
    return x, y, z


def loads_on_members(
    layout: Layout,
    seen: AllSeen,
    on_first: Vec3,
    on_next: Vec3,
    couples: Vec3 | None,
) -> dict[str, Loads]:
    """Forces on both nodes of every segment and couples on it, member by member."""
    index = layout.first_nodes
    size = sum(layout.node_counts)
    following = Indices(index.values + 1)
    forces = [
        gathered_sum(a, index, size) + gathered_sum(b, following, size)
        for a, b in zip(on_first, on_next, strict=True)
    ]
    result: dict[str, Loads] = {}
    node = element = 0
    for name, nodes, elements in zip(
        layout.members, layout.node_counts, layout.element_counts, strict=True
    ):
        x, y, z = (f[node : node + nodes] for f in forces)
        turning = None
        if couples is not None:
            a, b, c = (k[element : element + elements] for k in couples)
            turning = to_material(directors(seen[name].motion.orientation), (a, b, c))
        result[name] = Loads((x, y, z), turning)
        node, element = node + nodes, element + elements
    return result
