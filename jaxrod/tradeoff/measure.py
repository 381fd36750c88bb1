"""Error and cost of a setting: resolution, precision, law and method of a run.

Errors are measured against a converged reference.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxrod.analysis.stability import stable_dt
from jaxrod.methods.laws import Law
from jaxrod.rods.rod import compensated
from jaxrod.stepping.runs import advance
from jaxrod.tradeoff.reductions import (
    allowed,
    planar_by,
    unlimited,
    untwisted,
    with_scaled_inertia,
)
from jaxrod.tradeoff.workload import Workload
from jaxrod.validation import astype, check_count

REFERENCE_ELEMENTS = 160
REFERENCE_REFINEMENT = 8
FEWEST = 10
"""Smallest number of elements of a run that a reference is judged by."""
TINY = 1e-300
LEVELS = 3
"""Smallest number of runs, each with twice the elements of the one before, from which
the order of convergence is measured."""
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
    """Number of elements of the rod; in a system, of the rod that has most."""
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
    contact: float = 1.0
    """Stiffness of all contacts, divided by the given one [1]. Softer contact permits
    larger steps."""
    points: float = 1.0
    """Number of contact points per element, divided by the given one [1]; an element
    keeps at least one."""

    def __str__(self) -> str:
        """Describes the setting on one line."""
        words = [f"n = {self.n_elements}", self.integrator, self.dtype, self.mode]
        if self.dt is not None:
            words.insert(1, f"dt = {self.dt:.3g} s")
        if self.contact != 1:
            words.append(f"contact {self.contact:.3g} times as stiff")
        if self.points != 1:
            words.append(f"{self.points:.3g} of the contact points")
        return ", ".join([*words, *self.reductions])


@dataclass(frozen=True, eq=False)
class Prepared:
    """A workload built for a given setting, ready to run."""

    setting: Setting
    """The setting, with the step size used."""
    scene: Any
    """The scene or system, in the setting's floating-point type."""
    state: Any
    """The initial state."""
    substeps: int
    """Number of time steps per control period."""


def prepare(workload: Workload, setting: Setting) -> Prepared:
    """Builds the scene or system and the initial state of a workload for a setting.

    Args:
        workload: The workload.
        setting: The setting to build it with.

    Raises:
        ValueError: If the setting does not fit the workload: "planar" without a plane,
            "untwisted" although loads twist all rods, or implicit steps without a step
            size.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> ready = tradeoff.prepare(work, tradeoff.Setting(5))
        >>> ready.scene.rod.n_elements, round(ready.substeps * ready.setting.dt, 6)
        (5, 0.01)
    """
    if "planar" in setting.reductions and workload.plane is None:
        raise ValueError(f"{workload.name} does not move in a plane")
    with jax.enable_x64(True):
        scene, state = workload.build(setting.n_elements, setting.mode)
        if setting.contact != 1:
            scene = scene.softened(setting.contact)
        if setting.points != 1:
            scene = scene.thinned(setting.points)
        for reduction in ("inertia", "untwisted"):
            if reduction in setting.reductions:
                scene = _reduced(workload, scene, reduction)
        limit = float(stable_dt(scene, 1.0).dt)
        for reduction in ("planar", "implicit"):
            if reduction in (*setting.reductions, setting.integrator):
                scene = _reduced(workload, scene, reduction)
    dt = setting.dt
    if setting.integrator == "implicit":
        if dt is None:
            raise ValueError("an implicit setting needs a step dt [s], got None")
    elif dt is None:
        dt = setting.safety * limit
    substeps = max(1, math.ceil(workload.period / dt - 1e-9))
    with jax.enable_x64(setting.dtype == "float64"):
        scene, state = astype((scene, state), setting.dtype)
        if "compensated" in setting.reductions:
            state = _compensated(scene, state)
    chosen = dataclasses.replace(setting, dt=workload.period / substeps)
    return Prepared(chosen, scene, state, substeps)


