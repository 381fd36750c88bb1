"""Bad and extreme values for every argument of the public factories and verbs.

    python tests/extremes/factories.py

For each value one of two things must be so. Either it is refused: a `ValueError` or
`TypeError` whose words name the argument. Or it is accepted and means what was given:
what the factory makes in float32 is finite, and is what it makes in float64 to
rounding, nothing lost to zero that is not small beside its neighbours. Exits with 1 and
lists the faults if there are any.
"""

from __future__ import annotations

import argparse
import collections
import functools
import sys
import warnings
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod

MATERIAL = {
    "radius": 0.05,
    "density": 1e3,
    "youngs_modulus": 1e6,
    "shear_modulus": 4e5,
    "poisson_ratio": 0.4,
    "shear_correction": 0.9,
}
BENT = [[0.0, 0.1, 0.1, 0.3], [0.0, 0.0, 1.0, 1.2], [0.0, 1.0, 1.1, 2.0]]

SCALARS: dict[str, Any] = {
    "1e40": 1e40,
    "1e38": 1e38,
    "1e20": 1e20,
    "1e10": 1e10,
    "1e-10": 1e-10,
    "1e-20": 1e-20,
    "1e-40": 1e-40,
    "1e-45": 1e-45,
    "1e300": 1e300,
    "1e-300": 1e-300,
    "5e-324": 5e-324,
    "-1e-45": -1e-45,
    "nan": float("nan"),
    "inf": float("inf"),
    "-inf": float("-inf"),
    "-1": -1,
    "0": 0,
    "-0.0": -0.0,
    "2": 2,
    "True": True,
    "numpy False": np.False_,
    "1+0j": 1 + 0j,
    "numpy complex": np.complex64(2),
    "None": None,
    "'x'": "x",
    "'1.0'": "1.0",
    "b'1'": b"1",
    "object()": object(),
    "1/3": Fraction(1, 3),
    "10**30": 10**30,
    "10**400": 10**400,
    "2**31": 2**31,
    "float16": np.float16(0.5),
    "bfloat16": jnp.bfloat16(0.5),
    "longdouble": np.longdouble("1e4000"),
    "slice": slice(0, 1),
    "jnp complex": jnp.complex64(1),
    "jnp bool": jnp.bool_(True),
    "key": jax.random.key(0),
}
"""Given for a number, and in place of one component of a vector."""

WHOLE: dict[str, Any] = {
    "[]": [],
    "{}": {},
    "set": {1.0},
    "(1, 2)": (1.0, 2.0),
    "seven": list(range(1, 8)),
    "3 x 3": np.ones((3, 3)),
    "ragged": [1.0, [2.0, 3.0]],
    "objects": np.array([1.0, None, "x"], dtype=object),
    "strings": ["1", "2", "3"],
    "truths": [True, False, True],
    "generator": "generator",
    "function": len,
    "class": float,
    "dict": {"x": 1.0, "y": 2.0, "z": 3.0},
    "array of strings": np.array(["1", "2", "3"]),
    "dates": np.array(["2020-01-01"] * 3, dtype="datetime64[D]"),
    "bytes": b"123",
}
"""Given for a whole argument."""

QUICK = ("1e40", "1e-45", "nan", "True", "None", "'x'", "1+0j", "0", "objects", "")
"""The values of the quick test."""

COUNTS: dict[str, Any] = {
    "-1": -1,
    "2.5": 2.5,
    "2.0": 2.0,
    "10**30": 10**30,
    "2**31": 2**31,
    "10**400": 10**400,
    "True": True,
    "None": None,
    "'x'": "x",
    "nan": float("nan"),
    "inf": float("inf"),
    "[]": [],
    "array": np.ones(2, int),
    "jnp 5.5": jnp.asarray(5.5),
    "jnp pair": jnp.asarray([1, 2]),
    "jnp truth": jnp.asarray(True),
    "1j": 1j,
}
"""Given for a count; every one is wrong."""

