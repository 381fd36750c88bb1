"""Search for the cheapest setting within an allowed error, by measurement."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxrod.model import Model
from jaxrod.tradeoff.measure import (
    Integrator,
    Measurement,
    Prepared,
    Reduction,
    Reference,
    Setting,
    cost,
    members_for,
    prepare,
    reference,
    tip_error,
    tips_of,
)
from jaxrod.tradeoff.reductions import WORTHWHILE
from jaxrod.tradeoff.workload import Workload, workload_of
from jaxrod.validation import check_array, check_count, is_traced

ELEMENTS = (4, 5, 6, 8, 10, 12, 14, 17, 20, 24, 28, 34, 40, 48, 56, 68, 80)
"""Numbers of elements of the rod among which `tune` chooses by default."""
STEPS_FOR_IMPLICIT = 100
"""Smallest number of explicit steps that an implicit step must replace: implicit
settings with smaller steps are not tried."""
TRUSTED = 0.2
"""Largest accepted error of the reference, as a fraction of the error that is judged by
it [1]."""
SOFTER = (1 / 4, 1 / 16, 1 / 64)
"""Stiffnesses of contact that are tried one after another, divided by the given one
[1]."""
SPARSER = (1 / 2, 1 / 4)
"""Numbers of contact points that are tried one after another, divided by the given
one [1]."""
WORTH_SOFTENING = 0.9
"""Largest ratio of numbers of steps at which softer contact is tried [1]."""


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
    """Measured error of `setting`: root mean square over time of the distance from the
    reference, of the point where it is largest, divided by the length of the longest
    rod [1]. Points are the ends and the middle of each rod, and each body; or those of
    a `Workload`."""
    wall_s_per_sim_s: float
    """Measured cost of `setting`: wall-clock time per simulated second and model, at
    the batch size `batch` [1]."""
    max_error: float
    """Largest allowed error, as a fraction of the length of the longest rod [1]."""
    batch: int
    """Batch size (number of scenes or systems) of the timing."""
    reference_error: float
    """Estimated error of the reference itself, as a fraction of that length [1]."""
    tried: tuple[Measurement, ...]
    """All measurements in the order of the search; only candidates for `setting` have
    times."""
    prepared: Prepared
    """The scene or system and the state built with `setting`, ready to simulate."""

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
    scene: Model | Workload,
    state: Any = None,
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
    somewhat more: explicit steps, with enlarged inertia if rods are slender, in the
    plane if there is one, and implicit steps if there are many explicit ones. Each is
    tried in float32, then with compensated positions, then in float64, until it is
    accurate enough. Explicit steps are also tried with softer contact, if that permits
    larger steps, and with fewer contact points. The accurate setting of each method is
    timed; the fastest is returned.

    Errors are relative to a reference of up to 160 elements, whose own error follows
    from the measured order of convergence. It is refined until its error is at most a
    fifth of the error that it judges. The stiffness of contact is part of the model, so
    the reference keeps it. In a system, reductions apply to the rods that allow them.
    A call takes a minute or two, or several minutes for a system. It does not work
    inside jit.

    Args:
        scene: The scene or the system, with the consistent law (any method but
            `pyelastica()`); or a `Workload`, possibly with controls.
        state: Initial state of the scene; not used with a `Workload`.
        max_error: Largest allowed error [1]: root mean square over time of the distance
            from the reference, of the point where it is largest, divided by the length
            of the longest rod. The points are the ends and the middle of each rod, and
            the position of each body.
        duration: Simulated time [s].
        batch: Batch size (number of scenes or systems) to optimise the speed for.
        elements: Numbers of elements to choose from, increasing. In a system it is the
            number of the rod that has most; others keep their proportion to it. Each is
            replaced by the nearest that has nodes where something is joined.
        seconds: Time spent on timing each setting [s].
        log: Function called with a line of text after every measurement.

    Returns:
        The setting with its measured error and cost.

    Raises:
        ValueError: If `max_error`, `batch` or `seconds` is not positive, `elements` do
            not increase, `state` is missing or does not match the scene, the model has
            no rod or cannot be resampled (`jaxrod.resample` tells why), or the
            reference is not converged well enough. Then the motion depends on details
            that no resolution captures, or `max_error` must be larger.
        TypeError: If `scene` is of another type.

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
    elements = tuple(sorted({workload.fits(n) for n in elements}))
    exact = reference(workload, enough=TRUSTED * max_error)
    if not exact.error <= TRUSTED * max_error:
        raise ValueError(
            f"the reference of {exact.n_elements} elements is itself uncertain by "
            f"{exact.error:.2g} of the length, too much to judge a max_error "
            f"of {max_error:g}: try one above {exact.error / TRUSTED:.1g}, or a "
            "shorter duration"
        )
    search = _Search(workload, exact, max_error, elements, log)
    prepared, times = search.fastest(batch, seconds)
    if exact.error > TRUSTED * search.error_of(prepared):
        # A finer reference may put the setting above the limit: then search again.
        exact = reference(workload, enough=TRUSTED * search.error_of(prepared))
        finer = _Search(workload, exact, max_error, elements, log)
        if finer.error(prepared.setting)[1] > max_error:
            prepared, times = finer.fastest(batch, seconds)
            search = finer
        else:
            search.tried = finer.tried + [
                one for one in search.tried if one.setting != prepared.setting
            ]
    error = search.error_of(prepared)
    return Tuned(
        met=error <= max_error,
        setting=prepared.setting,
        error=error,
        wall_s_per_sim_s=times[prepared.setting],
        max_error=max_error,
        batch=batch,
        reference_error=exact.error,
        tried=tuple(
            dataclasses.replace(
                m,
                wall_s_per_sim_s={batch: times[m.setting]}
                if m.setting in times
                else {},
            )
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
    built: dict[Setting, Prepared] = dataclasses.field(default_factory=dict)

    def fastest(
        self, batch: int, seconds: float
    ) -> tuple[Prepared, dict[Setting, float]]:
        """The fastest accurate setting, and the cost of each that was timed.

        It is the most accurate setting of those tried if none is accurate.
        """
        found = list(self.accurate_settings())
        if not found:
            closest = min(self.tried, key=lambda one: one.error)
            found = [self.ready(closest.setting)]
        times = {}
        for one in found:
            times[one.setting] = cost(self.workload, one, batch, seconds)
            self.log(f"{one.setting}: {times[one.setting]:.2g} s per simulated second")
        return min(found, key=lambda one: times[one.setting]), times

    def error_of(self, prepared: Prepared) -> float:
        """Error of a setting that was tried."""
        return next(m.error for m in self.tried if m.setting == prepared.setting)

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
                if explicit is None or best.substeps <= explicit.substeps:
                    explicit = best
        yield from self._softened(explicit)
        substeps = 1
        most = explicit.substeps if explicit is not None else STEPS_FOR_IMPLICIT
        while substeps * STEPS_FOR_IMPLICIT <= most:
            if not members_for(self.workload, "implicit"):
                return
            dt = self.workload.period / substeps
            best = self._in_some_precision(index, "implicit", (), dt)
            if best is not None:
                yield best
                return
            substeps *= 2

    def _softened(self, best: Prepared | None) -> Iterator[Prepared]:
        """Yields a setting with softer contact and then with fewer contact points.

        Both go on as long as they are accurate, and save steps or points.
        """
        for field, shares in (("contact", SOFTER), ("points", SPARSER)):
            for share in shares:
                if best is None:
                    return
                changed: dict[str, Any] = {"dt": None, field: share}
                setting = dataclasses.replace(best.setting, **changed)
                cheaper = self.ready(setting)
                shorter = cheaper.substeps <= WORTH_SOFTENING * best.substeps
                smaller = field == "points" and _shape(cheaper) != _shape(best)
                if not (shorter or smaller):
                    break
                if self.error(setting)[1] > self.max_error:
                    break
                yield cheaper
                best = cheaper

    def ready(self, setting: Setting) -> Prepared:
        """The workload built with a setting, once."""
        if setting not in self.built:
            self.built[setting] = prepare(self.workload, setting)
        return self.built[setting]

    def error(self, setting: Setting) -> tuple[Prepared, float]:
        """A setting with its numbers of steps, and its error; measured once."""
        prepared = self.ready(setting)
        for one in self.tried:
            if one.setting == prepared.setting:
                return prepared, one.error
        tips = tips_of(self.workload, prepared)
        error = tip_error(tips, self.exact.tips, self.exact.length)
        self.tried.append(Measurement(prepared.setting, error, {}))
        self.log(f"{prepared.setting}: error {error:.2g}")
        return prepared, error

    def _keeps(self, tried: Measurement) -> bool:
        return tried.error <= self.max_error

    def _coarsest(self) -> int | None:
        """Index of the smallest of `elements` that is accurate enough in float64.

        It is `None` if not even the largest is.
        """

        def error(index: int) -> float:
            return self.error(Setting(self.elements[index], dtype="float64"))[1]

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
        # Contact at few points may be accurate by chance, and then that is enough.
        known = [one.setting.n_elements for one in self.tried if self._keeps(one)]
        if known:
            index = self.elements.index(min(known))
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
                best, error = self.error(
                    Setting(n, dt, dtype, integrator=integrator, reductions=both)
                )
                if error <= self.max_error:
                    return best
        return None


def _shape(prepared: Prepared) -> Any:
    """Structure of the program: methods, numbers of elements and of contact points."""
    return jax.tree.structure(prepared.scene)


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
    elif members_for(workload, "untwisted"):
        kinds += [("untwisted", *kind) for kind in kinds]
    return kinds


def _is_slender(workload: Workload, n_elements: int) -> bool:
    """Whether elements are so slender that larger inertia permits larger steps.

    The workload's rod is divided into `n_elements` elements.
    """
    setting = Setting(n_elements, dtype="float64")
    larger = dataclasses.replace(setting, reductions=("inertia",))
    steps = [prepare(workload, one).substeps for one in (setting, larger)]
    return steps[0] > WORTHWHILE * steps[1]
