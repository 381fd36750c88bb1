"""The `clean` variants as problems for the trade-off between speed and accuracy.

The numbers of elements and steps of a task are chosen and recorded with these problems
(`python -m benchmarks clean_settings`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from importlib import resources
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod import RodState, Scene, consistent
from jaxrod.actuation import control_spline, spline_couples
from jaxrod.envs.arm.clean import CleanArm
from jaxrod.envs.arm.soft_arm import LENGTH
from jaxrod.envs.protocol import Drawable
from jaxrod.methods.laws import Law
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.tradeoff import Workload
from jaxrod.validation import Numbers


class CleanTask(Drawable, Protocol):
    """Parts of a benchmark task that a problem needs; all four tasks have them."""

    @property
    def variant(self) -> str:
        """Variant of the physics: "paper" or "clean"."""

    @property
    def n_elements(self) -> int:
        """Elements of the arm."""

    @property
    def substeps(self) -> int:
        """Simulation steps per control step."""

    @property
    def plane(self) -> PlaneName | None:
        """Plane of motion, if any."""

    def control_points(self) -> int | Numbers:
        """Number of control points, or their arc lengths [m]."""


RECORDED = {"tracking": "tracking_actions.npy"}
"""Tasks with recorded actions of a trained policy, and the file of each."""
STRENGTHS = {"reaching": 1.0, "structured": 0.3, "unstructured": 0.3}
"""Largest actions drawn for the other tasks. Full strength throws an arm about among
the obstacles. Its position after a second then depends on details beyond any
resolution."""


def clean_problem(
    task: CleanTask, actions: Float[np.ndarray, "periods actions"]
) -> Workload:
    """Workload of a task's arm and its obstacles, under recorded actions.

    Args:
        task: Task of the `clean` variant; the problem can then be built with any number
            of elements.
        actions: Actions, one for every control period; not clipped, as in the task.

    Raises:
        ValueError: If the task is not `clean`, or the actions are not of its size or
            not finite.
    """
    if task.variant != "clean":
        raise ValueError(f"task must be of the clean variant, got {task.variant!r}")
    shape = np.shape(actions)
    if len(shape) != 2 or shape[0] < 1 or shape[1] != task.action_size:
        raise ValueError(
            f"actions must have shape (periods, {task.action_size}), got {shape}"
        )
    if not np.all(np.isfinite(actions)):
        raise ValueError("actions must be finite")
    with jax.enable_x64(True):
        arm: CleanArm = task.default_params().arm
        controls = _controls(arm, np.asarray(actions, np.float64))
        couple_density = float(arm.couple_density)
    n_controls = arm.spline.n_controls

    def build(n_elements: int, law: Law) -> tuple[Scene, RodState]:
        if law != "consistent":
            raise ValueError("the clean variants have the consistent law only")
        # All four tasks are dataclasses, but their common protocol cannot state this.
        finer = dataclasses.replace(task, n_elements=n_elements)  # type: ignore[type-var]
        arm: CleanArm = finer.default_params().arm
        return dataclasses.replace(arm.scene(), method=consistent()), arm.rest

    def act(scene: Scene) -> Callable[[Array], Scene]:
        kind = scene.rod.rest_lengths.dtype
        spline = control_spline(task.control_points(), LENGTH, kind)
        averages = spline.averaged(scene.rod)

        def during(control: Array) -> Scene:
            couples = spline_couples(
                scene.rod,
                averages,
                jnp.reshape(control, (3, n_controls)),
                jnp.asarray(couple_density, control.dtype),
            )
            return dataclasses.replace(scene, effects=(*scene.effects, couples))

        return during

    period = task.control_period
    return Workload(task.name, build, period, controls, act, task.plane)


def recorded_actions(task: CleanTask, seed: int = 0) -> np.ndarray:
    """Actions of one second `(periods, actions)` for judging a task's settings.

    Tracking: actions of a trained policy, a third of them at their limits. The other
    tasks: random actions, redrawn every 0.1 s, up to `STRENGTHS`.

    Args:
        task: The task.
        seed: Seed of the random actions.
    """
    if task.name in RECORDED:
        file = resources.files("jaxrod.data") / RECORDED[task.name]
        with resources.as_file(file) as path:
            return np.load(path)[:714] / 127
    periods, held = 714, 72
    strength = STRENGTHS[task.name]
    draws = np.random.default_rng(seed).uniform(
        -strength, strength, (-(-periods // held), task.action_size)
    )
    return np.repeat(draws, held, axis=0)[:periods]


def _controls(arm: CleanArm, actions: np.ndarray) -> np.ndarray:
    """Rate-limited control values about all axes `(periods, 3 m)`."""
    n_controls = arm.spline.n_controls
    controls = np.zeros((len(actions), 3, n_controls))
    values = actions.reshape(len(actions), -1, n_controls)
    controls[:, : values.shape[1]] = values
    if arm.largest_change is not None:
        largest, now = float(arm.largest_change), np.zeros((3, n_controls))
        for control in controls:
            now = now + np.clip(control - now, -largest, largest)
            control[...] = now
    return controls.reshape(len(actions), -1)