KINDS: dict[str, Any] = {
    "None": None,
    "0": 0,
    "'x'": "x",
    "pair": "pair",
    "rod": "rod",
    "state": "state",
    "scene": "scene",
    "array": np.ones(3),
    "[]": [],
    "class": jaxrod.RodState,
}
"""Given for a rod, a state, a scene, a body."""

DTYPES: dict[str, Any] = {
    "float16": jnp.float16,
    "bfloat16": jnp.bfloat16,
    "float8": jnp.float8_e4m3fn,
    "int32": jnp.int32,
    "complex64": jnp.complex64,
    "bool": bool,
    "'x'": "x",
    "7": 7,
    "object": object,
    "float64": jnp.float64,
}
"""Given for a type where 64-bit types are off; every one is wrong."""

WORDS: dict[str, Any] = {
    "None": None,
    "0": 0,
    "'tip'": "tip",
    "[]": [],
    "array": np.ones(2),
    "True": True,
}
"""Given for a name, such as that of an end; every one is wrong."""

MAY_BE_NONE = {
    ("straight_rod", "shear_modulus"),
    ("straight_rod", "shear_correction"),
    ("rod_along", "shear_correction"),
    ("straight_rod", "normal"),
    ("rod_along", "shear_modulus"),
    ("rod_along", "normal"),
    ("rod_along", "directors"),
    ("exponential_damping", "rotational_rate"),
    ("contact", "friction_drag"),
    ("implicit", "tolerance"),
    ("scale_inertia", "dt"),
    ("signed_distance", "parameters"),
    ("equilibrium", "tolerance"),
    ("sine", "mean"),
    ("driven", "axis"),
}

MAY_BE_WILD = {("limit_rate", "applied"), ("limit_rate", "commanded")}
"""What is not finite is data there, as a policy may give it."""

ALSO_NAMED = {
    "length": ("element length", "elements are", "controls must increase"),
    "positions": ("distance between neighbouring nodes", "element length"),
    "start": ("end - start",),
    "end": ("end - start",),
    "poisson_ratio": ("shear_modulus",),
    "damping": ("friction_drag",),
    "bodies": ("body",),
    "n_elements": ("element length",),
}
"""Other words by which a message may name an argument."""


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


def beside(point: Any, numbers: Any) -> Any:
    """Signed distance from a plane across x."""
    return point[0] - sum(jax.tree.leaves(numbers))


@functools.cache
def things(dtype: Any) -> dict[str, Any]:
    """What other arguments need, made in the precision that is in force."""
    assert dtype == jnp.result_type(float)
    rod, state = jaxrod.straight_rod(3, length=1.2, **MATERIAL)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    balls = [jaxrod.sphere((2.0, 0.0, k), 0.1) for k in (0.0, 1.0)]
    return {
        "rod": rod,
        "state": state,
        "scene": scene,
        "bodies": balls,
        "contact": jaxrod.contact(balls, stiffness=1.0),
        "spline": jaxrod.control_spline(2, 1.2),
        "scaling": jaxrod.scale_inertia(scene),
        "function": beside,
    }


