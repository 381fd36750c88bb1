"""Graphs of operations on single numbers, in which each operation is computed once.

A node is an integer. The operation, the arguments and the number type ("kind") of each
node are kept in parallel lists. Kinds are `f32`, `f64`, `i8` to `i64`, `u8` to `u64`
and `b1`. The same operation on the same arguments is the same node (common
subexpressions), and constants are folded.

Folding does not change results, with two exceptions. Adding or subtracting a constant
zero, or subtracting from it, may give a zero of the other sign. A product with a
constant zero is that zero, even if the other factor is NaN, infinite or negative; the
other factor is left out of the program.

One table has all operations. To add an elementary function of the C library, add a row
to it. The row gives it an unrolling rule, constant folding if it has a NumPy function,
and a call in each lane. A separate vector function is added in
`jaxrod.lanes.llvm.elementary`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Operation:
    """An operation on single numbers: a row of the table `OPERATIONS`."""

    name: str
    """Name in graphs. If `primitive` is true, it is the name of the JAX primitive
    too."""
    fold: Callable[..., Any] | None = None
    """Function of NumPy numbers that computes the result if all operands are constants;
    `None` if it is not computed in advance."""
    llvm: str | None = None
    """LLVM instruction for floats, such as `fadd`, or intrinsic, such as `llvm.sqrt`;
    `None` if there is neither."""
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
    """Returns the row of a function that JAX and the C library give the same name.

    `operands` is the number of its arguments.
    """
    return Operation(name, symbol=name, operands=operands)


def _two(name: str, **more: Any) -> Operation:
    """Returns the row of an operation with two operands.

    They are floats or integers by default. `more` has further fields of `Operation`.
    """
    return Operation(name, **{"operands": 2, "kinds": "fiu", **more})


def _compares(name: str, fold: Callable[..., Any], **more: Any) -> Operation:
    """Returns the row of a comparison of two numbers of any type.

    `fold` compares NumPy numbers. `more` has further fields of `Operation`.
    """
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


DTYPES: dict[str, np.dtype] = {
    "f32": np.dtype(np.float32),
    "f64": np.dtype(np.float64),
    "i8": np.dtype(np.int8),
    "i16": np.dtype(np.int16),
    "i32": np.dtype(np.int32),
    "i64": np.dtype(np.int64),
    "u8": np.dtype(np.uint8),
    "u16": np.dtype(np.uint16),
    "u32": np.dtype(np.uint32),
    "u64": np.dtype(np.uint64),
    "b1": np.dtype(np.bool_),
}
"""NumPy's dtypes by the name of a number type ("kind")."""
KINDS = {dtype: kind for kind, dtype in DTYPES.items()}

UNIFORM, FIXED, VARYING = 1, 2, 3
"""Rates at which values change. A uniform value is the same for all rods and steps. A
fixed value differs between rods but not between steps. A varying value changes at every
step. Constants of the graph have rate 0."""


