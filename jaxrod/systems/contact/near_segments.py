"""Contact points near segments: closest points, loads there, and sums over pairs.

All pairs are computed at once, `(segments, points)`. There is no gather, and points are
along the fastest axis.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree
from jaxrod.systems.contact.strands import ContactPoints, Segments, StrandLoads
from jaxrod.systems.members.parts import mapped

_ROUNDED = 1e-7
"""Width within which distances are smoothed, over the sum of the radii [1]."""


@pytree
class Nearness:
    """Pairs of a contact point and a place on a segment."""

    normal: Vec3
    """Unit vectors from the segments to the points."""
    fraction: Array
    """Place on the segment, over its length [1]."""
    weight: Array
    """Rest length for which the pair counts; negative if it is subtracted [m]."""
    depth: Array
    """Penetration [m]."""
    width: Array
    """Width of the onset of contact [m]."""
    segment_radii: Array
    """Radii of the segments [m]."""
    point_radii: Array
    """Radii at the points [m]."""

    @property
    def half_sum(self) -> Array:
        """Mean of both radii [m]."""
        return 0.5 * (self.segment_radii + self.point_radii)

    def rates(self, points: ContactPoints, segments: Segments) -> Vec3:
        """Velocities of the points relative to the places on the segments [m/s]."""
        other = vectors.add(
            mapped(_column, segments.first_velocity),
            vectors.scale(self.fraction, mapped(_column, segments.velocity_change)),
        )
        return vectors.subtract(mapped(_row, points.velocity), other)

    def arms(self) -> tuple[Vec3, Vec3]:
        """Vectors from the axes of points and of segments to their common point [m]."""
        overlap = 0.5 * self.depth
        return (
            vectors.scale(overlap - self.point_radii, self.normal),
            vectors.scale(self.segment_radii - overlap, self.normal),
        )

    def slip(
        self,
        rate: Vec3,
        leaving: Array,
        arms: tuple[Vec3, Vec3],
        points: ContactPoints,
        segments: Segments,
    ) -> Vec3:
        """Slip velocity of points relative to segments, at their common point [m/s]."""
        assert points.spin is not None and segments.spin is not None
        along = vectors.subtract(rate, vectors.scale(leaving, self.normal))
        turning = vectors.cross(mapped(_row, points.spin), arms[0])
        other = vectors.cross(mapped(_column, segments.spin), arms[1])
        return vectors.add(along, vectors.subtract(turning, other))

    def summed(
        self, force: Vec3, turns: tuple[Vec3, Vec3] | None
    ) -> tuple[StrandLoads, StrandLoads]:
        """Loads on the points' member, and on the segments' member.

        Args:
            force: Force on the points, per length [N/m].
            turns: Couples on the points and on the segments, per length [N], if any.
        """
        weighted = vectors.scale(self.weight, force)
        later = vectors.scale(self.fraction, weighted)
        turning_points = turning_segments = None
        if turns is not None:
            of_points, of_segments = (vectors.scale(self.weight, t) for t in turns)
            turning_points = mapped(_over_segments, of_points)
            turning_segments = mapped(_over_points, of_segments)
        return (
            StrandLoads(
                on_points=mapped(_over_segments, weighted),
                turning_points=turning_points,
            ),
            StrandLoads(
                on_firsts=mapped(_over_points, vectors.subtract(later, weighted)),
                on_nexts=mapped(_over_points, vectors.scale(-1.0, later)),
                turning_segments=turning_segments,
            ),
        )


def nearnesses(
    points: ContactPoints,
    segments: Segments,
    weights: Array,
    is_end: np.ndarray,
    radii: tuple[Array, Array],
    onset: Array,
) -> Iterator[Nearness]:
    """Points with their closest points on segments, then with the segments' next nodes.

    The latter count negative, and only where another segment follows.

    Args:
        points: The points.
        segments: The segments.
        weights: Rest length for which each pair counts [m].
        is_end: Whether each segment is the last of its rod, and nothing follows.
        radii: Radii of the segments, and radii at the points [m].
        onset: Width of the onset over the mean of the radii [1].
    """
    place = mapped(_row, points.position)
    first, edge = mapped(_column, segments.first), mapped(_column, segments.edge)
    apart = vectors.subtract(place, first)
    share = vectors.dot(apart, edge) / vectors.dot(edge, edge)
    share = jnp.clip(share, 0, 1)
    own, other = radii[0][:, None], radii[1][None, :]
    together = own + other
    rounded = (_ROUNDED * together) * (_ROUNDED * together)
    follows = jnp.asarray(np.where(is_end, 0, -1), share.dtype)[:, None]
    for fraction, weight in (
        (share, weights),
        (jnp.ones_like(share), follows * weights),
    ):
        way = vectors.subtract(apart, vectors.scale(fraction, edge))
        distance = jnp.sqrt(vectors.dot(way, way) + rounded)
        yield Nearness(
            normal=vectors.scale(1 / distance, way),
            fraction=fraction,
            weight=weight,
            depth=together - distance,
            width=0.5 * onset * together,
            segment_radii=own,
            point_radii=other,
        )


def _row(field: Array) -> Array:
    return field[None, :]


def _column(field: Array) -> Array:
    return field[:, None]


def _over_segments(field: Array) -> Array:
    return jnp.sum(field, axis=0)


def _over_points(field: Array) -> Array:
    return jnp.sum(field, axis=1)
