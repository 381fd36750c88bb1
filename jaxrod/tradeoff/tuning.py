"""Search for the cheapest setting within an allowed error, by measurement."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import jax
import numpy as np

from jaxrod.analysis.inertia_scaling import scale_inertia
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.tradeoff.measure import (
    Integrator,
    Measurement,
    Prepared,
    Reduction,
    Reference,
    Setting,
    cost,
    may_be_untwisted,
    prepare,
    reference,
    tip_error,
    tips_of,
)
from jaxrod.tradeoff.workload import Workload, workload_of
from jaxrod.validation import check_array, check_count, is_traced

ELEMENTS = (4, 5, 6, 8, 10, 12, 14, 17, 20, 24, 28, 34, 40, 48, 56, 68, 80)
"""Numbers of elements of the rod among which `tune` chooses by default."""
STEPS_FOR_IMPLICIT = 100
"""Smallest number of explicit steps that an implicit step must replace: implicit
settings with smaller steps are not tried."""
TRUSTED = 0.2
"""Largest accepted error of the reference, as a fraction of the allowed error [1]."""


@dataclass(frozen=True)
class Tuned:
    """Cheapest accurate setting found by `tune`, with its error and cost.

    Example:
        >>> few = dict(duration=0.05, elements=(4, 6), seconds=0.01)
        >>> tuned = jaxrod.tune(scene, state, max_error=0.05, **few)
        >>> tuned.met, tuned.error < tuned.max_error
        (True, True)
        >>> ready = tuned.prepared  # its scene, state and steps, to run
        >>> ready.scene.rod.n_elements == tuned.setting.n_elements
        True
    """

    met: bool
    """Whether `error` is at most `max_error`. If no setting is that accurate, `setting`
    is the most accurate one tried."""
    setting: Setting
    """The fastest of the timed settings that are accurate enough."""
    error: float
    """Measured error of `setting`: root mean square over time of the tip's distance
    from the reference, divided by the rod's length [1]."""
    wall_s_per_sim_s: float
    """Measured cost of `setting`: wall-clock time per simulated second and rod, at the
    batch size `batch` [1]."""
    max_error: float
    """Largest allowed error, as a fraction of the rod's length [1]."""
    batch: int
    """Batch size (number of rods) of the timing."""
    reference_error: float
    """Estimated error of the reference itself, as a fraction of the rod's length
    [1]."""
    tried: tuple[Measurement, ...]
    """All measurements in the order of the search; only candidates for `setting` have
    times."""
    prepared: Prepared
    """The scene and the state built with `setting`, ready to simulate."""

    def __str__(self) -> str:
        """Describes the result on one line."""
        found = (
            f"{self.setting}: error {self.error:.2g} of the length, "
            f"{self.wall_s_per_sim_s:.2g} s per simulated second"
        )
        if self.met:
            return f"{found} (allowed: {self.max_error:g})"
        return f"no setting is within {self.max_error:g}; most accurate: {found}"


def tune(
    scene: Scene | Workload,
    state: RodState | None = None,
    *,
    max_error: float = 0.01,
    duration: float = 1.0,
    batch: int = 1,
    elements: Sequence[int] = ELEMENTS,
    seconds: float = 0.3,
    log: Callable[[str], None] = lambda line: None,
) -> Tuned:
    """Finds the cheapest setting within an allowed error, by measuring on the scene.

    First it finds the number of elements: the smallest with which explicit float64
    steps are accurate enough. Then it tries the methods with that number, or
    somewhat more: explicit steps, with enlarged inertia if the rod is slender, in the
    plane if the scene has one, and implicit steps if there are many explicit ones. Each
    is tried in float32, then with compensated positions, then in float64, until it is
    accurate enough. The accurate setting of each method is timed; the fastest is
    returned. Errors are relative to a converged reference of 160 elements. It takes a
    minute or two and does not work inside jit.

    Args:
        scene: The scene, with the consistent law (any method but `pyelastica()`); or a
            `Workload`, possibly with controls.
        state: Initial state of the scene; not used with a `Workload`.
        max_error: Largest allowed error [1]: root mean square over time of the tip's
            distance from the reference, divided by the rod's length.
        duration: Simulated time [s].
        batch: Batch size (number of rods) to optimise the speed for.
        elements: Numbers of elements to choose from, increasing.
        seconds: Time spent on timing each setting [s].
        log: Function called with a line of text after every measurement.

    Returns:
        The setting with its measured error and cost.

    Raises:
        ValueError: If `max_error`, `batch` or `seconds` is not positive, `elements` do
            not increase, `state` is missing or does not match the scene, or the
            reference is not converged well enough. Then the motion depends on details
            that no resolution captures, or `max_error` must be larger.

    Example:
        >>> few = dict(duration=0.05, elements=(4, 6), seconds=0.01)
        >>> tuned = jaxrod.tune(scene, state, max_error=0.05, **few)
        >>> tuned.met, tuned.error < 0.05, len(tuned.tried) > 1
        (True, True, True)
    """
    if is_traced(scene, state):
        raise ValueError(
            "tune needs numbers that are known, not traced by jax.jit, grad or vmap"
        )
    check_array("max_error", max_error, [()], "", positive=True)
    check_array("seconds", seconds, [()], "s", positive=True)
    batch = check_count("batch", batch, 1)
    elements = tuple(check_count("elements", n, 2) for n in elements)
    if not elements or any(a >= b for a, b in itertools.pairwise(elements)):
        raise ValueError(
            f"elements must be increasing numbers, at least one, got {elements}"
        )
    if isinstance(scene, Workload):
        workload = scene
    elif state is None:
        raise ValueError("state must be given with a scene")
    else:
        workload = workload_of(scene, state, duration=duration)
    exact = reference(workload)
    if not exact.error <= TRUSTED * max_error:
        raise ValueError(
            f"the reference of {exact.n_elements} elements is itself uncertain by "
            f"{exact.error:.2g} of the length, too much to judge a max_error "
            f"of {max_error:g}: try one above {exact.error / TRUSTED:.1g}, or a "
            "shorter duration"
        )

    def timed(prepared: Prepared) -> tuple[Prepared, float]:
        found = cost(workload, prepared, batch, seconds)
        log(f"{prepared.setting}: {found:.2g} s per simulated second")
        return prepared, found

    search = _Search(workload, exact, max_error, elements, log)
    found = [timed(one) for one in search.accurate_settings()]
    met = bool(found)
    if not found:
        closest = min(search.tried, key=lambda one: one.error)
        found = [timed(prepare(workload, closest.setting))]
    costs = [seconds for _, seconds in found]
    prepared, wall = found[int(np.argmin(costs))]
    error = next(m.error for m in search.tried if m.setting == prepared.setting)
    times = {one.setting: {batch: seconds} for one, seconds in found}
    return Tuned(
        met=met,
        setting=prepared.setting,
        error=error,
        wall_s_per_sim_s=wall,
        max_error=max_error,
        batch=batch,
        reference_error=exact.error,
        tried=tuple(
            dataclasses.replace(m, wall_s_per_sim_s=times.get(m.setting, {}))
            for m in search.tried
        ),
        prepared=prepared,
    )


