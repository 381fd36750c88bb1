"""Error of a setting against a converged reference, and its cost."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.stepping.runs import advance
from jaxrod.tradeoff.problem import Problem
from jaxrod.tradeoff.setting import Prepared, Setting, prepare

REFERENCE_ELEMENTS = 160
REFERENCE_REFINEMENT = 8
WINDOWS = 5
TIMED_PERIODS = 1280
"""Largest total of control periods timed in one call of a batch."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Path of the tip with which settings are compared."""

    tips: np.ndarray
    """Tip at the end of every control period `(periods, 3)` [m]."""
    length: float
    """Length of the rod [m]."""
    error: float
    """Estimated error: root mean square over time, in lengths of the rod. It is a
    quarter of the difference from a reference of half the resolution, which is how much
    the next refinement would change it (second order)."""
    n_elements: int
    """Number of elements."""
    dt: float
    """Step size [s]."""


@dataclass(frozen=True)
class Measurement:
    """One point of the trade-off."""

    setting: Setting
    """The setting, with the step size that was used."""
    error: float
    """Root mean square over time of the tip's distance from the reference, in lengths
    of the rod; infinite if the run was not finite."""
    wall_s_per_sim_s: dict[int, float]
    """Wall-clock time per simulated second and rod [1], for every batch size that was
    timed."""


def reference(problem: Problem, n_elements: int = REFERENCE_ELEMENTS) -> Reference:
    """Simulates a problem finely in float64, and estimates the error of the result.

    Args:
        problem: The problem.
        n_elements: Elements of the reference; its step is an eighth of the stable one.
            It is compared with a run of half the elements and twice the step.
    """
    runs = []
    for n, refinement in (
        (n_elements // 2, REFERENCE_REFINEMENT // 2),
        (n_elements, REFERENCE_REFINEMENT),
    ):
        fine = Setting(n, dtype="float64", safety=1 / refinement)
        prepared = prepare(problem, fine)
        runs.append((prepared, tips_of(problem, prepared)))
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


def tips_of(problem: Problem, prepared: Prepared) -> np.ndarray:
    """Tip at the end of every control period `(periods, 3)` [m]."""
    with jax.enable_x64(prepared.setting.dtype == "float64"):
        args = _arguments(problem, prepared)
        return np.asarray(_run(problem, False, *args), np.float64)


def tip_error(tips: np.ndarray, exact: np.ndarray, length: float) -> float:
    """Root mean square over time of the distance, in lengths of the rod."""
    squares = np.sum((tips - exact) ** 2, axis=1)
    error = float(np.sqrt(np.mean(squares))) / length
    return error if np.isfinite(error) else float("inf")


def measure(
    problem: Problem,
    setting: Setting,
    exact: Reference,
    *,
    batches: tuple[int, ...] = (1,),
    seconds: float = 0.3,
) -> Measurement:
    """Measures error and cost of a setting.

    Args:
        problem: The problem.
        setting: The setting.
        exact: The problem's reference.
        batches: Batch sizes to time it with, each rod with its own controls; on one
            core if JAX has one device.
        seconds: Time spent on timing each batch [s]. The result is the median of five
            windows, or a single run if that takes longer.
    """
    prepared = prepare(problem, setting)
    error = tip_error(tips_of(problem, prepared), exact.tips, exact.length)
    costs = {batch: cost(problem, prepared, batch, seconds) for batch in batches}
    return Measurement(prepared.setting, error, costs)


def cost(
    problem: Problem, prepared: Prepared, batch: int, seconds: float = 0.3
) -> float:
    """Wall-clock time per simulated second and rod [1], without compilation."""
    with jax.enable_x64(prepared.setting.dtype == "float64"):
        scene, state, controls, dt, substeps = _arguments(problem, prepared)
        # For many rods a few periods suffice. One rod runs all periods: the overhead of
        # a call is more than a thousand of the smallest steps.
        periods = min(len(problem.controls), max(2, TIMED_PERIODS // batch))
        controls = controls[:periods]
        run = partial(_run, problem, batch > 1)
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
        # A run longer than all windows together need not be repeated.
        repeats = WINDOWS if single < seconds else 0
        windows = [sum(once() for _ in range(rounds)) for _ in range(repeats)]
    simulated = rounds * periods * problem.period * batch
    return statistics.median(windows or [single]) / simulated


def _repeated(batch: int, leaf: Array) -> Array:
    """Copies of an array along a new leading axis."""
    return jnp.broadcast_to(leaf, (batch, *leaf.shape))


def _arguments(
    problem: Problem, prepared: Prepared
) -> tuple[Scene, RodState, Array, Array, Array]:
    kind = prepared.state.positions.dtype
    return (
        prepared.scene,
        prepared.state,
        jnp.asarray(problem.controls, kind),
        jnp.asarray(prepared.setting.dt, kind),
        jnp.asarray(prepared.substeps),
    )


@partial(jax.jit, static_argnums=(0, 1))
def _run(
    problem: Problem,
    batched: bool,
    scene: Scene,
    state: RodState,
    controls: Float[Array, "periods *batch controls"],
    dt: Array,
    substeps: Array,
) -> Float[Array, "periods *batch 3"]:
    """Path of the tip; if `batched`, for many rods, each with its own controls."""
    act = problem.act(scene)

    def period(state: RodState, control: Array) -> tuple[RodState, Array]:
        state = advance(act(control), state, dt, substeps)
        return state, state.tip

    return lax.scan(jax.vmap(period) if batched else period, state, controls)[1]
