"""Bad and extreme values for every argument of the public factories and verbs.

    PYTHONPATH=tests python tests/extremes/factories.py

For each value one of two things must be so. Either it is refused: a `ValueError` or
`TypeError` whose words name the argument. Or it is accepted and means what was given:
what the factory makes in float32 is finite, and is what it makes in float64 to
rounding, nothing lost to zero that is not small beside its neighbours. Exits with 1 and
lists the faults if there are any.
"""

from __future__ import annotations

import argparse
import collections
import sys
import warnings
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes.arguments import (
    ALSO_NAMED,
    COUNT_NAMES,
    COUNTED,
    MAY_BE_NONE,
    MAY_BE_WILD,
    NUMERIC,
    OF_KINDS,
    RUNS,
    Known,
    things,
)
from extremes.values import COUNTS, DTYPES, KINDS, SCALARS, WHOLE, WORDS, WRONG
from public_names import PUBLIC


@dataclass(frozen=True)
class Case:
    """One value for one argument of one function."""

    function: str
    argument: str
    label: str
    value: Any

    def __str__(self) -> str:
        """In words."""
        return f"{self.function}({self.argument}={self.label})"


def component_first(good: Any, value: Any) -> Any:
    """A good nest of numbers with another value for its first."""
    if isinstance(good, list):
        return [component_first(good[0], value), *good[1:]]
    return value


def numeric_cases() -> list[Case]:
    """All values for all numbers."""
    cases = []
    for function, arguments in NUMERIC.items():
        for argument, good in arguments.items():
            if not _is_numeric(good) or argument in COUNT_NAMES:
                continue
            # The parameters of a function are any pytree: what it makes of them is its
            # own affair.
            values = SCALARS if argument == "parameters" else SCALARS | WHOLE
            cases += [Case(function, argument, k, v) for k, v in values.items()]
            if isinstance(good, list):
                cases += [
                    Case(function, argument, f"[{k}, ...]", component_first(good, v))
                    for k, v in SCALARS.items()
                ]
    return cases


def _is_numeric(good: Any) -> bool:
    """Whether it is a number or a nest of lists of numbers."""
    if isinstance(good, list):
        return all(map(_is_numeric, good))
    return isinstance(good, int | float)


def wrong_cases() -> list[Case]:
    """Values that have to be refused."""
    cases = []
    for function, arguments in COUNTED.items():
        for argument in arguments:
            if argument in COUNT_NAMES or (function, argument) == (
                "control_spline",
                "controls",
            ):
                cases += [Case(function, argument, k, v) for k, v in COUNTS.items()]
    for function, arguments in OF_KINDS.items():
        for argument, good in arguments.items():
            if good is ... and argument != "function":
                cases += [Case(function, argument, k, v) for k, v in KINDS.items()]
    for function, arguments in RUNS.items():
        for argument in arguments:
            if argument in ("dt", "tolerance"):
                cases += [Case(function, argument, k, SCALARS[k]) for k in WRONG]
    for function in ("straight_rod", "rod_along", "control_spline", "astype"):
        cases += [Case(function, "dtype", k, v) for k, v in DTYPES.items()]
    ended = ("clamp", "fixed_end", "end_load", "hinge_support", "driven")
    for function in (*ended, "support_force", "support_couple"):
        cases += [Case(function, "end", k, v) for k, v in WORDS.items()]
    cases += [Case("make_scene", "method", k, v) for k, v in KINDS.items()]
    cases += [Case("planar", "plane", k, v) for k, v in WORDS.items()]
    cases += [Case("planar", "law", k, v) for k, v in KINDS.items()]
    return [case for case in cases if not _is_right(case)]


def _is_right(case: Case) -> bool:
    """Whether what is listed as wrong is right for this argument."""
    if case.argument in ("rod", "state", "scene") and case.argument == case.label:
        return True
    if case.label == "None":
        optional = {
            "n_modes",
            "devices",
            "tolerance",
            "dtype",
            "method",
            "law",
            "points_per_element",
        }
        if (case.function, case.argument) == ("contact", "points_per_element"):
            return False
        return case.argument in optional
    return False


