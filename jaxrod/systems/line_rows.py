"""The line law on rows of all points and all segments: nothing is looked up."""

from __future__ import annotations

from collections.abc import Iterator

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.contacts.contact_law import friction_force, normal_force
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.systems.along_rods import (
    from_node,
    rod_and_place,
    share_of_gap,
    tied_share,
)
from jaxrod.systems.coupling import AllSeen
from jaxrod.systems.near_segments import Nearness, nearnesses
from jaxrod.systems.strands import (
    ContactPoints,
    Segments,
    StrandLoads,
    Strands,
    loads_on_member,
    points_at,
    segments_at,
)
from jaxrod.systems.touching_rods import TouchingRods


def row_loads(contact: TouchingRods, seen: AllSeen) -> dict[str, Loads]:
    """Forces and couples on all members."""
    rubs = contact.friction is not None
    strands, members = contact.strands, contact.members
    total: dict[int, StrandLoads] = {}
    for a, b, weights in _weights(contact):
        points = points_at(strands[a], seen[members[a]], spins=rubs)
        segments = segments_at(strands[b], seen[members[b]], spins=rubs)
        for near in _near(contact, (a, b), weights, points, segments):
            on_a, on_b = _pair_loads(contact, near, points, segments)
            total[a] = total.get(a, StrandLoads()).added(on_a)
            total[b] = total.get(b, StrandLoads()).added(on_b)
    return {
        members[k]: loads_on_member(strands[k], seen[members[k]], loads)
        for k, loads in total.items()
    }


def row_nearnesses(contact: TouchingRods, seen: AllSeen) -> Iterator[Nearness]:
    """Points and segments of all members that meet."""
    strands, members = contact.strands, contact.members
    for a, b, weights in _weights(contact):
        points = points_at(strands[a], seen[members[a]], spins=False)
        segments = segments_at(strands[b], seen[members[b]], spins=False)
        yield from _near(contact, (a, b), weights, points, segments)


def _weights(contact: TouchingRods) -> Iterator[tuple[int, int, Array]]:
    """Members whose points and segments meet, and half the lengths that count."""
    for a, b in contact.views():
        points, segments = contact.strands[a], contact.strands[b]
        half = 0.5 * points.lengths[None, :]
        if a == b:
            half = _within(contact, points, segments, half)
        for one, i, other, j in contact.tied:
            if (one, other) == (contact.members[a], contact.members[b]):
                half = half * _away(points, i, segments, j)
        yield a, b, half


def _within(
    contact: TouchingRods, points: Strands, segments: Strands, half: Array
) -> Array:
    """Half the lengths of points, for segments of the same member."""
    same = segments.segment_rods[:, None] == points.point_rods[None, :]
    if not contact.itself:
        return jnp.where(same, 0, half)
    place, start = points.places[None, :], segments.starts[:, None]
    length = segments.rest_lengths[:, None]
    apart = jnp.maximum(start - place, place - start - length)
    share = share_of_gap(apart, segments.radii[:, None], length)
    return jnp.where(same, half * share, half)


def _near(
    contact: TouchingRods,
    which: tuple[int, int],
    weights: Array,
    points: ContactPoints,
    segments: Segments,
) -> Iterator[Nearness]:
    one, other = (contact.strands[k] for k in which)
    radii = other.radii, one.point_radii
    return nearnesses(points, segments, weights, other.is_end, radii, contact.onset)


def _pair_loads(
    contact: TouchingRods, near: Nearness, points: ContactPoints, segments: Segments
) -> tuple[StrandLoads, StrandLoads]:
    """Loads of one kind of nearness on the points' member and the segments'."""
    rate = near.rates(points, segments)
    leaving = vectors.dot(rate, near.normal)
    push = normal_force(
        near.depth, leaving, near.width, contact.stiffness, contact.damping
    )
    force = vectors.scale(push, near.normal)
    turns: tuple[Vec3, Vec3] | None = None
    if contact.friction is not None:
        assert contact.friction_drag is not None
        arms = near.arms()
        slip = near.slip(rate, leaving, arms, points, segments)
        rub = friction_force(push, slip, contact.friction, contact.friction_drag)
        force = vectors.add(force, rub)
        turns = vectors.cross(arms[0], rub), vectors.cross(rub, arms[1])
    return near.summed(force, turns)


def _away(points: Strands, node: int, segments: Strands, other: int) -> Array:
    """Zero for points and segments near nodes that are tied, along their rods."""
    rod, place = rod_and_place(points, node)
    fellow, mark = rod_and_place(segments, other)
    along = jnp.abs(points.places - place)
    ends = segments.starts + segments.rest_lengths
    beside = from_node(segments.starts, ends, mark)
    concerned = (segments.segment_rods == fellow)[:, None] & (points.point_rods == rod)[
        None, :
    ]
    return tied_share(
        (along[None, :], beside[:, None]),
        concerned,
        (segments.radii[:, None], points.point_radii[None, :]),
        segments.rest_lengths[:, None],
    )
