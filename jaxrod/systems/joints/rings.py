"""Closed rods: a rod whose last node coincides with its first, and the closing joint.

A closed rod is an open rod whose ends are tied, with one more elastic joint from its
last element to its first. This joint is like those between all other elements, so no
point of the ring differs from the others.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.geometry.material_frames import straight_frame, unit_vector
from jaxrod.geometry.rotations import (
    Quaternion,
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
)
from jaxrod.rods.factories import MOST_ELEMENTS, rod_along
from jaxrod.rods.rod import Rod, RodState
from jaxrod.systems.coupling import Coupling
from jaxrod.systems.joints.elastic_joints import ElasticJoint
from jaxrod.systems.joints.places import layouts_of, points_of, resolved
from jaxrod.systems.joints.ties import tie
from jaxrod.validation import (
    Numbers,
    check_array,
    check_count,
    check_dtype,
    is_traced,
)

FEWEST_ELEMENTS = 3
"""Smallest number of elements of a ring."""


def ring(
    n_elements: int,
    *,
    length: Numbers,
    centre: Numbers = (0.0, 0.0, 0.0),
    normal: Numbers = (0.0, 0.0, 1.0),
    turns: Numbers = 0.0,
    straight_at_rest: bool = False,
    name: str = "ring",
    dtype: Any = None,
    **rod: Any,
) -> tuple[Rod, RodState, tuple[Coupling, ...]]:
    """A closed rod in the shape of a circle, and the couplings that close it.

    The rod alone is open, with both ends at one place. It becomes a ring as the member
    `name` of a system with these couplings:

        rod, state, closure = jaxrod.systems.ring(40, length=1.0, radius=0.01, ...)
        system = jaxrod.make_system({"ring": jaxrod.make_scene(rod)}, closure)

    Args:
        n_elements: Number of elements, at least 3.
        length: Rest length of the rod, once around [m]: the sum of the edges of a
            regular polygon.
        centre: Centre of the circle, world frame `(3,)` [m].
        normal: Normal of its plane, world frame, of any length `(3,)`; the rod runs
            around it counterclockwise.
        turns: Number of turns by which one end was twisted about the rod's axis before
            the ends were joined (the link of the ring). It need not be an integer. The
            twist is spread evenly along the rod [1].
        straight_at_rest: Whether the stress-free shape of the rod is straight;
            otherwise it is the circle.
        name: Name of the member in the system.
        dtype: float32 or float64; by default JAX's default.
        **rod: Section and material, passed to `jaxrod.rod_along`: `radius` or
            `section`, `density`, `youngs_modulus` and others.

    Returns:
        The rod, its state, and couplings for `make_system`.

    Raises:
        ValueError: If an argument is out of range or does not fit.
        TypeError: If the name is not a string.

    Example:
        >>> hoop, circle, closure = systems.ring(
        ...     10, length=1.0, radius=0.02, density=1000.0, youngs_modulus=1e6
        ... )
        >>> system = jaxrod.make_system({"ring": jaxrod.make_scene(hoop)}, closure)
        >>> gap = circle.tip - circle.positions[:, 0]
        >>> bool(jnp.abs(gap).max() < 1e-6)
        True
    """
    if not isinstance(name, str):
        raise TypeError(f"name must be a string, got {name!r}")
    n = check_count("n_elements", n_elements, FEWEST_ELEMENTS, MOST_ELEMENTS)
    dtype = check_dtype(dtype)
    if is_traced(length, centre, normal, turns):
        raise ValueError(
            "length [m], centre [m], normal and turns of a ring must be known when "
            "the program is traced: its numbers may change afterwards"
        )
    around = check_array("length", length, [()], "m", positive=True, dtype=dtype)
    middle = check_array("centre", centre, [(3,)], "m", dtype=dtype)
    link = float(check_array("turns", turns, [()], ""))
    frame = straight_frame(unit_vector("normal", normal), None)
    angles = 2 * np.pi * np.arange(n + 1) / n
    # The circle lies in the plane of the first two axes.
    along, beside, up = frame[0][:, None], frame[1][:, None], frame[2][:, None]
    outwards = np.cos(angles) * along + np.sin(angles) * beside
    places = middle[:, None] + around / (2 * n * np.sin(np.pi / n)) * outwards
    # Both ends are exactly at one place: round-off would leave a gap.
    places[:, -1] = places[:, 0]
    tangents = np.diff(places, axis=1)
    tangents /= np.linalg.norm(tangents, axis=0)
    # With d2 along the normal, curvature is only about d2 and the frames close up.
    normals = np.repeat(up, n, axis=1)
    inwards = np.cross(normals, tangents, axis=0)
    directors = np.stack([inwards, normals, tangents])
    made, state = rod_along(places, directors=directors, dtype=dtype, **rod)
    bend = np.array([0.0, 2 * np.pi / n, 0.0])
    if straight_at_rest:
        bend = 0 * bend
        made = replace(made, rest_curvatures=jnp.zeros_like(made.rest_curvatures))
    turn = 2 * np.pi * link
    twisted = _twisted(state, turn / n * np.arange(n))
    return made, twisted, _closure(name, twisted, bend, turn)


def _closure(
    name: str, state: RodState, bend: np.ndarray, turn: float
) -> tuple[Coupling, ...]:
    """Couplings that close a ring: a tie of its end nodes, and an elastic joint.

    Args:
        name: Name of the member.
        state: State of the ring.
        bend: Rotation vector of the joint at rest [rad].
        turn: Angle by which one end was twisted before the ends were joined [rad].
    """
    rest = {name: state}
    last, first = (name, "tip"), (name, "base")
    layouts = layouts_of(rest)
    dtype = state.positions.dtype
    joint = ElasticJoint(
        points_of("a", [resolved("a", last, layouts)]),
        points_of("b", [resolved("b", first, layouts)]),
        # Turned back by the twist, the last element continues evenly into the first.
        join_quaternion(_about_axis(np.array([-turn]), dtype)),
        jnp.asarray(bend, dtype)[:, None],
    )
    return (tie(last, first, rest), joint)


def _twisted(state: RodState, angles: np.ndarray) -> RodState:
    """Copy of the state with each element turned about its d3 by an angle [rad]."""
    own = split_quaternion(state.orientations)
    turned = multiply_quaternions(own, _about_axis(angles, own[0].dtype))
    return replace(state, orientations=join_quaternion(turned))


def _about_axis(angles: np.ndarray, dtype: Any) -> Quaternion:
    """Quaternions of rotations about the third axis by angles [rad]."""
    zero = jnp.zeros(angles.shape, dtype)
    half = np.cos(0.5 * angles), np.sin(0.5 * angles)
    return jnp.asarray(half[0], dtype), zero, zero, jnp.asarray(half[1], dtype)