@dataclass
class _Search:
    """Searches for settings that meet `max_error` on a workload.

    It records every setting that it tries.
    """

    workload: Workload
    exact: Reference
    max_error: float
    elements: tuple[int, ...]
    log: Callable[[str], None]
    tried: list[Measurement] = dataclasses.field(default_factory=list)

    def accurate_settings(self) -> Iterator[Prepared]:
        """Yields the cheapest accurate setting of each method that has one."""
        index = self._coarsest()
        if index is None:
            return
        explicit = None
        for reductions in _kinds(self.workload, self.elements[index]):
            best = self._in_some_precision(index, "explicit", reductions, None)
            if best is not None:
                yield best
                if explicit is None or best.substeps < explicit.substeps:
                    explicit = best
        substeps = 1
        most = explicit.substeps if explicit is not None else STEPS_FOR_IMPLICIT
        while substeps * STEPS_FOR_IMPLICIT <= most:
            dt = self.workload.period / substeps
            best = self._in_some_precision(index, "implicit", (), dt)
            if best is not None:
                yield best
                return
            substeps *= 2

    def _error(self, setting: Setting) -> tuple[Prepared, float]:
        prepared = prepare(self.workload, setting)
        for one in self.tried:
            if one.setting == prepared.setting:
                return prepared, one.error
        tips = tips_of(self.workload, prepared)
        error = tip_error(tips, self.exact.tips, self.exact.length)
        self.tried.append(Measurement(prepared.setting, error, {}))
        self.log(f"{prepared.setting}: error {error:.2g}")
        return prepared, error

    def _coarsest(self) -> int | None:
        """Index of the smallest of `elements` that is accurate enough in float64.

        It is `None` if not even the largest is.
        """

        def error(index: int) -> float:
            return self._error(Setting(self.elements[index], dtype="float64"))[1]

        # The error falls with the square of the number: jump to where it suffices.
        last = len(self.elements) - 1
        index = min(int(np.searchsorted(self.elements, 10)), last)
        for _ in range(3):
            size = min(error(index), 1.0)
            wanted = self.elements[index] * np.sqrt(size / self.max_error)
            jump = min(int(np.searchsorted(self.elements, wanted)), last)
            if jump == index:
                break
            index = jump
        while error(index) > self.max_error:
            index += 1
            if index > last:
                return None
        while index > 0 and error(index - 1) <= self.max_error:
            index -= 1
        return index

    def _in_some_precision(
        self,
        index: int,
        integrator: Integrator,
        reductions: tuple[Reduction, ...],
        dt: float | None,
    ) -> Prepared | None:
        """Cheapest accurate precision of a method; `None` if there is none.

        The method is an integrator, its step size `dt` (`None`: from the stability
        limit) and reductions. It tries `elements[index]` and the next two numbers,
        because reductions and larger steps add errors, which more elements may
        compensate.
        """
        for n in self.elements[index : index + 3]:
            for dtype, more in _PRECISIONS:
                both = (*reductions, *more)
                best, error = self._error(
                    Setting(n, dt, dtype, integrator=integrator, reductions=both)
                )
                if error <= self.max_error:
                    return best
        return None


_PRECISIONS: tuple[tuple[str, tuple[Reduction, ...]], ...] = (
    ("float32", ()),
    ("float32", ("compensated",)),
    ("float64", ()),
)


def _kinds(workload: Workload, n_elements: int) -> list[tuple[Reduction, ...]]:
    """Combinations of reductions that are valid and useful for a workload.

    They depend on `n_elements`, because only slender elements gain from enlarged
    inertia.
    """
    kinds: list[tuple[Reduction, ...]] = [()]
    if _is_slender(workload, n_elements):
        kinds.append(("inertia",))
    if workload.plane is not None:
        kinds += [("planar", *kind) for kind in kinds]
    elif may_be_untwisted(workload):
        kinds += [("untwisted", *kind) for kind in kinds]
    return kinds


def _is_slender(workload: Workload, n_elements: int) -> bool:
    """Whether elements are so slender that larger inertia permits larger steps.

    The workload's rod is divided into `n_elements` elements.
    """
    with jax.enable_x64(True):
        scene, _ = workload.build(n_elements, "consistent")
        return bool((scale_inertia(scene).factors > 1).any())
