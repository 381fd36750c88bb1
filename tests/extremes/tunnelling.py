"""Rods shot at bodies and at each other, from 0.1 to 1,000 m/s.

    PYTHONPATH=tests python tests/extremes/tunnelling.py

A free rod flies across at a fixed body, a body that can move, or another rod, in
parallel, slanted or end first, with steps of `stable_dt`. Contact is as stiff as it has
to be to hold the rod's kinetic energy before its centreline is at the surface, twice
over; a hundredth of that; or a ten thousandth. What is far too soft lets the rod
through: then a flag of `health` has to rise on the way. With enough stiffness a
parallel rod has to turn round.

Exits with 1 and lists rods that went through without a flag, and those that should have
turned round and did not.
"""

from __future__ import annotations

import itertools
import sys
import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod

R, LENGTH, N, DENSITY = 0.01, 0.2, 10, 1000.0
LINE = np.pi * R**2 * DENSITY
SPEEDS = (0.1, 10.0, 1000.0)
WAVES = (10.0, 1.0)
"""Speed of sound in the rod over its own [1]."""
SHARES = (2.0, 2e-2, 2e-4)
"""Stiffness over what holds a rod that flies in parallel."""
WAYS = {"parallel": 0.0, "slanted": 0.3, "end first": 0.5 * np.pi}
FIXED = {
    "plane": lambda: jaxrod.shapes.plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "sphere": lambda: jaxrod.shapes.sphere((0.0, -0.15, 0.0), 0.15),
    "cylinder": lambda: jaxrod.shapes.cylinder((0, -0.05, -1), (0, -0.05, 1), 0.05),
    "box": lambda: jaxrod.shapes.box((0.0, -0.05, 0.0), (0.4, 0.1, 0.4)),
}
RODS = ("rod_contact", "crossing_contact", "crossing_contact, lists")
MOVING = (*RODS, "body_contact")


def thrown(speed: float, angle: float, youngs_modulus: float) -> tuple[Any, Any]:
    """A free rod above the origin that flies down."""
    way = np.array([np.cos(angle), np.sin(angle), 0.0])
    low = 0.5 * LENGTH * np.sin(angle)
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=R,
        density=DENSITY,
        youngs_modulus=youngs_modulus,
        start=np.array([0.0, 1.5 * R + low, 0.0]) - 0.5 * LENGTH * way,
        direction=way,
        normal=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    down = jnp.zeros_like(state.velocities).at[1].set(-speed)
    return rod, replace(state, velocities=down)


@partial(jax.jit, static_argnames="steps")
def flight(model: Any, state: Any, dt: Any, steps: int) -> tuple[Any, Any]:
    """The rod's height, how near it is to another rod, and flags, at every step."""

    def forward(state: Any, k: Any) -> Any:
        state = jaxrod.advance(model, state, dt, 1, first=k)
        report = jaxrod.health(model, state, dt)
        own = state["a"] if isinstance(state, dict) else state
        near = jnp.inf
        if isinstance(state, dict) and isinstance(state["b"], jaxrod.RodState):
            # The other is across the plane of the flight.
            nodes = own.positions[:2]
            middles = 0.5 * (nodes[:, 1:] + nodes[:, :-1])
            points = jnp.concatenate([nodes, middles], axis=1)
            axis = jnp.mean(state["b"].positions[:2], axis=1, keepdims=True)
            near = jnp.min(jnp.linalg.norm(points - axis, axis=0))
        return state, (jnp.mean(own.positions[1]), near, report.flagged)

    return jax.lax.scan(forward, state, jnp.arange(steps))[1]


def shot(
    target: str, way: str, speed: float, sound: float, share: float
) -> tuple[float, bool, bool]:
    """Velocity at the end over that at the start, and flags.

    Returns:
        The mean velocity of the way back over the speed, whether the rod is beyond the
        target, and whether it was flagged.
    """
    youngs_modulus = DENSITY * (sound * speed) ** 2
    rod, state = thrown(speed, WAYS[way], youngs_modulus)
    stiffness = share * LINE * speed**2 / R**2
    scene = jaxrod.make_scene(rod)
    model: Any
    if target in FIXED:
        touch = jaxrod.contact(
            FIXED[target](), stiffness=stiffness, points_per_element=2
        )
        model, depth = jaxrod.make_scene(rod, touch), 0.1
    elif target == "body_contact":
        body, still = jaxrod.systems.rigid_body(
            jaxrod.shapes.sphere((0.0, -0.15, 0.0), 0.15), density=DENSITY
        )
        touch = jaxrod.systems.body_contact(
            "a", "b", stiffness=stiffness, points_per_element=2
        )
        state = {"a": state, "b": still}
        model, depth = (
            jaxrod.make_system({"a": scene, "b": body}, touch, state=state),
            0.3,
        )
    else:
        other, still = jaxrod.straight_rod(
            N,
            length=LENGTH,
            radius=R,
            density=100 * DENSITY,
            youngs_modulus=100 * youngs_modulus,
            start=(0.003, -R, -0.5 * LENGTH),
            direction=(0.0, 0.0, 1.0),
            dtype=jnp.float64,
        )
        state, depth = {"a": state, "b": still}, 4 * R
        if target == "rod_contact":
            touch = jaxrod.systems.rod_contact(
                "a", "b", stiffness=stiffness, points_per_element=2
            )
        else:
            listed = target.endswith("lists")
            touch = jaxrod.systems.crossing_contact(
                "a",
                "b",
                # A crossing is one spring: for the rod's whole mass.
                stiffness=stiffness * LENGTH,
                lists=jaxrod.systems.neighbour_lists(refresh_every=1, skin=1.0)
                if listed
                else None,
            )
        members = {"a": scene, "b": jaxrod.make_scene(other)}
        model = jaxrod.make_system(members, touch, state=state)
    state = jaxrod.with_memory(model, state)
    dt = float(jaxrod.stable_dt(model).dt)
    # The time in which it would fly through, and half as much again.
    steps = int(1.5 * (depth + LENGTH * np.sin(WAYS[way])) / (speed * dt))
    steps = 100 * max(1, min(steps, 40_000) // 100 + 1)
    heights, near, flags = flight(model, state, dt, steps)
    heights = np.asarray(heights)
    back = (heights[-1] - heights[-10]) / (9 * dt) / speed
    beyond = bool(heights[-1] < -depth)
    if target in RODS:
        # It may bend round the other, or slide off it: through is over its axis.
        beyond = beyond and bool(np.min(near) < 0.5 * R)
    return float(back), beyond, bool(np.any(flags))


def main() -> int:
    """Shoots all, prints each, and counts."""
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    tried = through = flagged = wrong = 0
    targets = (*FIXED, *MOVING)
    drawn = itertools.product(targets, WAYS, SPEEDS, WAVES, SHARES)
    for target, way, speed, sound, share in drawn:
        tried += 1
        back, beyond, flag = shot(target, way, speed, sound, share)
        note = ""
        if beyond and not flag:
            note = "   THROUGH, no flag"
        bounces = way == "parallel" and share == max(SHARES) and target not in RODS
        if bounces and not back > 0.1:
            note = "   DOES NOT TURN ROUND"
        through, flagged, wrong = through + beyond, flagged + flag, wrong + bool(note)
        print(
            f"{target}, {way}, {speed:g} m/s, sound {sound:g}, stiffness {share:g}: "
            f"back {back:.2f}{', through' if beyond else ''}"
            f"{', flagged' if flag else ''}{note}",
            flush=True,
        )
    print(f"{tried} tried, {through} went through, {flagged} flagged, {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
