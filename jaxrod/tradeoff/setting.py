"""A setting: all choices of a simulation that trade speed for accuracy."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.analysis.inertia_scaling import scale_inertia
from jaxrod.analysis.stability import stable_dt
from jaxrod.methods.implicit import implicit
from jaxrod.methods.laws import IN_SPACE, Law
from jaxrod.methods.planar import planar
from jaxrod.methods.torsion_free import torsion_free
from jaxrod.rods.rod import RodState, compensated
from jaxrod.scene import Scene
from jaxrod.tradeoff.problem import Problem

Integrator = Literal["explicit", "implicit"]
Reduction = Literal["planar", "untwisted", "inertia", "compensated"]


@dataclass(frozen=True)
class Setting:
    """Number of elements, step, precision, law, integrator and reductions of a run."""

    n_elements: int
    """Number of elements."""
    dt: float | None = None
    """Step size [s]; `None` for the largest stable one that divides the control period,
    with the safety factor below."""
    dtype: str = "float32"
    """Floating-point type, "float32" or "float64"."""
    mode: Law = "consistent"
    """Elastic law, "consistent" or "pyelastica"."""
    integrator: Integrator = "explicit"
    """Integrator, "explicit" or "implicit"."""
    reductions: tuple[Reduction, ...] = ()
    """Any of "planar" (motion in a plane), "untwisted" (without twist), "inertia"
    (enlarged transverse inertia), "compensated" (compensated positions)."""
    safety: float = 0.9
    """Fraction of the stability limit if `dt` is `None`."""

    def __str__(self) -> str:
        """Description in words."""
        words = [f"n = {self.n_elements}", self.integrator, self.dtype, self.mode]
        if self.dt is not None:
            words.insert(1, f"dt = {self.dt:.3g} s")
        return ", ".join([*words, *self.reductions])


@dataclass(frozen=True, eq=False)
class Prepared:
    """A problem built with a setting, ready to run."""

    setting: Setting
    """The setting, with its step size filled in."""
    scene: Scene
    """The scene, in the setting's type."""
    state: RodState
    """The initial state."""
    substeps: int
    """Steps per control period."""


def prepare(problem: Problem, setting: Setting) -> Prepared:
    """Builds a problem with a setting.

    Args:
        problem: The problem.
        setting: The setting.

    Raises:
        ValueError: If the setting does not fit the problem: "planar" without a plane,
            "untwisted" although something twists, or implicit steps without a step
            size.
    """
    with jax.enable_x64(True):
        scene, state = problem.build(setting.n_elements, setting.mode)
        if "untwisted" in setting.reductions:
            scene = dataclasses.replace(scene, method=torsion_free())
            scene.method.check(scene)
        if "inertia" in setting.reductions:
            scene = scale_inertia(scene).scene
        limit = float(stable_dt(scene, 1.0).dt)
    dt = setting.dt
    if setting.integrator == "implicit":
        if dt is None:
            raise ValueError("an implicit setting needs a step dt [s], got None")
    elif dt is None:
        dt = setting.safety * limit
    substeps = max(1, math.ceil(problem.period / dt - 1e-9))
    with jax.enable_x64(setting.dtype == "float64"):
        kind = jnp.dtype(setting.dtype)
        scene, state = jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf), kind), (scene, state)
        )
        if "planar" in setting.reductions:
            if problem.plane is None:
                raise ValueError(f"{problem.name} has no plane that it stays in")
            method = planar(problem.plane, IN_SPACE[setting.mode])
            scene = dataclasses.replace(scene, method=method)
        if setting.integrator == "implicit":
            scene = dataclasses.replace(scene, method=implicit())
        if "compensated" in setting.reductions:
            state = compensated(state)
    chosen = dataclasses.replace(setting, dt=problem.period / substeps)
    return Prepared(chosen, scene, state, substeps)


def may_be_untwisted(problem: Problem) -> bool:
    """Whether nothing twists the rod of a problem, controls included."""
    with jax.enable_x64(True):
        scene, _ = problem.build(4, "consistent")
        acted = problem.act(scene)(jnp.asarray(problem.controls[0]))
        try:
            torsion_free().check(acted)
        except ValueError:
            return False
    return True