NUMERIC: dict[str, dict[str, Any]] = {
    "straight_rod": {
        "n_elements": 3,
        "length": 1.2,
        "start": [0.1, 0.2, 0.3],
        "direction": [1.0, -2.0, 0.5],
        "normal": [0.3, 0.2, 2.0],
        **MATERIAL,
    },
    "rod_along": {"positions": BENT, "normal": [0.0, 1.0, 0.2], **MATERIAL},
    "gravity": {"acceleration": [1.0, 2.0, 3.0]},
    "end_load": {"force": [1.0, 2.0, 3.0], "couple": [4.0, 5.0, 6.0]},
    "uniform_load": {
        "force_per_length": [1.0, 2.0, 3.0],
        "couple_per_length": [4.0, 5.0, 6.0],
    },
    "exponential_damping": {"translational_rate": 3.0, "rotational_rate": 2.0},
    "ramp": {
        "first": [1.0, 2.0],
        "last": [3.0, 4.0],
        "duration": 2.0,
        "start": 0.5,
    },
    "sine": {"amplitude": 2.0, "period": 0.3, "mean": 1.0, "phase": 0.2},
    "table": {"times": [0.0, 1.0], "values": [1.0, 2.0]},
    "hinge": {"state": ..., "axis": [0.0, 2.0, 1.0]},
    "driven": {
        "state": ...,
        "displacement": [0.0, 0.1, 0.0],
        "axis": [0.0, 2.0, 1.0],
        "angle": 0.3,
    },
    "sphere": {"centre": [1.0, 2.0, 3.0], "radius": 0.5},
    "capsule": {"start": [1.0, 2.0, 3.0], "end": [0.0, 0.0, 1.0], "radius": 0.5},
    "cylinder": {"start": [1.0, 2.0, 3.0], "end": [0.0, 0.0, 1.0], "radius": 0.5},
    "plane": {"point": [1.0, 2.0, 3.0], "normal": [0.0, 0.5, 1.0]},
    "box": {
        "centre": [1.0, 2.0, 3.0],
        "half_lengths": [1.0, 2.0, 3.0],
        "orientation": [1.0, 0.5, 0.0, 0.0],
    },
    "signed_distance": {"function": ..., "parameters": 1.0},
    "contact": {
        "bodies": ...,
        "stiffness": 1e3,
        "damping": 2.0,
        "friction": 0.3,
        "friction_drag": 4.0,
        "onset": 0.02,
    },
    "implicit": {"spectral_radius": 0.5, "tolerance": 1e-4},
    "control_spline": {"controls": [0.2, 0.4, 0.7, 1.0], "length": 1.2},
    "spline_couples": {
        "rod": ...,
        "spline": ...,
        "controls": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]],
        "couple_density": [1.0, 2.0, 3.0],
    },
    "limit_rate": {
        "applied": [1.0, 2.0],
        "commanded": [1.5, -3.0],
        "largest_change": 0.5,
    },
    "rollout_times": {"dt": 1e-3, "n_steps": 4, "every": 2},
    "stable_dt": {"scene": ..., "safety": 0.5},
    "scale_inertia": {"scene": ..., "dt": 1e-3},
}
"""Functions of numbers, with good values; `...` stands for what `things` has."""

RUNS: dict[str, dict[str, Any]] = {
    "step": {"scene": ..., "state": ..., "dt": 1e-4},
    "advance": {"scene": ..., "state": ..., "dt": 1e-4, "n_steps": 2},
    "rollout": {"scene": ..., "state": ..., "dt": 1e-4, "n_steps": 2, "every": 1},
    "equilibrium": {
        "scene": ...,
        "state": ...,
        "tolerance": 1e-4,
        "max_iterations": 5,
    },
}
"""Runs of the simulation: of what they are given, only what is wrong is tried."""

COUNTED: dict[str, dict[str, Any]] = {
    "straight_rod": {"n_elements": ..., "length": 1.0, **MATERIAL},
    "contact": {"bodies": ..., "stiffness": 1.0, "points_per_element": ...},
    "implicit": {"max_iterations": ...},
    "control_spline": {"controls": ...},
    "near_contact": {"contact": ..., "rod": ..., "state": ..., "count": ...},
    "highest_frequency": {"scene": ..., "state": ..., "size": ...},
    "natural_frequencies": {"scene": ..., "state": ..., "n_modes": ...},
    "frequency_changes": {"scaling": ..., "state": ..., "n_modes": ...},
    "rollout_times": {"dt": 1e-3, "n_steps": ..., "every": ...},
    "step": {"scene": ..., "state": ..., "dt": 1e-4, "first": ...},
    "advance": {
        "scene": ...,
        "state": ...,
        "dt": 1e-4,
        "n_steps": ...,
        "first": ...,
    },
    "rollout": {
        "scene": ...,
        "state": ...,
        "dt": 1e-4,
        "n_steps": ...,
        "every": ...,
        "first": ...,
    },
    "equilibrium": {"scene": ..., "state": ..., "max_iterations": ...},
    "configure_cpu": {"devices": ...},
}
COUNT_NAMES = {
    "n_elements",
    "points_per_element",
    "max_iterations",
    "count",
    "size",
    "n_modes",
    "n_steps",
    "every",
    "first",
    "devices",
}

