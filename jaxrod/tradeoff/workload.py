"""Workload: a scene that can be built with any number of elements, and its controls."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from jaxrod.loaded_rod import check_scene_and_state
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.laws import Law
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.tradeoff.resampling import resample
from jaxrod.validation import check_array

Build = Callable[[int, Law], tuple[Scene, RodState]]
Act = Callable[[Scene], Callable[[jax.Array], Scene]]


def _unchanged(scene: Scene) -> Callable[[jax.Array], Scene]:
    return lambda control: scene


@dataclasses.dataclass(frozen=True, eq=False)
class Workload:
    """Simulation on which the error and the cost of settings are measured.

    Time is divided into control periods of a whole number of steps. `act` gives the
    scene during each period. At the end of each period the tip's position is recorded.

    Example:
        >>> work = tradeoff.swing()
        >>> work.name, work.plane, len(work.controls), round(work.duration, 3)
        ('swing', 'xy', 100, 1.0)
    """

    name: str
    """Name of the workload."""
    build: Build
    """`(n_elements, law) -> (scene, state)`: the scene without controls and its initial
    state, in float64."""
    period: float
    """Length of a control period [s]."""
    controls: np.ndarray
    """Controls of each period `(periods, controls)`; `(periods, 0)` for none."""
    act: Act = _unchanged
    """`scene -> (controls -> scene)`: called once with the scene, it returns a function
    from a period's controls to the scene during that period."""
    plane: PlaneName | None = None
    """Plane of all motion and loads; `None` if the motion is spatial."""

    @property
    def duration(self) -> float:
        """Simulated time: number of periods times `period` [s]."""
        return self.period * len(self.controls)


def workload_of(
    scene: Scene,
    state: RodState,
    *,
    duration: float = 1.0,
    periods: int = 50,
    name: str = "scene",
) -> Workload:
    """Makes a workload, on which `tune` measures, from a scene without controls.

    Args:
        scene: The scene; it is resampled to other numbers of elements, so numbers
            that vary along the rod are interpolated.
        state: Initial state of the rod of the scene.
        duration: Simulated time [s].
        periods: Number of periods, at whose ends the tip is recorded; no step is longer
            than a period.
        name: Name of the workload.

    Raises:
        ValueError: If `duration` is not positive, `scene` is not of the consistent law,
            `state` is not of its rod or not finite, or a part leaves the plane of a
            planar scene.
        TypeError: If `scene` is not a scene or `state` not a state.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.5, periods=10)
        >>> len(work.controls), round(work.period, 6)
        (10, 0.05)
    """
    check_scene_and_state(scene, state)
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state)):
        raise ValueError("state must be finite")
    check_array("duration", duration, [()], "s", positive=True)
    if not scene.method.has_energy:
        raise ValueError(
            "a scene of PyElastica's law has no setting to choose: its clamp and its "
            "law are wrong by more than its steps are"
        )
    scene.method.check_state(scene, state)
    with jax.enable_x64(True):
        scene, state = jax.tree.map(_double, (scene, state))
        plain = dataclasses.replace(scene, method=Consistent())

    def build(n_elements: int, law: Law) -> tuple[Scene, RodState]:
        if law != "consistent":
            raise ValueError("a scene must have the consistent law to be tuned")
        return resample(plain, state, n_elements)

    controls = np.zeros((periods, 0))
    plane = getattr(scene.method, "plane", None)
    return Workload(name, build, duration / periods, controls, plane=plane)


def _double(leaf: jax.Array) -> jax.Array:
    return jax.numpy.asarray(np.asarray(leaf, np.float64))