def _reduced(workload: Workload, scene: Any, reduction: str) -> Any:
    """The scene or system with the reduction for all members that allow it.

    Raises:
        ValueError: If none allows it.
    """
    names = members_for(workload, reduction)
    if not names:
        raise ValueError(f"no rod of {workload.name} can be stepped {reduction!r}")
    change = _change(workload, reduction)
    members = scene.interfaces()
    return scene.with_members({name: change(members[name]) for name in names})


def _change(workload: Workload, reduction: str) -> Callable[[Any], Any]:
    """Function that makes a member of a workload one with a reduction."""
    if reduction == "planar" and workload.plane is not None:
        return planar_by(workload.plane)
    changes: dict[str, Callable[[Any], Any]] = {
        "inertia": with_scaled_inertia,
        "untwisted": untwisted,
        "implicit": unlimited,
    }
    return changes[reduction]


@lru_cache(maxsize=64)
def members_for(workload: Workload, reduction: str) -> tuple[str, ...]:
    """Names of the members of a workload that allow a reduction.

    They are asked once, with few elements, because each question is compiled.
    """
    with jax.enable_x64(True):
        scene, state = workload.build(workload.fits(4), "consistent")
        acted = workload.act(scene)(jnp.asarray(workload.controls[0]))
        return tuple(allowed(acted, state, _change(workload, reduction)))


def _compensated(scene: Any, state: Any) -> Any:
    """State whose rods have positions with compensated summation."""
    states = scene.states_by_name(state)
    rods = (k for k, own in states.items() if own.layout.is_rod)
    return scene.with_states(state, {k: compensated(states[k]) for k in rods})


def longest(scene: Any) -> float:
    """Rest length of the longest rod of a scene or system [m]."""
    rods = (own.rod for own in scene.interfaces().values())
    return max(
        float(np.max(np.sum(np.asarray(rod.rest_lengths), axis=-1)))
        for rod in rods
        if rod is not None
    )


@dataclass(frozen=True, eq=False)
class Reference:
    """Path of the recorded points in a fine simulation, to measure errors from.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> exact = tradeoff.reference(work, n_elements=20)
        >>> exact.tips.shape, exact.error < 1e-3  # both ends and the middle
        ((5, 3, 3), True)
    """

    tips: np.ndarray
    """Positions of the tip, or of the recorded points of a workload, at the ends of
    control periods, `(periods, 3)` or `(periods, points, 3)` [m]."""
    length: float
    """Length of the longest rod [m]."""
    error: float
    """Estimated error of `tips`, as that of a setting [1]. It is the change that all
    further refinements would cause, if the run converges in the measured order."""
    n_elements: int
    """Number of elements of the fine simulation."""
    dt: float
    """Step size of the fine simulation [s]."""
    order: float = 2.0
    """Order of convergence that the error is estimated with: the measured one, between
    1 and 2."""


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
    """Root mean square over time of the distance from the reference, of the recorded
    point where it is largest, divided by the length of the longest rod [1]; infinite if
    the run was not finite."""
    wall_s_per_sim_s: dict[int, float]
    """Wall-clock time per simulated second and rod [1], by batch size."""


