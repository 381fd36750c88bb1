"""Systems in a plane: a gripper with a ball, and a rod pushed against its neighbour."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

import jaxrod
from jaxrod import systems

SOFT = {"radius": 0.008, "density": 1000.0, "youngs_modulus": 1e6}


def gripper(
    method: Any,
    *,
    height: float = 0.0,
    weight: tuple[float, float, float] = (0.0, 0.0, -9.81),
    dtype: Any = jnp.float64,
) -> tuple[Any, Any]:
    """Two fingers that are bent by chambers and hold a falling ball by friction."""

    def finger(x: float) -> tuple[Any, Any]:
        rod, state = jaxrod.straight_rod(
            20,
            length=0.12,
            start=(x, 0.0, 0.2),
            direction=(0.0, 0.0, -1.0),
            normal=(1.0, 0.0, 0.0),
            dtype=dtype,
            **SOFT,
        )
        chamber = jaxrod.actuation.chamber(rod, 3e4, 5e-5, offsets=(x / 6, 0.0))
        fall = jaxrod.gravity((0.0, 0.0, -9.81))
        damping = jaxrod.exponential_damping(2.0)
        effects = (jaxrod.clamp(state), chamber, fall, damping)
        return jaxrod.make_scene(rod, *effects, method=method), state

    (left, of_left), (right, of_right) = finger(-0.03), finger(0.03)
    ball, of_ball = systems.rigid_body(
        jaxrod.shapes.sphere((0.0005, height, 0.1), 0.02),
        density=300.0,
        effects=(jaxrod.gravity(weight),),
        dtype=dtype,
    )
    state = {"left": of_left, "right": of_right, "ball": of_ball}
    law = {"stiffness": 5e3, "damping": 5.0, "friction": 0.8}
    contacts = [systems.body_contact(name, "ball", **law) for name in ("left", "right")]
    members = {"left": left, "right": right, "ball": ball}
    return jaxrod.make_system(members, *contacts, state=state), state


def fingers(method: Any, *, dtype: Any = jnp.float64) -> tuple[Any, Any]:
    """The fingers of the gripper alone, joined by a spring between their tips."""
    system, state = gripper(method, dtype=dtype)
    pair = {name: state[name] for name in ("left", "right")}
    band = systems.spring(("left", "tip"), ("right", "tip"), pair, stiffness=20.0)
    members = {name: system.members[name] for name in pair}
    return jaxrod.make_system(members, band, state=pair), pair


def chain(method: Any, *, dtype: Any = jnp.float64) -> tuple[Any, Any]:
    """Four rods welded end to end, which hang from one end of the first."""
    members: dict[str, Any] = {}
    state: dict[str, Any] = {}
    for k in range(4):
        rod, own = jaxrod.straight_rod(
            20,
            length=0.12,
            start=(0.12 * k, 0.0, 0.0),
            direction=(1.0, 0.0, 0.0),
            normal=(0.0, 0.0, 1.0),
            dtype=dtype,
            **SOFT,
        )
        held = (jaxrod.clamp(own),) if k == 0 else ()
        scene = jaxrod.make_scene(rod, *held, jaxrod.gravity(), method=method)
        members[f"rod {k}"], state[f"rod {k}"] = scene, own
    joints = [
        systems.weld((f"rod {k}", "tip"), (f"rod {k + 1}", "base"), state)
        for k in range(3)
    ]
    return jaxrod.make_system(members, *joints, state=state), state


SCENES = {"gripper": gripper, "fingers": fingers, "chain": chain}
"""Each takes a method, of members in space or in the plane zx, and a dtype."""
