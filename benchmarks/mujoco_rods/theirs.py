"""The three scenes in PyElastica 1.0."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import jaxrod
from benchmarks.mujoco_rods import ours
from benchmarks.mujoco_rods.problem import Problem, Run


def build(problem: Problem, dt: float) -> tuple[Any, Any]:
    """PyElastica's simulator and its rod."""
    import elastica as ea

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
        """The features that the scenes need."""

    scene = problem.scene
    along = problem.rest[-1] - problem.rest[0]
    across = np.asarray([0.0, 1.0, 0.0])
    rod = ea.CosseratRod.straight_rod(
        scene.n,
        problem.rest[0],
        along / np.linalg.norm(along),
        across.copy(),
        scene.length,
        scene.radius,
        scene.density,
        youngs_modulus=scene.youngs_modulus,
        shear_modulus=scene.youngs_modulus / 3,
    )
    tangents = np.diff(problem.start, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    rod.position_collection[:] = problem.start.T
    rod.director_collection[0] = across[:, None]
    rod.director_collection[1] = np.cross(tangents, across).T
    rod.director_collection[2] = tangents.T
    simulator = Simulator()
    simulator.append(rod)
    if problem.clamped:
        simulator.constrain(rod).using(
            ea.OneEndFixedBC,
            constrained_position_idx=(0,),
            constrained_director_idx=(0,),
        )
    if problem.pinned:
        simulator.constrain(rod).using(
            ea.FixedConstraint, constrained_position_idx=problem.pinned
        )
    if problem.gravity:
        down = np.asarray([0.0, 0.0, -problem.gravity])
        simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=down)
    if problem.force:
        simulator.add_forcing_to(rod).using(
            ea.EndpointForces,
            np.zeros(3),
            np.asarray([0.0, 0.0, problem.force]),
            ramp_up_time=1e-9,
        )
    if scene.damping:
        simulator.dampen(rod).using(
            ea.AnalyticalLinearDamper,
            uniform_damping_constant=scene.damping,
            time_step=dt,
        )
    simulator.finalize()
    return simulator, rod


def run(problem: Problem) -> Run:
    """Runs a problem twice, and measures both.

    With 0.9 of the largest step at which its law is stable, by `jaxrod.stable_dt`.
    """
    import elastica as ea

    scene, _ = ours.build(problem, jaxrod.pyelastica())
    stable = float(jaxrod.stable_dt(scene, 0.9).dt)
    steps = int(np.ceil(problem.interval / stable))
    dt = problem.interval / steps

    def move(simulator: Any, rod: Any) -> np.ndarray:
        stepper, clock = ea.PositionVerlet(), np.float64(0.0)
        tips = [rod.position_collection[:, -1].copy()]
        for _ in range(problem.looks):
            for _ in range(steps):
                clock = stepper.step(simulator, clock, np.float64(dt))
            tips.append(rod.position_collection[:, -1].copy())
        return np.asarray(tips)

    began = time.process_time()
    move(*build(problem, dt))
    first = time.process_time() - began
    simulator, rod = build(problem, dt)
    began = time.process_time()
    tips = move(simulator, rod)
    second = time.process_time() - began
    speed = float(np.max(np.linalg.norm(rod.velocity_collection, axis=0)))
    return Run(tips, rod.position_collection.T.copy(), speed, dt, first, second)