def reference(
    workload: Workload, n_elements: int = REFERENCE_ELEMENTS, *, enough: float = 0.0
) -> Reference:
    """Simulates a workload finely in float64, and estimates the error of the result.

    Elements and steps are halved together in at least three runs. The ratio of the
    changes gives the order $p$ of convergence, and the last change divided by
    $2^p - 1$ the error. Joints and contact with dashpots can make it first order.

    Args:
        workload: The workload.
        n_elements: Largest number of elements of the reference; its step is an eighth
            of the stable one.
        enough: Error at which fewer elements suffice [1].

    Raises:
        ValueError: If `n_elements` is below 8, or a run is not finite.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.05, periods=5)
        >>> exact = tradeoff.reference(work, n_elements=20)
        >>> exact.n_elements, exact.tips.shape, exact.error < 1e-3
        (20, (5, 3, 3), True)
    """
    n_elements = check_count("n_elements", n_elements, 8)
    levels = LEVELS
    if enough > 0:
        levels = max(levels, int(math.log2(n_elements / FEWEST)) + 1)
    coarsest = workload.fits(-(-n_elements // 2 ** (levels - 1)))
    finest = Setting(
        coarsest * 2 ** (levels - 1), dtype="float64", safety=1 / REFERENCE_REFINEMENT
    )
    steps = -(-prepare(workload, finest).substeps // 2 ** (levels - 1))
    runs: list[np.ndarray] = []
    for level in range(levels):
        n, dt = coarsest * 2**level, workload.period / (steps * 2**level)
        prepared = prepare(workload, Setting(n, dt, "float64"))
        runs.append(tips_of(workload, prepared))
        if not np.all(np.isfinite(runs[-1])):
            raise ValueError(
                f"the reference of {n} elements is not finite, or its neighbour lists "
                "became too short: see jaxrod.health, and give lists more room"
            )
        if level + 1 < LEVELS:
            continue
        length = longest(prepared.scene)
        before = tip_error(runs[-3], runs[-2], length)
        change = tip_error(runs[-2], runs[-1], length)
        order = float(np.clip(np.log2(before / max(change, TINY)), 1, 2))
        error = change / (2**order - 1)
        if error <= enough:
            break
    return Reference(
        tips=runs[-1],
        length=length,
        error=error,
        n_elements=n,
        dt=dt,
        order=order,
    )


def tips_of(workload: Workload, prepared: Prepared) -> np.ndarray:
    """Simulates a workload; returns points recorded at the end of every control period.

    `prepared` has the scene and the steps of a setting. The result is `(periods, 3)`,
    or `(periods, points, 3)` [m].
    """
    with jax.enable_x64(prepared.setting.dtype == "float64"):
        args = _arguments(workload, prepared)
        return np.asarray(_run(workload, False, *args), np.float64)


def tip_error(tips: np.ndarray, exact: np.ndarray, length: float) -> float:
    """Root mean square over time of |tips - exact|, divided by `length` [1].

    It is that of the worst point, and infinite if points are not all finite.
    """
    squares = np.sum((tips - exact) ** 2, axis=-1)
    error = float(np.sqrt(np.max(np.mean(squares, axis=0)))) / length
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
) -> tuple[Any, Any, Array, Array, Array]:
    kind = jnp.dtype(prepared.setting.dtype)
    return (
        prepared.scene,
        prepared.scene.with_memory(prepared.state),
        jnp.asarray(workload.controls, kind),
        jnp.asarray(prepared.setting.dt, kind),
        jnp.asarray(prepared.substeps),
    )


@partial(jax.jit, static_argnums=(0, 1))
def _run(
    workload: Workload,
    batched: bool,
    scene: Any,
    state: Any,
    controls: Float[Array, "periods *batch controls"],
    dt: Array,
    substeps: Array,
) -> Float[Array, "periods *batch *points 3"]:
    """Recorded points after each control period [m]; if `batched`, of many rods.

    Leaves of `state` then have a leading batch axis. `controls` has the controls of
    each period, `substeps` is the number of time steps of length `dt` in a period.
    """
    act = workload.act(scene)

    def period(state: Any, control: Array, first: Array) -> tuple[Any, Array]:
        state = advance(act(control), state, dt, substeps, first=first)
        return state, workload.watch(scene, state)

    run = jax.vmap(period, in_axes=(0, 0, None)) if batched else period
    firsts = jnp.arange(len(controls), dtype=jnp.int32) * substeps.astype(jnp.int32)
    return lax.scan(lambda carry, now: run(carry, *now), state, (controls, firsts))[1]
