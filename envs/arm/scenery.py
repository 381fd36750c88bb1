"""What there is to see of a task: its arm, its target, what is in the way."""

from __future__ import annotations

from typing import Any, Protocol, TypeGuard

import jax
import numpy as np
from jaxtyping import UInt8

from jaxrod.envs.protocol import Environment
from jaxrod.viz import Cylinder, Replay, Sphere, frame


class Drawable(Environment, Protocol):
    """An environment with an arm and a target; see `drawable`."""

    @property
    def control_period(self) -> float:
        """Time between actions [s]."""


def drawable(env: Environment) -> TypeGuard[Drawable]:
    """Whether the environment has an arm and a target."""
    if not hasattr(env, "control_period"):
        return False
    params = jax.eval_shape(env.default_params)
    return hasattr(params, "rod") and hasattr(params, "target")


def obstacles(env: Environment) -> list[Cylinder]:
    """What is in the arm's way, where there is something."""
    if not hasattr(env, "obstacles"):
        return []
    cylinders = env.obstacles()
    return [
        Cylinder(start, end, float(radius))
        for start, end, radius in zip(
            np.asarray(cylinders.starts).T,
            np.asarray(cylinders.ends).T,
            cylinders.radii,
            strict=True,
        )
    ]


def picture(
    env: Drawable, params: Any, state: Any, seconds: float
) -> UInt8[np.ndarray, "480 640 3"]:
    """A still of one moment, always seen from the same place.

    Args:
        env: The environment.
        params: Its parameters.
        state: Its state.
        seconds: Time since the episode began [s].
    """
    nodes = np.asarray(state.arm.positions, float)
    # The view holds all that a straight arm reaches, so that it never moves: the
    # moments before the one that is drawn show the arm along every axis.
    arcs = np.concatenate([[0], np.cumsum(np.asarray(params.rod.rest_lengths, float))])
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    reach = nodes[None, :, :1] + axes[:, :, None] * arcs
    replay = Replay.from_rollout(
        np.concatenate([reach, nodes[None]]),
        np.asarray(params.rod.radii),
        np.arange(-len(reach), 1) + seconds,
        spheres=[
            Sphere(np.asarray(state.target.position), float(params.target.radius))
        ],
        cylinders=obstacles(env),
        up="y",
    )
    return frame(replay, -1)
