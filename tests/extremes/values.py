"""Bad and extreme values: for numbers, vectors, counts, things and words."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod

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
    "'finish'": "finish",
    "[]": [],
    "array": np.ones(2),
    "True": True,
}
"""Given for a name, such as that of an end; every one is wrong."""

WRONG = ("nan", "inf", "-1", "0", "True", "1+0j", "None", "'x'", "1e-45", "10**400")
"""Values that are wrong for every number that a run is given."""
