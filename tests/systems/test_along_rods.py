"""Shares that count near ties and along one rod."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxrod.systems.contact.rod_segments import rod_segments
from jaxrod.systems.contact.touching_rods import (
    from_node,
    rod_and_place,
    share_near_tie,
    share_of_gap,
)
from jaxrod.systems.members.rods import parts_of
from systems.members import rod

THICK, THIN, LENGTH = 0.03, 0.01, 0.1


def test_the_share_of_one_rod_rises_beyond_pi_times_its_radius():
    gaps = np.pi * THICK + LENGTH * np.array([-1.0, 0.0, 0.25, 1.0, 2.0])
    found = share_of_gap(gaps, THICK, LENGTH)
    np.testing.assert_allclose(found, [0, 0, 0.25, 1, 1], atol=1e-6)


def test_the_share_near_a_tie_rises_beyond_pi_times_the_mean_radius():
    """Both ways from the tie count together, and only where both rods are tied."""
    both = np.pi * (THICK + THIN) / 2 + LENGTH * np.array([-0.5, 0.0, 0.25, 1.0, 2.0])
    for share in (0.0, 0.3, 1.0):
        own, other = (
            SimpleNamespace(radii=radius, rods=0, starts=1 + along, ends=1 + along)
            for radius, along in ((THICK, share * both), (THIN, (share - 1) * both))
        )
        found = share_near_tie(own, other, ((0, 1.0), (0, 1.0)), LENGTH)
        np.testing.assert_allclose(found, [0, 0, 0.25, 1, 1], atol=1e-6)
        free = share_near_tie(own, other, ((0, 1.0), (1, 1.0)), LENGTH)
        np.testing.assert_array_equal(free, 1)


def test_the_way_from_a_place_to_a_stretch_is_none_within_it():
    stretch = SimpleNamespace(
        starts=np.array([0.0, 0.2, 0.4]), ends=np.array([0.2, 0.4, 0.6])
    )
    np.testing.assert_allclose(from_node(stretch, 0.25), [0.05, 0, 0.15])


@pytest.mark.slow
def test_points_and_segments_count_by_their_ways_from_a_tie():
    """From a point, and from the nearer end of a segment that has not got the node."""
    one, two = (
        rod_segments(parts_of(rod(n, 0.5, radius=radius)[0]), per)
        for n, radius, per in ((5, THICK, 2), (8, THIN, 1))
    )
    node, other = 2, 3
    points = SimpleNamespace(
        radii=one.point_radii[None],
        rods=one.point_rods[None],
        starts=one.places[None],
        ends=one.places[None],
    )
    segments = SimpleNamespace(
        radii=two.radii[:, None],
        rods=two.segment_rods[:, None],
        starts=two.starts[:, None],
        ends=(two.starts + two.rest_lengths)[:, None],
    )
    nodes = rod_and_place(one, node), rod_and_place(two, other)
    length = two.rest_lengths[:, None]
    found = np.asarray(share_near_tie(points, segments, nodes, length))
    place, mark, length = 0.2, 3 * 0.5 / 8, 0.5 / 8
    for i, point in enumerate(np.linspace(0, 0.5, 11)):
        for k in range(8):
            start, end = k * length, (k + 1) * length
            beside = (
                0 if start <= mark <= end else min(abs(mark - start), abs(mark - end))
            )
            both = abs(point - place) + beside - np.pi * (THICK + THIN) / 2
            expected = np.clip(both / length, 0, 1)
            np.testing.assert_allclose(found[k, i], expected, atol=1e-9)
    assert 0.1 < found.mean() < 0.9
