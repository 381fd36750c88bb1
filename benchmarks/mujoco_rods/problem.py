"""The problem that every simulator is given, and the run that it gives back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.mujoco_rods import scenes
from benchmarks.mujoco_rods.scenes import Scene


class Problem(NamedTuple):
    """One scene with its ends, its loads and its start."""

    scene: Scene
    rest: np.ndarray
    """Nodes without load `(n + 1, 3)` [m]."""
    start: np.ndarray
    """Nodes where it is released, at rest `(n + 1, 3)` [m]."""
    pinned: tuple[int, ...] = ()
    """Nodes that stay where they start."""
    clamped: bool = False
    """Whether a wall holds the first end."""
    gravity: float = 0.0
    """Gravitational acceleration, downwards [m/s^2]."""
    force: float = 0.0
    """Force on the last node, upwards [N]."""
    looks: int = 1
    """Looks at the tip after the one at the start."""

    @property
    def interval(self) -> float:
        """Time between two looks [s]."""
        return self.scene.seconds / self.looks


class Run(NamedTuple):
    """The motion that one simulator made of a problem, and its cost."""

    tips: np.ndarray
    """Positions of the last node, one for each look `(looks + 1, 3)` [m]."""
    nodes: np.ndarray
    """Nodes at the end `(n + 1, 3)` [m]."""
    speed: float
    """Largest speed of a node at the end [m/s]."""
    dt: float
    """Time step [s]."""
    first: float
    """Processor time of building and running it, compiling included [s]."""
    second: float
    """Processor time of running it again [s]."""


def cantilever() -> Problem:
    """The cantilever, from straight to rest."""
    rest = scenes.straight(scenes.CANTILEVER)
    force = scenes.TIP_FORCE
    return Problem(scenes.CANTILEVER, rest, rest, clamped=True, force=force)


def swinging(amplitude: float = scenes.AMPLITUDE) -> Problem:
    """The swinging cable, sampled a hundred times a second."""
    scene = scenes.SWINGING
    x, y, z = scenes.straight(scene).T
    return Problem(
        scene,
        np.stack([z, y, -x], axis=1),
        scenes.swung_aside(scene, amplitude),
        pinned=(0,),
        gravity=scenes.GRAVITY,
        looks=round(100 * scene.seconds),
    )


def hanging() -> Problem:
    """The hanging cable, from an arc to rest."""
    scene = scenes.HANGING
    return Problem(
        scene,
        scenes.straight(scene),
        scenes.arc(scene),
        pinned=(0, scene.n),
        gravity=scenes.GRAVITY,
    )
