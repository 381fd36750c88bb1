"""Numbers of the three scenes, and the shapes that their rods start from.

Sideways is x and up is z. Nodes are arrays `(n + 1, 3)` [m].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from benchmarks.mujoco_rods import references

GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""
SHEAR_CORRECTION = 27 / 28
"""Timoshenko's factor of a circle, as jaxrod and PyElastica have it [1]."""
AMPLITUDE = 0.02
"""Displacement of the swinging tip at the start [m]."""
SPAN = 0.8
"""Distance between the two pins of the hanging cable [m]."""
TIP_FORCE = 7.5e-3
"""Force across the cantilever's tip [N]."""


class Scene(NamedTuple):
    """One rod and how long it moves."""

    name: str
    n: int
    """Number of elements."""
    radius: float
    """Radius [m]."""
    youngs_modulus: float
    """Young's modulus [Pa]; the shear modulus is a third of it."""
    damping: float
    """Rate at which velocities decay, everywhere alike [1/s]."""
    seconds: float
    """Duration of the motion [s]."""
    length: float = 1.0
    """Length at rest [m]."""
    density: float = 1000.0
    """Mass density [kg/m^3]."""

    @property
    def area(self) -> float:
        """Area of the section [m^2]."""
        return float(np.pi * self.radius**2)

    @property
    def stretching(self) -> float:
        """Stiffness EA of stretching [N]."""
        return self.youngs_modulus * self.area

    @property
    def shearing(self) -> float:
        """Stiffness of shearing, corrected for the section's shape [N]."""
        return SHEAR_CORRECTION * self.stretching / 3

    @property
    def bending(self) -> float:
        """Stiffness EI of bending [N m^2]."""
        return self.stretching * self.radius**2 / 4

    @property
    def weight(self) -> float:
        """Weight for each length at rest [N/m]."""
        return self.density * self.area * GRAVITY

    @property
    def places(self) -> np.ndarray:
        """Distances of the nodes from the first, along the rod at rest [m]."""
        return np.linspace(0.0, self.length, self.n + 1)


# The damping of the two that come to rest is near twice their lowest frequency
# [rad/s], where a motion dies fastest; at the end less than 1e-9 of it is left.
CANTILEVER = Scene("cantilever", 20, 0.02, 1e6, damping=2.2, seconds=20.0)
SWINGING = Scene("swinging cable", 50, 0.002, 1e7, damping=0.0, seconds=5.0)
HANGING = Scene("hanging cable", 50, 0.005, 1e6, damping=8.0, seconds=8.0)


def straight(scene: Scene) -> np.ndarray:
    """The unstretched rod, from the origin along x."""
    zero = np.zeros(scene.n + 1)
    return np.stack([scene.places, zero, zero], axis=1)


def hung(scene: Scene) -> np.ndarray:
    """The rod as it hangs from the origin, stretched by its weight."""
    s, zero = scene.places, np.zeros(scene.n + 1)
    longer = scene.weight / scene.stretching * (scene.length * s - s**2 / 2)
    return np.stack([zero, zero, -s - longer], axis=1)


def swung_aside(scene: Scene, amplitude: float = AMPLITUDE) -> np.ndarray:
    """The hung rod in its first mode, every element as long as it hangs."""
    swing = references.swing(
        scene.length, scene.bending, scene.weight, scene.stretching, GRAVITY
    )
    x = amplitude * swing.shape(scene.places)
    lengths = -np.diff(hung(scene)[:, 2])
    down = np.sqrt(lengths**2 - np.diff(x) ** 2)
    z = -np.concatenate([[0.0], np.cumsum(down)])
    return np.stack([x, 0 * x, z], axis=1)


def arc(scene: Scene) -> np.ndarray:
    """A circular arc as long as the rod, which sags between the two pins."""
    half = brentq(lambda a: np.sin(a) / a - SPAN / scene.length, 0.1, 3.0)
    angles = half * (2 * scene.places / scene.length - 1)
    radius = scene.length / (2 * half)
    x = SPAN / 2 + radius * np.sin(angles)
    z = radius * (np.cos(half) - np.cos(angles))
    return np.stack([x, 0 * x, z], axis=1)