def call(case: Case) -> Any:
    """Calls the function with the value, all else good."""
    known = things(jnp.result_type(float))
    for table in (COUNTED, OF_KINDS, RUNS, NUMERIC):
        arguments = table.get(case.function, {})
        if case.argument in arguments:
            break
    else:
        arguments = {
            "straight_rod": NUMERIC["straight_rod"],
            "rod_along": NUMERIC["rod_along"],
            "control_spline": {"controls": 4},
            "astype": {"tree": known["state"]},
            "end_load": {},
            "clamp": {"state": ...},
            "fixed_end": {"state": ...},
            "hinge_support": {"state": ..., "axis": (0.0, 1.0, 0.0)},
            "driven": {"state": ...},
            "make_scene": {"rod": ...},
            "planar": {"plane": "xy"},
            "support_force": {},
            "support_couple": {},
        }[case.function]
    if case.function in NUMERIC and case.argument in NUMERIC[case.function]:
        arguments = NUMERIC[case.function] | (
            {} if case.argument not in COUNT_NAMES else arguments
        )
    given = {}
    for name, good in arguments.items():
        if good is ...:
            good = known.get(name, 2)
        elif isinstance(good, Known):
            good = known[good]
        given[name] = good
    value = case.value
    if isinstance(value, str) and value in ("rod", "state", "scene"):
        value = known[value]
    elif isinstance(value, str) and value == "pair":
        value = known["rod"], known["state"]
    elif isinstance(value, str) and value == "generator":
        value = (float(k) for k in range(3))
    given[case.argument] = value
    function = PUBLIC[case.function]
    if case.function == "make_scene":
        return function(given.pop("rod"), **given)
    if case.function == "rod_contact":
        return function(*given.pop("members"), **given)
    return function(**given)


def outcome(case: Case, *, must_refuse: bool) -> str:
    """ "refused" or "accepted", or the fault in words."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", jaxrod.UnstableStepWarning)
        warnings.simplefilter("ignore", jaxrod.UnlikelyWarning)
        with jax.enable_x64(False):
            try:
                made = call(case)
            except (ValueError, TypeError) as error:
                return _named(case, error)
            except Exception as error:
                return f"{type(error).__name__}: {_short(error)}"
            if must_refuse:
                return "accepted, though it is wrong"
            rod = made[0] if case.function in ("straight_rod", "rod_along") else None
            if rod is not None:
                step = float(jaxrod.stable_dt(jaxrod.make_scene(rod)).dt)
                if not 0 < step < np.inf:
                    return f"accepted, but the stable step is {step} s"
        with jax.enable_x64(True):
            try:
                exact = call(case)
            except (ValueError, TypeError) as error:
                return f"accepted in float32, refused in float64: {_short(error)}"
    return _same(made, exact)


def _named(case: Case, error: Exception) -> str:
    """ "refused" if the message is jaxrod's and names the argument."""
    words = str(error)
    names = (case.argument, *ALSO_NAMED.get(case.argument, ()))
    if "unexpected keyword" in words or not any(name in words for name in names):
        return f"refused without its name: {_short(error)}"
    return "refused"


def _same(single: Any, double: Any) -> str:
    """ "accepted" if numbers made in float32 are those made in float64."""
    if jax.tree.structure(single) != jax.tree.structure(double):
        return "accepted, but float32 makes something else than float64"
    pairs = zip(jax.tree.leaves_with_path(single), jax.tree.leaves(double), strict=True)
    for (path, got), want in pairs:
        name = jax.tree_util.keystr(path)
        got, want = np.asarray(got, np.float64), np.asarray(want, np.float64)
        if not np.all(np.isfinite(got)):
            return f"accepted, but {name} is {got[~np.isfinite(got)].flat[0]}"
        size = np.max(np.abs(want), initial=0)
        if "rest_" in name and "lengths" not in name and size < 1e-12:
            continue  # zero but for rounding, which is another in float32
        if np.max(np.abs(got - want), initial=0) > 1e-4 * size:
            return f"accepted, but {name} of {want.ravel()[:3]} is {got.ravel()[:3]}"
    return "accepted"


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:160]


def all_cases(labels: tuple[str, ...] | None = None) -> list[tuple[Case, bool]]:
    """Every case, or those of some numbers, and whether it has to be refused."""
    numeric = [
        (case, False)
        for case in numeric_cases()
        if labels is None or case.label.strip("[, .]") in labels
    ]
    return numeric + [(case, True) for case in wrong_cases()]


def fault_of(case: Case, must_refuse: bool) -> str | None:
    """What is wrong with what becomes of a value; `None` if nothing is."""
    none_is_right = (case.function, case.argument) in MAY_BE_NONE
    found = outcome(case, must_refuse=must_refuse)
    if found in ("refused", "accepted"):
        if case.label == "None" and found == "accepted" and not none_is_right:
            return "None is accepted"
        return None
    if case.label == "None" and none_is_right and found.endswith("stiffness is nan"):
        # A scene or a system chooses it; until then contact has no number.
        return None
    wild = (case.function, case.argument) in MAY_BE_WILD
    if wild and found.endswith(("is nan", "is inf", "is -inf")):
        return None
    return found


def main() -> int:
    """Tries everything; prints what was refused, accepted, and wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", default="", help="functions whose name has this in it"
    )
    options = parser.parse_args()
    counts: collections.Counter[str] = collections.Counter()
    faults = []
    for case, must_refuse in all_cases():
        if options.only not in case.function:
            continue
        fault = fault_of(case, must_refuse)
        counts["faults" if fault else "right"] += 1
        if fault:
            faults.append(f"{case}: {fault}")
            print(faults[-1], flush=True)
    print(f"{sum(counts.values())} values, {counts['faults']} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
