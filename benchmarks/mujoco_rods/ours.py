"""The three scenes in jaxrod, in float64 with the steps of `stable_dt`."""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.mujoco_rods.problem import Problem, Run

METHODS: dict[str, Any] = {
    "in a plane": jaxrod.planar("zx"),
    "in space": jaxrod.consistent(),
}
"""Methods by what the table calls them."""
MASSES: dict[str, Any] = {"": "lumped", ", higher-order masses": "higher_order"}
"""Mass matrices by what the table adds."""


def build(
    problem: Problem, method: Any, mass_matrix: Any = "lumped"
) -> tuple[Any, Any]:
    """The scene and the state that it starts from."""
    scene = problem.scene
    numbers: dict[str, Any] = {
        "radius": scene.radius,
        "density": scene.density,
        "youngs_modulus": scene.youngs_modulus,
        "shear_modulus": scene.youngs_modulus / 3,
    }
    along = problem.rest[-1] - problem.rest[0]
    rod, _ = jaxrod.straight_rod(
        scene.n,
        length=scene.length,
        direction=along,
        mass_matrix=mass_matrix,
        **numbers,
    )
    _, state = jaxrod.rod_along(problem.start.T, **numbers)
    effects: list[Any] = []
    if problem.clamped:
        effects.append(jaxrod.clamp(state))
    else:
        effects += [jaxrod.pin_support(state, node) for node in problem.pinned]
    if problem.gravity:
        effects.append(jaxrod.gravity((0.0, 0.0, -problem.gravity)))
    if problem.force:
        effects.append(jaxrod.end_load((0.0, 0.0, problem.force)))
    if scene.damping:
        effects.append(jaxrod.exponential_damping(scene.damping))
    return jaxrod.make_scene(rod, *effects, method=method), state


def run(problem: Problem, method: Any, mass_matrix: Any = "lumped") -> Run:
    """Runs a problem twice, and measures both."""

    def step() -> tuple[Any, Any, float, int]:
        scene, state = build(problem, method, mass_matrix)
        steps = int(np.ceil(problem.interval / float(jaxrod.stable_dt(scene).dt)))
        return scene, state, problem.interval / steps, steps

    def move(scene: Any, state: Any, dt: float, steps: int) -> Any:
        states = jaxrod.rollout(scene, state, dt, problem.looks * steps, every=steps)
        return jax.block_until_ready(states)

    began = time.process_time()
    move(*step())
    first = time.process_time() - began
    made = step()
    began = time.process_time()
    states = move(*made)
    second = time.process_time() - began
    positions = np.asarray(jnp.swapaxes(states.positions, 1, 2))
    speed = float(jnp.max(jnp.linalg.norm(states.velocities[-1], axis=0)))
    return Run(positions[:, -1], positions[-1], speed, made[2], first, second)
