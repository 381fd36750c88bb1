"""Settings, which trade speed for accuracy: their error and their cost.

Errors are measured against a converged reference.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxrod.analysis.inertia_scaling import scale_inertia
from jaxrod.analysis.stability import stable_dt
from jaxrod.methods.implicit import implicit
from jaxrod.methods.laws import IN_SPACE, Law
from jaxrod.methods.planar import planar
from jaxrod.methods.torsion_free import torsion_free
from jaxrod.rods.rod import RodState, compensated
from jaxrod.scene import Scene
from jaxrod.stepping.runs import advance
from jaxrod.tradeoff.workload import Workload

REFERENCE_ELEMENTS = 160
REFERENCE_REFINEMENT = 8
WINDOWS = 5
TIMED_PERIODS = 1280
"""Largest total of control periods timed in one call of a batch."""
Integrator = Literal["explicit", "implicit"]
Reduction = Literal["planar", "untwisted", "inertia", "compensated"]


@dataclass(frozen=True)
class Setting:
    """Number of elements, step, precision, law, integrator and reductions of a run.

    Example:
        >>> setting = tradeoff.Setting(12, dtype="float64", reductions=("planar",))
        >>> str(setting)
        'n = 12, explicit, float64, consistent, planar'
    """

    n_elements: int
    """Number of elements."""
    dt: float | None = None
    """Step size [s]; `None` for the largest stable step that divides the control
    period, times the safety factor below."""
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
        """Description as text."""
        words = [f"n = {self.n_elements}", self.integrator, self.dtype, self.mode]
        if self.dt is not None:
            words.insert(1, f"dt = {self.dt:.3g} s")
        return ", ".join([*words, *self.reductions])


@dataclass(frozen=True, eq=False)
class Prepared:
    """A workload built with a setting, ready to run."""

    setting: Setting
    """The setting, with its step size filled in."""
    scene: Scene
    """The scene, in the setting's type."""
    state: RodState
    """The initial state."""
    substeps: int
    """Steps per control period."""


def prepare(workload: Workload, setting: Setting) -> Prepared:
    """Builds a workload with a setting.

    Args:
        workload: The workload.
        setting: The setting.

    Raises:
        ValueError: If the setting does not fit the workload: "planar" without a plane,
            "untwisted" although a load twists the rod, or implicit steps without a step
            size.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> ready = tradeoff.prepare(work, tradeoff.Setting(5))
        >>> ready.scene.rod.n_elements, round(ready.substeps * ready.setting.dt, 6)
        (5, 0.01)
    """
    with jax.enable_x64(True):
        scene, state = workload.build(setting.n_elements, setting.mode)
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
    substeps = max(1, math.ceil(workload.period / dt - 1e-9))
    with jax.enable_x64(setting.dtype == "float64"):
        kind = jnp.dtype(setting.dtype)
        scene, state = jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf), kind), (scene, state)
        )
        if "planar" in setting.reductions:
            if workload.plane is None:
                raise ValueError(f"{workload.name} has no plane that it stays in")
            method = planar(workload.plane, IN_SPACE[setting.mode])
            scene = dataclasses.replace(scene, method=method)
        if setting.integrator == "implicit":
            scene = dataclasses.replace(scene, method=implicit())
        if "compensated" in setting.reductions:
            state = compensated(state)
    chosen = dataclasses.replace(setting, dt=workload.period / substeps)
    return Prepared(chosen, scene, state, substeps)


def may_be_untwisted(workload: Workload) -> bool:
    """Whether nothing twists the rod of a workload, controls included."""
    with jax.enable_x64(True):
        scene, _ = workload.build(4, "consistent")
        acted = workload.act(scene)(jnp.asarray(workload.controls[0]))
        try:
            torsion_free().check(acted)
        except ValueError:
            return False
    return True


@dataclass(frozen=True, eq=False)
class Reference:
    """Finely computed path of the tip, which the paths of settings are compared to.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> exact = tradeoff.reference(work, n_elements=20)
        >>> exact.tips.shape, exact.error < 1e-3
        ((5, 3), True)
    """

    tips: np.ndarray
    """Tip at the end of every control period `(periods, 3)` [m]."""
    length: float
    """Length of the rod [m]."""
    error: float
    """Estimated error: root mean square over time, in lengths of the rod. It is a
    quarter of the difference from a run of half the resolution: the change that the
    next refinement would cause (second order)."""
    n_elements: int
    """Number of elements."""
    dt: float
    """Step size [s]."""


@dataclass(frozen=True)
class Measurement:
    """One point of the trade-off.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> exact = tradeoff.reference(work, n_elements=20)
        >>> found = tradeoff.measure(work, tradeoff.Setting(5), exact, seconds=0.01)
        >>> found.error < 0.05, list(found.wall_s_per_sim_s)  # one rod was timed
        (True, [1])
    """

    setting: Setting
    """The setting, with the step size that was used."""
    error: float
    """Root mean square over time of the tip's distance from the reference, in lengths
    of the rod; infinite if the run was not finite."""
    wall_s_per_sim_s: dict[int, float]
    """Wall-clock time per simulated second and rod [1], for every batch size that was
    timed."""


