"""The `clean` variants as problems of the trade between speed and accuracy.

How many elements and steps a task is given is chosen and recorded with these
(`python benchmarks/clean_settings.py`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod import (
    ElementAverages,
    RodState,
    Scene,
    clamp,
    consistent,
    control_spline,
    spline_couples,
)
from jaxrod.effects.actuation import ElementCouples
from jaxrod.envs.arm.clean import CleanArm
from jaxrod.envs.arm.soft_arm import LENGTH
from jaxrod.envs.tasks.obstacle_task import ObstacleTask
from jaxrod.envs.tasks.reaching import Reaching
from jaxrod.envs.tasks.tracking import Tracking
from jaxrod.scene import Law
from jaxrod.tradeoff import Problem

CleanTask = Tracking | Reaching | ObstacleTask


def clean_problem(
    task: CleanTask, actions: Float[np.ndarray, "periods actions"]
) -> Problem:
    """The arm of a task, and what is in its way, under recorded actions.

    Args:
        task: A task of the `clean` variant; any number of elements can then be asked
            for.
        actions: One for every control period; as in the task, not clipped.

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
        arm = _arm(task)
        controls = _controls(arm, np.asarray(actions, np.float64))
        plane = task.plane if isinstance(task, ObstacleTask) else None
        couple_density = float(arm.couple_density)
    points = task.control_points() if isinstance(task, ObstacleTask) else None
    n_controls = arm.spline.n_controls

    def build(n_elements: int, law: Law) -> tuple[Scene, RodState]:
        if law != "consistent":
            raise ValueError("the clean variants have the consistent law only")
        arm = _arm(dataclasses.replace(task, n_elements=n_elements))
        scene = arm.scene(jnp.zeros((3, n_controls), arm.rod.radii.dtype))
        return dataclasses.replace(scene, method=consistent()), arm.rest

    def act(scene: Scene) -> Callable[[Array], Scene]:
        spline = control_spline(
            n_controls if points is None else points,
            LENGTH,
            scene.rod.rest_lengths.dtype,
        )
        averages = spline.averaged(scene.rod)

        def during(control: Array) -> Scene:
            couples = spline_couples(
                scene.rod,
                averages,
                jnp.reshape(control, (3, n_controls)),
                jnp.asarray(couple_density, control.dtype),
            )
            effects = tuple(
                couples if isinstance(effect, ElementCouples) else effect
                for effect in scene.effects
            )
            return dataclasses.replace(scene, effects=effects)

        return during

    return Problem(task.name, build, task.control_period, controls, act, plane)


def recorded_actions(task: CleanTask, seed: int = 0) -> np.ndarray:
    """Actions of one second `(periods, actions)` to judge a task's settings by.

    Tracking: those of a trained policy, a third of them at their limits. Reaching:
    drawn anew every 0.1 s, up to full strength. Among obstacles: likewise, up to 0.3
    of full strength; full strength throws the arm about among them, and where it is
    after a second then depends on details beyond any resolution.

    Args:
        task: The task.
        seed: Of what is drawn.
    """
    if isinstance(task, Tracking):
        name = "tracking_actions.npy"
        with resources.as_file(resources.files("jaxrod.data") / name) as path:
            return np.load(path)[:714] / 127
    periods, held = 714, 72
    strength = 0.3 if isinstance(task, ObstacleTask) else 1.0
    draws = np.random.default_rng(seed).uniform(
        -strength, strength, (-(-periods // held), task.action_size)
    )
    return np.repeat(draws, held, axis=0)[:periods]


def _arm(task: CleanTask) -> CleanArm:
    """The arm of a task and all that acts on it, in JAX's default precision."""
    if isinstance(task, Tracking):
        params = task.default_params()
        assert isinstance(params.spline, ElementAverages)
        return CleanArm(
            rod=params.rod,
            rest=params.rest,
            held=clamp(params.rest),
            viscosity=params.viscosity,
            spline=params.spline,
            couple_density=params.torque,
            largest_change=None,
        )
    arm = task.default_params().arm
    assert isinstance(arm, CleanArm)
    return arm


def _controls(arm: CleanArm, actions: np.ndarray) -> np.ndarray:
    """Control values about all axes, as fast as they may change `(periods, 3 m)`."""
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
