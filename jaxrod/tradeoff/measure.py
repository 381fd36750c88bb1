"""Error and cost of a setting: resolution, precision, law and method of a run.

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
"""Number of control periods, summed over a batch of rods, that one timed call runs: at
most the workload's, and at least two per rod."""
Integrator = Literal["explicit", "implicit"]
Reduction = Literal["planar", "untwisted", "inertia", "compensated"]


@dataclass(frozen=True)
class Setting:
    """Numerical setting of a run: resolution, precision, law, integrator, reductions.

    Example:
        >>> setting = tradeoff.Setting(12, dtype="float64", reductions=("planar",))
        >>> str(setting)
        'n = 12, explicit, float64, consistent, planar'
    """

    n_elements: int
    """Number of elements of the rod."""
    dt: float | None = None
    """Step size [s], reduced so that it divides the control period; `None` for `safety`
    times the largest stable step."""
    dtype: str = "float32"
    """Floating-point type, "float32" or "float64"."""
    mode: Law = "consistent"
    """Elastic law, "consistent" or "pyelastica"."""
    integrator: Integrator = "explicit"
    """Integrator, "explicit" or "implicit"."""
    reductions: tuple[Reduction, ...] = ()
    """Cheaper or more precise methods: "planar" (motion in a plane), "untwisted"
    (without twist), "inertia" (enlarged transverse rotary inertia), "compensated"
    (positions with compensated summation)."""
    safety: float = 0.9
    """Step size as a fraction of the stability limit, if `dt` is `None` [1]."""

    def __str__(self) -> str:
        """Describes the setting on one line."""
        words = [f"n = {self.n_elements}", self.integrator, self.dtype, self.mode]
        if self.dt is not None:
            words.insert(1, f"dt = {self.dt:.3g} s")
        return ", ".join([*words, *self.reductions])


@dataclass(frozen=True, eq=False)
class Prepared:
    """A workload built for a given setting, ready to run."""

    setting: Setting
    """The setting, with the step size used."""
    scene: Scene
    """The scene, in the setting's floating-point type."""
    state: RodState
    """The initial state."""
    substeps: int
    """Number of time steps per control period."""


def prepare(workload: Workload, setting: Setting) -> Prepared:
    """Builds the scene and initial state of a workload for a setting.

    Args:
        workload: The workload.
        setting: The setting to build it with.

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
    """Whether no load or control of a workload twists its rod."""
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
    """Path of the tip from a fine simulation, from which errors are measured.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> exact = tradeoff.reference(work, n_elements=20)
        >>> exact.tips.shape, exact.error < 1e-3
        ((5, 3), True)
    """

    tips: np.ndarray
    """Positions of the tip at the ends of control periods `(periods, 3)` [m]."""
    length: float
    """Length of the rod [m]."""
    error: float
    """Estimated error of `tips`: root mean square over time, divided by the rod's
    length [1]. It is a quarter of the difference from a run with half the elements: the
    change that another refinement would cause, for a second-order method."""
    n_elements: int
    """Number of elements of the fine simulation."""
    dt: float
    """Step size of the fine simulation [s]."""


@dataclass(frozen=True)
class Measurement:
    """Error and cost of one setting, measured by `measure`.

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
    """Root mean square over time of the tip's distance from the reference, divided by
    the rod's length [1]; infinite if the run was not finite."""
    wall_s_per_sim_s: dict[int, float]
    """Wall-clock time per simulated second and rod [1], by batch size."""


def reference(workload: Workload, n_elements: int = REFERENCE_ELEMENTS) -> Reference:
    """Simulates a workload finely in float64, and estimates the error of the result.

    Args:
        workload: The workload.
        n_elements: Number of elements of the reference; its step is an eighth of the
            stable one. Its error follows from a run with half the elements, at a
            quarter of the stable step of that run.

    Raises:
        ValueError: If `n_elements` is below 4.

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
    """Simulates a workload; returns the tip at the end of every control period.

    `prepared` has the scene and the steps of a setting. The result is `(periods, 3)`
    [m].
    """
    with jax.enable_x64(prepared.setting.dtype == "float64"):
        args = _arguments(workload, prepared)
        return np.asarray(_run(workload, False, *args), np.float64)


def tip_error(tips: np.ndarray, exact: np.ndarray, length: float) -> float:
    """Root mean square over time of |tips - exact|, divided by `length` [1].

    It is infinite if the tips are not all finite.
    """
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
    """Measures the error and the cost of a setting.

    Args:
        workload: The workload.
        setting: The setting to measure.
        exact: Reference of the workload, from `reference`.
        batches: Batch sizes (numbers of rods) to time the setting with.
        seconds: Time spent on timing each batch [s]. The result is the median of five
            repetitions, or a single run if one run takes longer than this time.

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
    """Measures wall-clock time per simulated second and rod [1], without compilation.

    Args:
        workload: The workload.
        prepared: The workload, built with the setting that is timed.
        batch: Number of rods that are simulated at the same time.
        seconds: Time spent on timing [s].
    """
    with jax.enable_x64(prepared.setting.dtype == "float64"):
        scene, state, controls, dt, substeps = _arguments(workload, prepared)
        # For many rods a few periods suffice. One rod runs all periods: a call's
        # overhead is as long as a thousand of the smallest steps.
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
        # A run that takes longer than `seconds` is not repeated.
        repeats = WINDOWS if single < seconds else 0
        windows = [sum(once() for _ in range(rounds)) for _ in range(repeats)]
    simulated = rounds * periods * workload.period * batch
    return statistics.median(windows or [single]) / simulated


def _repeated(batch: int, leaf: Array) -> Array:
    """Repeats an array `batch` times along a new leading axis."""
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
    """Positions of the tip after each control period [m]; if `batched`, of many rods.

    Leaves of `state` then have a leading batch axis. `controls` has the controls of
    each period, `substeps` is the number of time steps of length `dt` in a period.
    """
    act = workload.act(scene)

    def period(state: RodState, control: Array) -> tuple[RodState, Array]:
        state = advance(act(control), state, dt, substeps)
        return state, state.tip

    return lax.scan(jax.vmap(period) if batched else period, state, controls)[1]