OF_KINDS: dict[str, dict[str, Any]] = {
    "clamp": {"state": ...},
    "fixed_end": {"state": ...},
    "pin": {"state": ...},
    "hinge": {"state": ..., "axis": (0.0, 1.0, 0.0)},
    "driven": {"state": ...},
    "reactions": {"scene": ..., "state": ...},
    "compensated": {"state": ...},
    "make_scene": {"rod": ...},
    "unstressed": {"rod": ..., "state": ...},
    "strains": {"rod": ..., "state": ...},
    "stored_energy": {"rod": ..., "state": ...},
    "kinetic_energy": {"rod": ..., "state": ...},
    "momentum": {"rod": ..., "state": ...},
    "angular_momentum": {"rod": ..., "state": ...},
    "angular_velocities": {"rod": ..., "state": ...},
    "with_angular_velocities": {
        "rod": ...,
        "state": ...,
        "angular_velocities": np.zeros((3, 3)),
    },
    "potential_energy": {"scene": ..., "state": ...},
    "total_energy": {"scene": ..., "state": ...},
    "near_contact": {"contact": ..., "rod": ..., "state": ..., "count": 1},
    "contact": {"bodies": ..., "stiffness": 1.0},
    "spline_couples": {
        "rod": ...,
        "spline": ...,
        "controls": np.zeros((3, 2)),
        "couple_density": 1.0,
    },
    "stable_dt": {"scene": ...},
    "highest_frequency": {"scene": ..., "state": ...},
    "natural_frequencies": {"scene": ..., "state": ...},
    "scale_inertia": {"scene": ...},
    "frequency_changes": {"scaling": ..., "state": ...},
    **RUNS,
}

WRONG = ("nan", "inf", "-1", "0", "True", "1+0j", "None", "'x'", "1e-45", "10**400")
"""Values that are wrong for every number that a run is given."""


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
            if good is ... or argument in COUNT_NAMES:
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
    for function in ("straight_rod", "rod_along", "control_spline"):
        cases += [Case(function, "dtype", k, v) for k, v in DTYPES.items()]
    for function in ("clamp", "fixed_end", "end_load", "hinge", "driven"):
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
        optional = {"n_modes", "devices", "tolerance", "dtype", "method", "law"}
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
            "end_load": {},
            "clamp": {"state": ...},
            "fixed_end": {"state": ...},
            "hinge": {"state": ..., "axis": (0.0, 1.0, 0.0)},
            "driven": {"state": ...},
            "make_scene": {"rod": ...},
            "planar": {"plane": "xy"},
        }[case.function]
    if case.function in NUMERIC and case.argument in NUMERIC[case.function]:
        arguments = NUMERIC[case.function] | (
            {} if case.argument not in COUNT_NAMES else arguments
        )
    given = {}
    for name, good in arguments.items():
        if good is ...:
            good = known.get(name, 2)
        given[name] = good
    value = case.value
    if isinstance(value, str) and value in ("rod", "state", "scene"):
        value = known[value]
    elif isinstance(value, str) and value == "pair":
        value = known["rod"], known["state"]
    elif isinstance(value, str) and value == "generator":
        value = (float(k) for k in range(3))
    given[case.argument] = value
    function = getattr(jaxrod, case.function)
    if case.function == "make_scene":
        return function(given.pop("rod"), **given)
    return function(**given)


def outcome(case: Case, *, must_refuse: bool) -> str:
    """ "refused" or "accepted", or the fault in words."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", jaxrod.UnstableStepWarning)
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
