"""Nodes of a graph as JAX operations, on a vector of rods or on a single number.

Some operations differ between a GPU's compiler and XLA: extremes with NaN, integer
division by zero, shifts by more than the number of bits, and conversion of floats that
are too large for the integer. They are composed here from operations on which both
agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jax import lax

from jaxrod.lanes.graph import DTYPES, Graph
from jaxrod.lanes.unroll import NotUnrolled

SHORT_MEMORY = 100
"""Number of operations after which a shared number is loaded again rather than kept,
because registers are few. Not tuned on a GPU."""

_OF_JAX: dict[str, Callable[..., Any]] = {
    **{name: getattr(lax, name) for name in ("add", "sub", "mul", "div", "abs")},
    **{name: getattr(lax, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
    **{name: getattr(lax, name) for name in ("sqrt", "rsqrt", "floor", "ceil")},
    **{name: getattr(lax, name) for name in ("sin", "cos", "tan", "asin", "acos")},
    **{name: getattr(lax, name) for name in ("atan", "atan2", "sinh", "cosh", "tanh")},
    **{name: getattr(lax, name) for name in ("asinh", "acosh", "atanh", "exp", "exp2")},
    **{name: getattr(lax, name) for name in ("expm1", "log", "log1p", "cbrt", "pow")},
    **{name: getattr(lax, name) for name in ("rem", "erf", "erfc")},
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "xor": lax.bitwise_xor,
}
_UNKNOWN = frozenset({("erf", "f"), ("erfc", "f"), ("rem", "f")})
"""Unsupported operations, each with the first letter of the kind: Triton has no error
function, and its remainder of floats is wrong if the quotient is large."""


def refused_on_gpu(graph: Graph, nodes: Iterable[int]) -> None:
    """Refuses operations that a GPU's compiler cannot do, or does wrong.

    Raises:
        NotUnrolled: A node is such an operation.
    """
    for node in nodes:
        operation, kind = graph.operations[node], graph.kinds[node]
        if (operation, kind[0]) in _UNKNOWN:
            raise NotUnrolled(
                f"lanes on a GPU have no '{operation}' of type {DTYPES[kind]}"
            )
        if kind == "u64":
            raise NotUnrolled("lanes on a GPU have no numbers of type uint64")


class Values:
    """Values of nodes, each computed once, or loaded on demand."""

    def __init__(
        self,
        graph: Graph,
        shape: tuple[int, ...],
        load: Callable[[int], Any],
        known: Mapping[int, Any] | None = None,
    ) -> None:
        """Begins a piece of straight-line code.

        Args:
            graph: Graph whose nodes are computed.
            shape: Shape of every value: one axis of rods, or none.
            load: Function that loads the number of a node that all rods share.
            known: Values of nodes that are not computed here.
        """
        self.graph, self.shape, self.load = graph, shape, load
        self.made: dict[int, Any] = dict(known or {})
        self.loaded: dict[int, tuple[Any, int]] = {}
        self.count = 0
        """Number of operations so far."""

    def work_out(
        self, nodes: Sequence[int], rate: int, take: Callable[[int, Any], None]
    ) -> None:
        """Computes nodes, and passes each on as soon as it is computed.

        Args:
            nodes: Nodes to compute.
            rate: Rate of the nodes that are computed here; nodes of a lower rate are
                known or loaded.
            take: Function that receives each node with its value.
        """
        graph, wanted = self.graph, set(nodes)
        for node in graph.needed(nodes):
            if graph.rates[node] == rate and graph.operations[node] != "input":
                self.made[node] = self.operation(node)
                self.count += 1
            if node in wanted:
                take(node, self.value(node))

    def value(self, node: int) -> Any:
        """Returns the value of a node."""
        made = self.made.get(node)
        if made is not None:
            return made
        known = self.graph.value(node)
        if known is not None:
            self.made[node] = full = self.full(known, self.graph.kinds[node])
            return full
        found, when = self.loaded.get(node, (None, 0))
        if found is None or self.count - when > SHORT_MEMORY:
            found = self.spread(self.load(node))
            self.loaded[node] = found, self.count
        return found

    def full(self, value: Any, kind: str) -> Any:
        """Returns a known number in the shape of the values."""
        return lax.full(self.shape, value, DTYPES[kind])

    def spread(self, value: Any) -> Any:
        """Broadcasts a number that all rods share to the shape of the values."""
        if value.shape == self.shape:
            return value
        return lax.broadcast(value, self.shape)

    def operation(self, node: int) -> Any:
        """Computes one operation."""
        graph = self.graph
        name, kind = graph.operations[node], graph.kinds[node]
        sources = graph.arguments[node]
        given = [self.value(source) for source in sources]
        if name == "select":
            return lax.select(*given)
        if name == "convert":
            return self._convert(given[0], graph.kinds[sources[0]], kind)
        if name in ("min", "max"):
            return self._extreme(name, given, kind)
        if name == "neg":
            # Triton negates by subtracting from zero, which loses the sign of a zero.
            return lax.mul(given[0], self.full(-1, kind))
        if name == "not":
            ones = True if kind == "b1" else np.invert(DTYPES[kind].type(0))
            return lax.bitwise_xor(given[0], self.full(ones, kind))
        if name in ("round_even", "round_away"):
            return self._round(name, given[0], kind)
        if name in ("div", "rem") and kind[0] != "f":
            return self._divide(name, given, kind)
        if name.startswith("shift"):
            return self._shift(name, given, kind)
        if name == "abs" and kind[0] == "u":
            return given[0]
        return _OF_JAX[name](*given)

    def _extreme(self, name: str, given: list[Any], kind: str) -> Any:
        """Returns the smaller or larger number; NaN if one of them is NaN."""
        a, b = given
        better = (lax.lt if name == "min" else lax.gt)(a, b)
        if kind[0] == "f":
            better = lax.bitwise_or(better, lax.ne(a, a))
        return lax.select(better, a, b)

    def _round(self, name: str, x: Any, kind: str) -> Any:
        """Rounds to the nearest integer; halves go to even, or away from zero."""
        size = lax.abs(x)
        below = lax.floor(size)
        rest = lax.sub(size, below)
        half, one = self.full(0.5, kind), self.full(1, kind)
        up = lax.ge(rest, half)
        if name == "round_even":
            pairs = lax.mul(lax.floor(lax.mul(below, half)), self.full(2, kind))
            odd = lax.ne(below, pairs)
            up = lax.bitwise_or(
                lax.gt(rest, half), lax.bitwise_and(odd, lax.eq(rest, half))
            )
        made = lax.select(up, lax.add(below, one), below)
        # For infinity `rest` is NaN, and `up` is false.
        minus = lax.mul(made, self.full(-1, kind))
        return lax.select(lax.lt(x, self.full(0, kind)), minus, made)

    def _divide(self, name: str, given: list[Any], kind: str) -> Any:
        """Divides integers as XLA does, by zero too, and the least integer by -1."""
        number, by = given
        zero, one = self.full(0, kind), self.full(1, kind)
        nothing = odd = lax.eq(by, zero)
        if kind[0] == "i":
            info = np.iinfo(DTYPES[kind])
            least = lax.eq(number, self.full(info.min, kind))
            minus = lax.eq(by, self.full(-1, kind))
            odd = lax.bitwise_or(nothing, lax.bitwise_and(least, minus))
        safe = lax.select(odd, one, by)
        if name == "rem":
            made = lax.rem(number, safe)
            return lax.select(nothing, number, made)
        ones = self.full(np.invert(DTYPES[kind].type(0)), kind)
        return lax.select(nothing, ones, lax.div(number, safe))

    def _shift(self, name: str, given: list[Any], kind: str) -> Any:
        """Shifts; a shift by more than the number of bits gives zero, or all signs."""
        number, by = given
        bits = 8 * DTYPES[kind].itemsize
        inside = lax.lt(by, self.full(bits, kind))
        zero = self.full(0, kind)
        if kind[0] == "i":
            inside = lax.bitwise_and(inside, lax.ge(by, zero))
        if name == "shift_right_arithmetic":
            most = self.full(bits - 1, kind)
            return lax.shift_right_arithmetic(number, lax.select(inside, by, most))
        shift = getattr(lax, name)
        return lax.select(inside, shift(number, lax.select(inside, by, zero)), zero)

    def _convert(self, x: Any, before: str, after: str) -> Any:
        """Converts to another kind; floats saturate at the limits of an integer."""
        if before[0] != "f" or after[0] == "f":
            return lax.convert_element_type(x, DTYPES[after])
        info = np.iinfo(DTYPES[after])
        # The first float that is too large: a power of two.
        high = self.full(float(2 ** (info.bits - (after[0] == "i"))), before)
        low = self.full(float(info.min), before)
        above, below = lax.ge(x, high), lax.lt(x, low)
        odd = lax.bitwise_or(lax.bitwise_or(above, below), lax.ne(x, x))
        safe = lax.select(odd, self.full(0, before), x)
        made = lax.convert_element_type(safe, DTYPES[after])
        made = lax.select(above, self.full(info.max, after), made)
        return lax.select(below, self.full(info.min, after), made)


def type_in_memory(kind: str) -> Any:
    """Returns the dtype of a kind in memory: booleans are stored as `int32`."""
    return np.dtype(np.int32) if kind == "b1" else DTYPES[kind]


def from_memory(value: Any, kind: str) -> Any:
    """Converts a loaded value to its kind."""
    if kind != "b1":
        return value
    return lax.ne(value, lax.full_like(value, 0))


def to_memory(value: Any, kind: str) -> Any:
    """Converts a value to its type in memory."""
    return lax.convert_element_type(value, type_in_memory(kind))