class Graph:
    """Operations on single numbers, as numbered nodes in the order of creation."""

    def __init__(self) -> None:
        """Creates an empty graph."""
        self.operations: list[str] = []
        self.arguments: list[tuple[int, ...]] = []
        self.kinds: list[str] = []
        self.rates: list[int] = []
        self.values: dict[int, Any] = {}
        """Values of the constants of the graph, by node."""
        self.places: dict[int, tuple[int, int]] = {}
        """Origin of each input node: number of the input array, and flat index in
        it."""
        self.tables: dict[int, int] = {}
        """First input node of the table from which each lookup reads, by node."""
        self._known: dict[Any, int] = {}

    def __len__(self) -> int:
        """Number of nodes."""
        return len(self.operations)

    @property
    def n_operations(self) -> int:
        """Number of nodes that are not entries of input arrays."""
        return len(self) - len(self.places)

    def constant(self, value: Any, kind: str) -> int:
        """Returns the node of a known number of type `kind`, such as `"f32"`."""
        number = np.asarray(value).astype(DTYPES[kind])[()]
        key = ("constant", kind, number.tobytes())
        node = self._known.get(key)
        if node is None:
            node = self._new("constant", (), kind, 0)
            self._known[key] = node
            self.values[node] = number
        return node

    def constants(self, array: Any) -> np.ndarray:
        """Returns an array of constant nodes, one for each number of an array."""
        array = np.asarray(array)
        kind = KINDS[array.dtype]
        return self.mapped(lambda value: self.constant(value, kind), array)

    def inputs(self, which: int, shape: tuple[int, ...], kind: str, rate: int) -> Any:
        """Returns an array of new nodes, one for each entry of an input array.

        The array has number `which` among the inputs, type `kind` (such as `"f32"`) and
        rate of change `rate` (`UNIFORM`, `FIXED` or `VARYING`).
        """
        nodes = np.empty(shape, np.int64)
        flat = nodes.reshape(-1)
        for entry in range(flat.size):
            flat[entry] = node = self._new("input", (), kind, rate)
            self.places[node] = (which, entry)
        return nodes

    def looked_up(self, first: int, index: int) -> int:
        """Returns the node of an entry of an input array at a computed index.

        The array's rate is `UNIFORM`. The index, whose kind is `i32`, counts from the
        input node `first` and must be inside the array.
        """
        key = ("lookup", first, index)
        node = self._known.get(key)
        if node is None:
            rate = max(UNIFORM, self.rates[index])
            node = self._new("lookup", (index,), self.kinds[first], rate)
            self._known[key] = node
            self.tables[node] = first
        return node

    def add(self, operation: str, arguments: tuple[int, ...], kind: str) -> int:
        """Returns the node of an operation: an existing, a simpler or a new one.

        `kind` is the type of the result, such as `"f32"`.
        """
        if OPERATIONS[operation].commutes and arguments[0] > arguments[1]:
            arguments = (arguments[1], arguments[0])
        key = (operation, arguments, kind)
        node = self._known.get(key)
        if node is None:
            node = self._folded(operation, arguments, kind)
            if node is None:
                rate = max(UNIFORM, *(self.rates[a] for a in arguments))
                node = self._new(operation, arguments, kind, rate)
            self._known[key] = node
        return node

    def mapped(self, function: Callable[..., int], *arrays: Any) -> np.ndarray:
        """Returns the nodes that a function returns for the entries of arrays.

        The arrays are broadcast against each other. `function` takes an entry of each.
        """
        shaped = np.broadcast_arrays(*arrays)
        nodes = np.empty(shaped[0].shape, np.int64)
        columns = [array.reshape(-1).tolist() for array in shaped]
        if isinstance(arrays[0], np.ndarray) and arrays[0].dtype != np.int64:
            columns[0] = list(shaped[0].reshape(-1))
        nodes.reshape(-1)[:] = [
            function(*entries) for entries in zip(*columns, strict=True)
        ]
        return nodes

    def each(self, operation: str, kind: str, *arrays: Any) -> np.ndarray:
        """Returns an array of the nodes of an operation, applied entry by entry.

        The arrays of operands are broadcast. `kind` is the type of the results.
        """
        return self.mapped(lambda *entries: self.add(operation, entries, kind), *arrays)

    def value(self, node: int) -> Any:
        """Returns the number of a constant node; `None` for any other node."""
        return self.values.get(node)

    def needed(self, outputs: Iterable[int]) -> list[int]:
        """Returns the nodes on which outputs depend, each after its arguments.

        The order is depth first, output after output: values for one element are used
        before those for the next element are computed.
        """
        order: list[int] = []
        seen = bytearray(len(self))
        for output in outputs:
            stack = [(output, False)]
            while stack:
                node, expanded = stack.pop()
                if expanded:
                    order.append(node)
                elif not seen[node]:
                    seen[node] = 1
                    stack.append((node, True))
                    stack.extend(
                        (a, False)
                        for a in reversed(self.arguments[node])
                        if not seen[a]
                    )
        return order

    def _new(
        self, operation: str, arguments: tuple[int, ...], kind: str, rate: int
    ) -> int:
        self.operations.append(operation)
        self.arguments.append(arguments)
        self.kinds.append(kind)
        self.rates.append(rate)
        return len(self.operations) - 1

    def _folded(
        self, operation: str, arguments: tuple[int, ...], kind: str
    ) -> int | None:
        """Returns a simpler node with the value of an operation, or `None`.

        For example, x + 0 is x, and an operation on constants is a constant. `kind` is
        the type of the result, such as `"f32"`.
        """
        known = [self.values.get(a) for a in arguments]
        if operation == "select":
            return _chosen(arguments, known)
        if all(value is not None for value in known):
            return self._worked_out(operation, known, kind)
        if kind == "b1":
            return self._folded_logic(operation, arguments, known)
        first, *rest = arguments
        if operation in ("add", "mul"):
            for one, other, number in (
                (arguments[1], arguments[0], known[0]),
                (arguments[0], arguments[1], known[1]),
            ):
                if number is None:
                    continue
                if operation == "add" and number == 0:
                    return one
                if operation == "mul" and number == 1:
                    return one
                if operation == "mul" and number == 0:
                    return other
                if operation == "mul" and number == -1 and kind[0] == "f":
                    return self.add("neg", (one,), kind)
        if operation == "sub" and known[1] is not None and known[1] == 0:
            return first
        if operation == "sub" and known[0] is not None and known[0] == 0:
            return self.add("neg", (rest[0],), kind)
        if operation == "div" and known[1] is not None and kind[0] == "f":
            return self._divided(first, known[1], kind)
        if operation == "neg" and self.operations[first] == "neg":
            return self.arguments[first][0]
        if operation in ("and", "or") and first == rest[0]:
            return first
        return None

    def _folded_logic(
        self, operation: str, arguments: tuple[int, ...], known: list[Any]
    ) -> int | None:
        if operation == "not" and self.operations[arguments[0]] == "not":
            return self.arguments[arguments[0]][0]
        if operation not in ("and", "or"):
            return None
        for one, number in ((arguments[1], known[0]), (arguments[0], known[1])):
            if number is None:
                continue
            if operation == "and":
                return one if number else self.constant(False, "b1")
            return self.constant(True, "b1") if number else one
        return arguments[0] if arguments[0] == arguments[1] else None

    def _divided(self, node: int, by: Any, kind: str) -> int | None:
        """Returns the node of `node / by` if no division is needed; otherwise `None`.

        A quotient by 1 is `node`. A quotient by a power of two becomes a product, which
        is exact.
        """
        if by == 1:
            return node
        mantissa, exponent = math.frexp(float(by))
        if abs(mantissa) == 0.5 and abs(exponent) < 100:
            return self.add("mul", (node, self.constant(1 / by, kind)), kind)
        return None

    def _worked_out(self, operation: str, known: list[Any], kind: str) -> int | None:
        function = OPERATIONS[operation].fold
        if function is None or (operation == "div" and kind[0] != "f"):
            return None
        with np.errstate(all="ignore"):
            return self.constant(function(*known), kind)


