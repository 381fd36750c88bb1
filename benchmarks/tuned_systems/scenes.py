"""Four systems of rods with joints and contact, for `jaxrod.tune`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

import jaxrod
from benchmarks.planar_systems import scenes
from jaxrod import shapes, systems

WEIGHT = (0.0, 0.0, -9.81)


def hinged() -> tuple[Any, Any]:
    """Two rods of unequal lengths, hinged to each other, which fall from a clamp."""
    upper, of_upper = _rod(12, 0.6, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    lower, of_lower = _rod(8, 0.4, (0.6, 0.0, 0.0), (1.0, 0.0, 0.0))
    state = {"upper": of_upper, "lower": of_lower}
    joint = systems.hinge_joint(
        ("upper", "tip"),
        ("lower", "base"),
        state,
        axis=(0.0, 1.0, 0.2),
        stiffness=3e3,
        axis_stiffness=30.0,
    )
    effects = jaxrod.gravity(WEIGHT), jaxrod.exponential_damping(1.0)
    members = {
        "upper": jaxrod.make_scene(upper, jaxrod.clamp(of_upper), *effects),
        "lower": jaxrod.make_scene(lower, *effects),
    }
    return jaxrod.make_system(members, joint, state=state), state


def ball_on_rod() -> tuple[Any, Any]:
    """Ball that hits a rod beside its axis; the rod is clamped at one end."""
    beam, of_beam = _rod(10, 0.5, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    ball, of_ball = systems.rigid_body(
        shapes.sphere((0.006, 0.35, 0.08), 0.04),
        density=400.0,
        velocity=(0.0, 0.0, -1.5),
        effects=(jaxrod.gravity(WEIGHT),),
        dtype=jnp.float64,
    )
    state = {"beam": of_beam, "ball": of_ball}
    effects = jaxrod.gravity(WEIGHT), jaxrod.exponential_damping(1.0)
    members = {
        "beam": jaxrod.make_scene(beam, jaxrod.clamp(of_beam), *effects),
        "ball": ball,
    }
    contact = systems.body_contact("beam", "ball")
    return jaxrod.make_system(members, contact, state=state), state


def draped_rope() -> tuple[Any, Any]:
    """Two ropes welded to each other, which fall over a fixed cylinder."""
    first, of_first = _rod(8, 0.5, (-0.45, 0.0, 0.13), (1.0, 0.0, 0.0), radius=0.015)
    second, of_second = _rod(8, 0.5, (0.05, 0.0, 0.13), (1.0, 0.0, 0.0), radius=0.015)
    state = {"first": of_first, "second": of_second}
    post = shapes.cylinder((0.0, -0.5, 0.0), (0.0, 0.5, 0.0), radius=0.1)
    weld = systems.weld(("first", "tip"), ("second", "base"), state)
    effects = (
        jaxrod.gravity(WEIGHT),
        jaxrod.exponential_damping(2.0),
        jaxrod.contact(post),
    )
    members = {
        "first": jaxrod.make_scene(first, *effects),
        "second": jaxrod.make_scene(second, *effects),
    }
    return jaxrod.make_system(members, weld, state=state), state


def gripper() -> tuple[Any, Any]:
    """Two fingers that close on a falling ball and hold it by friction."""
    return scenes.gripper(jaxrod.consistent())


def _rod(
    n_elements: int,
    length: float,
    start: tuple[float, float, float],
    direction: tuple[float, float, float],
    radius: float = 0.02,
) -> tuple[Any, Any]:
    return jaxrod.straight_rod(
        n_elements,
        length=length,
        radius=radius,
        density=1000.0,
        youngs_modulus=1e6,
        start=start,
        direction=direction,
        dtype=jnp.float64,
    )


SCENES: dict[str, tuple[Callable[[], tuple[Any, Any]], float]] = {
    "hinged": (hinged, 0.4),
    "ball_on_rod": (ball_on_rod, 0.25),
    "draped_rope": (draped_rope, 0.4),
    "gripper": (gripper, 0.15),
}
"""Functions that make a system and its state in float64, and the simulated time [s]."""
