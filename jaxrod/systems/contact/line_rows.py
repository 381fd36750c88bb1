"""The line law on rows of all points and all segments, without gather."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.contacts.contact_law import friction_force, normal_force
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.systems.contact.along_rods import (
    from_node,
    rod_and_place,
    share_of_gap,
    tied_share,
)
from jaxrod.systems.contact.near_segments import Nearness, nearnesses
from jaxrod.systems.contact.strands import (
    ContactPoints,
    Segments,
    StrandLoads,
    Strands,
    loads_on_member,
    points_at,
    segments_at,
)
from jaxrod.systems.contact.touching_rods import TouchingRods
from jaxrod.systems.sites.coupling import AllSeen


def row_loads(contact: TouchingRods, seen: AllSeen) -> dict[str, Loads]:
    """Forces and couples on all members."""
    rubs = contact.friction is not None
    strands, members = contact.strands, contact.members
    total: dict[int, StrandLoads] = {}
    for view in _views(contact):
        points = points_at(strands[view.member], seen[members[view.member]], spins=rubs)
        segments = _segments(contact, seen, view.others, spins=rubs)
        for near in _near(contact, view, points, segments):
            on_points, on_segments = _pair_loads(contact, near, points, segments)
            parts = [(view.member, on_points), *_parted(contact, view, on_segments)]
            for k, loads in parts:
                total[k] = total.get(k, StrandLoads()).added(loads)
    return {
        members[k]: loads_on_member(strands[k], seen[members[k]], loads)
        for k, loads in total.items()
    }


def row_nearnesses(contact: TouchingRods, seen: AllSeen) -> Iterator[Nearness]:
    """Pairs of points and segments of all members that meet."""
    strands, members = contact.strands, contact.members
    for view in _views(contact):
        own = strands[view.member]
        points = points_at(own, seen[members[view.member]], spins=False)
        segments = _segments(contact, seen, view.others, spins=False)
        yield from _near(contact, view, points, segments)


class _View(NamedTuple):
    """The points of a member, and all segments that they may meet, in one row.

    All other members share one row, so that the program has one part for each member,
    not for each pair of members.
    """

    member: int
    others: tuple[int, ...]
    weights: Array
    """Half the counted lengths of points, `(segments, points)` [m]."""


def _views(contact: TouchingRods) -> Iterator[_View]:
    met: dict[int, list[int]] = {}
    for a, b in contact.views():
        met.setdefault(a, []).append(b)
    for a, others in met.items():
        weights = jnp.concatenate([_weights(contact, a, b) for b in others])
        yield _View(a, tuple(others), weights)


def _weights(contact: TouchingRods, a: int, b: int) -> Array:
    """Half the counted lengths of one member's points, for another's segments [m]."""
    points, segments = contact.strands[a], contact.strands[b]
    shape = segments.radii.shape[0], points.lengths.shape[0]
    half = jnp.broadcast_to(0.5 * points.lengths[None, :], shape)
    if a == b:
        half = _within(contact, points, segments, half)
    for one, i, other, j in contact.tied:
        if (one, other) == (contact.members[a], contact.members[b]):
            half = half * _away(points, i, segments, j)
    return half


def _segments(
    contact: TouchingRods, seen: AllSeen, members: tuple[int, ...], *, spins: bool
) -> Segments:
    """Segments of some members."""
    rows = [
        segments_at(contact.strands[k], seen[contact.members[k]], spins=spins)
        for k in members
    ]
    return jax.tree.map(lambda *fields: jnp.concatenate(fields), *rows)


def _parted(
    contact: TouchingRods, view: _View, loads: StrandLoads
) -> Iterator[tuple[int, StrandLoads]]:
    """Loads on the segments, split by member."""
    start = 0
    for k in view.others:
        here = slice(start, start + contact.strands[k].radii.shape[0])
        yield k, jax.tree.map(operator.itemgetter(here), loads)
        start = here.stop


def _within(
    contact: TouchingRods, points: Strands, segments: Strands, half: Array
) -> Array:
    """Half the counted lengths of points, for segments of the same member [m]."""
    same = segments.segment_rods[:, None] == points.point_rods[None, :]
    if not contact.itself:
        return jnp.where(same, 0, half)
    place, start = points.places[None, :], segments.starts[:, None]
    length = segments.rest_lengths[:, None]
    apart = jnp.maximum(start - place, place - start - length)
    share = share_of_gap(apart, segments.radii[:, None], length)
    return jnp.where(same, half * share, half)


def _near(
    contact: TouchingRods, view: _View, points: ContactPoints, segments: Segments
) -> Iterator[Nearness]:
    others = [contact.strands[k] for k in view.others]
    radii = jnp.concatenate([other.radii for other in others])
    return nearnesses(
        points,
        segments,
        view.weights,
        np.concatenate([other.is_end for other in others]),
        (radii, contact.strands[view.member].point_radii),
        contact.onset,
    )


def _pair_loads(
    contact: TouchingRods, near: Nearness, points: ContactPoints, segments: Segments
) -> tuple[StrandLoads, StrandLoads]:
    """Loads of one set of pairs on the points' member and on the segments' members."""
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
    """Share that counts of pairs; zero for points and segments near tied nodes [1]."""
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