def _chosen(arguments: tuple[int, ...], known: list[Any]) -> int | None:
    """Returns the argument that a `select` always returns, or `None`.

    The arguments are the nodes of the condition, of the result if it is true, and of
    the result if it is false. `known` contains the value of each, or `None` if it is
    not a constant.
    """
    if known[0] is not None:
        return arguments[1] if known[0] else arguments[2]
    return arguments[1] if arguments[1] == arguments[2] else None


@dataclass(frozen=True)
class Entries:
    """Type, size and rate of change of one operand or result of a rod's program."""

    kind: str
    """Type of the numbers, such as `"f32"`."""
    size: int
    """Number of entries."""
    rate: int
    """Rate at which the numbers change: `UNIFORM` (the same for all rods and steps),
    `FIXED` (for each rod) or `VARYING` (at every step)."""


@dataclass(frozen=True)
class Step:
    """One step as a graph: it takes constants and a carry to the next carry."""

    graph: Graph
    constants: Sequence[Entries]
    carry: Sequence[Entries]
    outputs: Sequence[Sequence[int]]
    """Nodes of the next carry: a list of nodes for each array."""


@dataclass(frozen=True)
class EndNodes:
    """The beginning and the end of a run, as nodes in the graph of the step."""

    given: Sequence[Entries]
    """Arguments of the run, from which its beginning computes the first carry."""
    begun: Sequence[Sequence[int]]
    """Nodes of the first carry: a list of nodes for each array."""
    made: Sequence[Entries]
    """Results of the run, which its end computes from the last carry."""
    ended: Sequence[Sequence[int]]
    """Nodes of the results: a list of nodes for each array."""
