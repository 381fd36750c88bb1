"""Table of the operations on single numbers that kernels consist of.

To add an elementary function of the C library, add a row here. The row gives it an
unrolling rule, constant folding if it has a NumPy function, and a call in each lane. A
separate vector function is added in `jaxrod.lanes.llvm.elementary`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Operation:
    """An operation on single numbers."""

    name: str
    """Name in graphs. If `primitive` is true, it is the name of the JAX primitive
    too."""
    fold: Callable[..., Any] | None = None
    """Function of NumPy numbers that folds constants; `None` if they are not folded."""
    llvm: str | None = None
    """LLVM's instruction for floats, or its intrinsic if the name begins with
    `llvm.`."""
    symbol: str | None = None
    """Name of the function in the C library for double precision; `None` without
    one."""
    operands: int = 1
    """Number of operands."""
    kinds: str = "f"
    """Types of the operands, by first letter: floats (f), signed integers (i), unsigned
    integers (u), booleans (b)."""
    primitive: bool = True
    """Whether it is a JAX primitive whose result has the type of its operands."""
    compares: bool = False
    """Whether it is a JAX primitive whose result is boolean."""
    commutes: bool = False
    """Whether its two operands may be swapped."""


def _library(name: str, operands: int = 1) -> Operation:
    """Returns an elementary function that JAX and the C library name alike."""
    return Operation(name, symbol=name, operands=operands)


def _two(name: str, **more: Any) -> Operation:
    """Returns an operation with two operands, floats or integers by default."""
    return Operation(name, **{"operands": 2, "kinds": "fiu", **more})


def _compares(name: str, fold: Callable[..., Any], **more: Any) -> Operation:
    """Returns a comparison of two numbers of any type."""
    return _two(name, fold=fold, primitive=False, compares=True, kinds="fiub", **more)


_ROWS = (
    _two("add", fold=lambda a, b: a + b, llvm="fadd", commutes=True),
    _two("sub", fold=lambda a, b: a - b, llvm="fsub"),
    _two("mul", fold=lambda a, b: a * b, llvm="fmul", commutes=True),
    _two("div", fold=np.divide, llvm="fdiv"),
    _two("rem", llvm="frem"),
    _two("min", fold=np.minimum),
    _two("max", fold=np.maximum),
    Operation("neg", lambda a: -a, kinds="fiu"),
    Operation("abs", np.abs, "llvm.fabs", kinds="fiu"),
    Operation("sqrt", np.sqrt, "llvm.sqrt"),
    Operation("rsqrt"),
    Operation("floor", np.floor, "llvm.floor"),
    Operation("ceil", np.ceil, "llvm.ceil"),
    Operation("round_even", llvm="llvm.roundeven", primitive=False),
    Operation("round_away", llvm="llvm.round", primitive=False),
    _compares("eq", lambda a, b: a == b, commutes=True),
    _compares("ne", lambda a, b: a != b, commutes=True),
    _compares("lt", lambda a, b: a < b),
    _compares("le", lambda a, b: a <= b),
    _compares("gt", lambda a, b: a > b),
    _compares("ge", lambda a, b: a >= b),
    _two("and", fold=lambda a, b: a & b, commutes=True, kinds="iub"),
    _two("or", fold=lambda a, b: a | b, commutes=True, kinds="iub"),
    _two("xor", fold=lambda a, b: a ^ b, commutes=True, kinds="iub"),
    Operation("not", lambda a: ~a, kinds="iub"),
    _two("shift_left", kinds="iu"),
    _two("shift_right_logical", kinds="iu"),
    _two("shift_right_arithmetic", kinds="iu"),
    Operation("select", operands=3, kinds="fiub", primitive=False),
    Operation("convert", lambda a: a, kinds="fiub", primitive=False),
    _library("sin"),
    _library("cos"),
    _library("tan"),
    _library("asin"),
    _library("acos"),
    _library("atan"),
    _library("atan2", operands=2),
    _library("sinh"),
    _library("cosh"),
    _library("tanh"),
    _library("asinh"),
    _library("acosh"),
    _library("atanh"),
    _library("exp"),
    _library("exp2"),
    _library("expm1"),
    _library("log"),
    _library("log1p"),
    _library("cbrt"),
    _library("erf"),
    _library("erfc"),
    _library("pow", operands=2),
)
OPERATIONS = {row.name: row for row in _ROWS}
"""All operations, by name."""