def reference(workload: Workload, n_elements: int = REFERENCE_ELEMENTS) -> Reference:
    """Simulates a workload finely in float64, and estimates the error of the result.

    Args:
        workload: The workload.
        n_elements: Elements of the reference; its step is an eighth of the stable one.
            It is compared with a run of half the elements and twice the step.

    Raises:
        ValueError: If `n_elements` is below 4, so that half of it is no rod.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> exact = tradeoff.reference(work, n_elements=20)
        >>> exact.n_elements, exact.tips.shape, exact.error < 1e-3
        (20, (5, 3), True)
    """
    runs = []
    for n, refinement in (
        (n_elements // 2, REFERENCE_REFINEMENT // 2),
        (n_elements, REFERENCE_REFINEMENT),
    ):
        fine = Setting(n, dtype="float64", safety=1 / refinement)
        prepared = prepare(workload, fine)
        runs.append((prepared, tips_of(workload, prepared)))
    (_, coarse), (prepared, tips) = runs
    length = float(np.sum(np.asarray(prepared.scene.rod.rest_lengths)))
    assert prepared.setting.dt is not None
    return Reference(
        tips=tips,
        length=length,
        error=tip_error(coarse, tips, length) / 4,
        n_elements=n_elements,
        dt=prepared.setting.dt,
    )


def tips_of(workload: Workload, prepared: Prepared) -> np.ndarray:
    """Tip at the end of every control period `(periods, 3)` [m]."""
    with jax.enable_x64(prepared.setting.dtype == "float64"):
        args = _arguments(workload, prepared)
        return np.asarray(_run(workload, False, *args), np.float64)


def tip_error(tips: np.ndarray, exact: np.ndarray, length: float) -> float:
    """Root mean square over time of the distance, in lengths of the rod."""
    squares = np.sum((tips - exact) ** 2, axis=1)
    error = float(np.sqrt(np.mean(squares))) / length
    return error if np.isfinite(error) else float("inf")


def measure(
    workload: Workload,
    setting: Setting,
    exact: Reference,
    *,
    batches: tuple[int, ...] = (1,),
    seconds: float = 0.3,
) -> Measurement:
    """Measures error and cost of a setting.

    Args:
        workload: The workload.
        setting: The setting.
        exact: The workload's reference.
        batches: Batch sizes to time it with, each rod with its own controls; on one
            core if JAX has one device.
        seconds: Time spent on timing each batch [s]. The result is the median of five
            windows, or a single run if that takes longer.

    Raises:
        ValueError: If the setting does not fit the workload, as in `prepare`.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> exact = tradeoff.reference(work, n_elements=20)
        >>> coarse = tradeoff.measure(work, tradeoff.Setting(4), exact, seconds=0.01)
        >>> fine = tradeoff.measure(work, tradeoff.Setting(10), exact, seconds=0.01)
        >>> fine.error < coarse.error
        True
    """
    prepared = prepare(workload, setting)
    error = tip_error(tips_of(workload, prepared), exact.tips, exact.length)
    costs = {batch: cost(workload, prepared, batch, seconds) for batch in batches}
    return Measurement(prepared.setting, error, costs)


def cost(
    workload: Workload, prepared: Prepared, batch: int, seconds: float = 0.3
) -> float:
    """Wall-clock time per simulated second and rod [1], without compilation."""
    with jax.enable_x64(prepared.setting.dtype == "float64"):
        scene, state, controls, dt, substeps = _arguments(workload, prepared)
        # For many rods a few periods suffice. One rod runs all periods: the overhead of
        # a call is more than a thousand of the smallest steps.
        periods = min(len(workload.controls), max(2, TIMED_PERIODS // batch))
        controls = controls[:periods]
        run = partial(_run, workload, batch > 1)
        if batch > 1:
            state = jax.tree.map(partial(_repeated, batch), state)
            controls = jnp.swapaxes(_repeated(batch, controls), 0, 1)

        def once() -> float:
            start = time.perf_counter()
            jax.block_until_ready(run(scene, state, controls, dt, substeps))
            return time.perf_counter() - start

        once()
        single = once()
        rounds = max(1, int(seconds / WINDOWS / single))
        # A run that is longer than all windows together is not repeated.
        repeats = WINDOWS if single < seconds else 0
        windows = [sum(once() for _ in range(rounds)) for _ in range(repeats)]
    simulated = rounds * periods * workload.period * batch
    return statistics.median(windows or [single]) / simulated


def _repeated(batch: int, leaf: Array) -> Array:
    """Copies of an array along a new leading axis."""
    return jnp.broadcast_to(leaf, (batch, *leaf.shape))


def _arguments(
    workload: Workload, prepared: Prepared
) -> tuple[Scene, RodState, Array, Array, Array]:
    kind = prepared.state.positions.dtype
    return (
        prepared.scene,
        prepared.state,
        jnp.asarray(workload.controls, kind),
        jnp.asarray(prepared.setting.dt, kind),
        jnp.asarray(prepared.substeps),
    )


@partial(jax.jit, static_argnums=(0, 1))
def _run(
    workload: Workload,
    batched: bool,
    scene: Scene,
    state: RodState,
    controls: Float[Array, "periods *batch controls"],
    dt: Array,
    substeps: Array,
) -> Float[Array, "periods *batch 3"]:
    """Path of the tip; if `batched`, for many rods, each with its own controls."""
    act = workload.act(scene)

    def period(state: RodState, control: Array) -> tuple[RodState, Array]:
        state = advance(act(control), state, dt, substeps)
        return state, state.tip

    return lax.scan(jax.vmap(period) if batched else period, state, controls)[1]
