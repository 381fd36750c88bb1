"""Nodes of a graph as straight-line LLVM IR of vectors.

Every node that differs between rods becomes one vector, with a rod in each lane. Nodes
that all rods share are computed once, as single numbers, and broadcast where used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from jaxrod.lanes.graph import OPERATIONS, Graph

TYPES = {
    "f32": "float",
    "f64": "double",
    "i8": "i8",
    "u8": "i8",
    "i16": "i16",
    "u16": "i16",
    "i32": "i32",
    "u32": "i32",
    "i64": "i64",
    "u64": "i64",
    "b1": "i1",
}
"""LLVM types of single numbers, by number type ("kind") of the graph."""
BYTES = {
    **{"f32": 4, "f64": 8, "i8": 1, "u8": 1, "i16": 2, "u16": 2},
    **{"i32": 4, "u32": 4, "i64": 8, "u64": 8, "b1": 1},
}
"""Sizes of single numbers in memory [bytes], by number type ("kind")."""
_WHOLE = {"add": "add", "sub": "sub", "mul": "mul"}
_COMPARE_FLOATS = {
    **{"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
}
_COMPARE_WHOLE = {
    "eq": "eq",
    "ne": "ne",
    "lt": "lt",
    "le": "le",
    "gt": "gt",
    "ge": "ge",
}
SHORT_MEMORY = 400
"""Number of lines after which a loaded value is loaded again instead of being kept in a
register, because registers are few and memory is fast."""


class Writer:
    """Writer of an LLVM function whose values are vectors, or single numbers."""

    def __init__(
        self,
        graph: Graph,
        width: int,
        load: Callable[[Writer, int], str | None],
        table: Callable[[Writer, int], str] | None = None,
    ) -> None:
        """Begins an LLVM function without lines.

        Args:
            graph: Graph whose nodes are translated.
            width: Lanes of a vector; 1 for single numbers.
            load: Function that writes the load of a node from memory and returns the
                name of its value; it returns `None` for a node that this function
                computes.
            table: Function that writes the address of an input node that all rods
                share, and returns the name of the pointer; `None` without lookups.
        """
        self.graph, self.width, self.load = graph, width, load
        self.table = table
        self.lines: list[str] = []
        self.names: dict[int, str] = {}
        self.loaded: dict[int, tuple[str, int]] = {}
        self.needs: set[tuple[str, str, int]] = set()
        """Elementary functions that the lines call: operation, number type and lanes of
        each."""
        self.declared: set[str] = set()

    def type(self, kind: str) -> str:
        """Returns the LLVM type of a vector, or of one number, of type `kind`."""
        one = TYPES[kind]
        return one if self.width == 1 else f"<{self.width} x {one}>"

    def new(self, text: str) -> str:
        """Appends a line that computes the expression `text`; returns its name."""
        name = f"%v{len(self.lines)}"
        self.lines.append(f"{name} = {text}")
        return name

    def literal(self, value: Any, kind: str) -> str:
        """Returns a number of type `kind` as LLVM text, repeated in every lane."""
        text = literal(value, kind)
        if self.width == 1:
            return text
        entry = f"{TYPES[kind]} {text}"
        return "<" + ", ".join([entry] * self.width) + ">"

    def spread(self, name: str, kind: str) -> str:
        """Appends lines that copy a number to every lane; returns the vector's name.

        `name` is the name of the number, `kind` its type, such as `"f32"`.
        """
        if self.width == 1:
            return name
        one, many = TYPES[kind], self.type(kind)
        first = self.new(f"insertelement {many} poison, {one} {name}, i64 0")
        return self.new(
            f"shufflevector {many} {first}, {many} poison, "
            f"<{self.width} x i32> zeroinitializer"
        )

    def write(self, nodes: Iterable[int], after: Callable[[int], None]) -> None:
        """Appends the lines of nodes in order; calls `after` with each finished one."""
        for node in nodes:
            if node in self.names:
                continue
            if self.graph.operations[node] not in ("constant", "input"):
                self.names[node] = self.operation(node)
            after(node)

    def value(self, node: int) -> str:
        """Returns the name of a node's value, which is loaded from memory if needed."""
        name = self.names.get(node)
        if name is not None:
            return name
        known = self.graph.value(node)
        if known is not None:
            return self.literal(known, self.graph.kinds[node])
        name, line = self.loaded.get(node, ("", 0))
        if not name or len(self.lines) - line > SHORT_MEMORY:
            found = self.load(self, node)
            if found is None:
                raise AssertionError(f"node {node} is used before it is computed")
            name = found
            self.loaded[node] = name, len(self.lines)
        return name

    def operation(self, node: int) -> str:
        """Appends the lines of one node's operation; returns the name of its value."""
        graph = self.graph
        operation, kind = graph.operations[node], graph.kinds[node]
        sources = graph.arguments[node]
        names = [self.value(a) for a in sources]
        source_kind = graph.kinds[sources[-1]]
        if operation == "lookup":
            assert self.table is not None
            return self._lookup(self.table(self, graph.tables[node]), names[0], kind)
        if operation == "select":
            return self._select(names, kind)
        if operation in _COMPARE_FLOATS:
            return self._compare(operation, names, source_kind)
        if operation == "convert":
            return self._convert(names[0], source_kind, kind)
        if operation == "rsqrt":
            root = self._intrinsic("llvm.sqrt", kind, names)
            one = self.literal(1, kind)
            return self.new(f"fdiv contract {self.type(kind)} {one}, {root}")
        if operation in ("min", "max"):
            return self._extreme(operation, sources, names, kind)
        if kind[0] == "f":
            return self._float(operation, names, kind)
        return self._whole(operation, names, kind)

    def _lookup(self, table: str, index: str, kind: str) -> str:
        """Appends the read of a number in each lane, from a table at computed indices.

        `table` is the pointer to the first number, of type `kind`; `index` is the name
        of the indices.
        """
        one = "i8" if kind == "b1" else TYPES[kind]
        if self.width == 1:
            at = self.new(f"getelementptr {one}, ptr {table}, i32 {index}")
            found = self.new(f"load {one}, ptr {at}, align {BYTES[kind]}")
            return self.new(f"icmp ne i8 {found}, 0") if kind == "b1" else found
        many = f"<{self.width} x i32>"
        return self.entries(
            self.new(f"getelementptr {one}, ptr {table}, {many} {index}"), kind
        )

    def entries(self, pointers: str, kind: str) -> str:
        """Appends the load of a number in each lane; returns the vector's name.

        Args:
            pointers: Name of the vector of pointers to the numbers.
            kind: Type of the numbers, such as `"f32"`.
        """
        w = self.width
        suffix = {"f32": "f32", "f64": "f64"}.get(kind, f"i{8 * BYTES[kind]}")
        name = f"@llvm.masked.gather.v{w}{suffix}.v{w}p0"
        many, truth = f"<{w} x {'i8' if kind == 'b1' else TYPES[kind]}>", f"<{w} x i1>"
        self.declared.add(f"declare {many} {name}(<{w} x ptr>, i32, {truth}, {many})")
        every = "<" + ", ".join(["i1 true"] * w) + ">"
        found = self.new(
            f"call {many} {name}(<{w} x ptr> {pointers}, i32 {BYTES[kind]}, "
            f"{truth} {every}, {many} poison)"
        )
        if kind == "b1":
            found = self.new(f"icmp ne {many} {found}, zeroinitializer")
        return found

    def _float(self, operation: str, names: list[str], kind: str) -> str:
        if operation == "neg":
            return self.new(f"fneg {self.type(kind)} {names[0]}")
        line = OPERATIONS[operation].llvm
        if line is not None and line.startswith("llvm."):
            return self._intrinsic(line, kind, names)
        if line is not None:
            return self.new(f"{line} contract {self.type(kind)} {names[0]}, {names[1]}")
        self.needs.add((operation, kind, self.width))
        many = self.type(kind)
        given = ", ".join(f"{many} {name}" for name in names)
        lanes = "one" if self.width == 1 else self.width
        return self.new(f"call {many} @{operation}_{kind}_{lanes}({given})")

    def _whole(self, operation: str, names: list[str], kind: str) -> str:
        many = self.type(kind)
        if operation in _WHOLE or operation in ("and", "or", "xor"):
            return self.new(f"{operation} {many} {names[0]}, {names[1]}")
        if operation == "neg":
            return self.new(f"sub {many} {self.literal(0, kind)}, {names[0]}")
        if operation == "not":
            ones = self.literal(True if kind == "b1" else -1, kind)
            return self.new(f"xor {many} {names[0]}, {ones}")
        if operation == "abs":
            below = self.new(f"icmp slt {many} {names[0]}, {self.literal(0, kind)}")
            minus = self.new(f"sub {many} {self.literal(0, kind)}, {names[0]}")
            return self._select([below, minus, names[0]], kind)
        if operation in ("div", "rem"):
            return self._divide(operation, names, kind)
        return self._shift(operation, names, kind)

    def _divide(self, operation: str, names: list[str], kind: str) -> str:
        """Appends an integer division or remainder with XLA's results in special cases.

        `names` are dividend and divisor, integers of type `kind`.

        By zero, the quotient is -1 and the remainder is the dividend. The most negative
        number divided by -1 is itself.
        """
        many, (number, by) = self.type(kind), names
        signed = kind[0] == "i"
        zero, one = self.literal(0, kind), self.literal(1, kind)
        nothing = self.new(f"icmp eq {many} {by}, {zero}")
        odd = nothing
        if signed:
            bits = 8 * BYTES[kind]
            minus = self.new(f"icmp eq {many} {by}, {self.literal(-1, kind)}")
            least = self.literal(-(2 ** (bits - 1)), kind)
            lowest = self.new(f"icmp eq {many} {number}, {least}")
            both = self.new(f"and {self.type('b1')} {minus}, {lowest}")
            odd = self.new(f"or {self.type('b1')} {nothing}, {both}")
        safe = self._select([odd, one, by], kind)
        letter = "s" if signed else "u"
        made = self.new(f"{letter}{operation} {many} {number}, {safe}")
        if operation == "rem":
            return self._select([nothing, number, made], kind)
        return self._select([nothing, self.literal(-1, kind), made], kind)

    def _shift(self, operation: str, names: list[str], kind: str) -> str:
        """Appends a shift of bits.

        `names` are the shifted integer and the number of bits, of type `kind`.

        A shift by the number of bits or more gives zero; an arithmetic shift to the
        right then gives the sign bit everywhere.
        """
        many, (number, by) = self.type(kind), names
        bits = 8 * BYTES[kind]
        inside = self.new(f"icmp ult {many} {by}, {self.literal(bits, kind)}")
        if operation == "shift_right_arithmetic":
            most = self.literal(bits - 1, kind)
            return self.new(
                f"ashr {many} {number}, {self._select([inside, by, most], kind)}"
            )
        line = {"shift_left": "shl", "shift_right_logical": "lshr"}[operation]
        safe = self._select([inside, by, self.literal(0, kind)], kind)
        made = self.new(f"{line} {many} {number}, {safe}")
        return self._select([inside, made, self.literal(0, kind)], kind)

    def _select(self, names: list[str], kind: str) -> str:
        many = self.type(kind)
        which, yes, no = names
        return self.new(f"select {self.type('b1')} {which}, {many} {yes}, {many} {no}")

    def _compare(self, operation: str, names: list[str], kind: str) -> str:
        many = self.type(kind)
        if kind[0] == "f":
            test = f"fcmp {_COMPARE_FLOATS[operation]}"
        else:
            letter = "" if operation in ("eq", "ne") else "s" if kind[0] == "i" else "u"
            test = f"icmp {letter}{_COMPARE_WHOLE[operation]}"
        return self.new(f"{test} {many} {names[0]}, {names[1]}")

    def _extreme(
        self, operation: str, sources: tuple[int, ...], names: list[str], kind: str
    ) -> str:
        """Appends the minimum or maximum of two numbers; NaN if one of them is NaN.

        `sources` are the nodes of the numbers, which show whether they are constants.
        `names` are their LLVM names, `kind` is their type.
        """
        many, (a, b) = self.type(kind), names
        if kind[0] != "f":
            sign = "s" if kind[0] == "i" else "u"
            test = "lt" if operation == "min" else "gt"
            first = self.new(f"icmp {sign}{test} {many} {a}, {b}")
            return self._select([first, a, b], kind)
        if self.graph.value(sources[1]) is not None:
            # Comparison with NaN is false, so that the second operand is taken: it
            # must be the one that is not a constant.
            a, b = b, a
        test = "olt" if operation == "min" else "ogt"
        first = self.new(f"fcmp {test} {many} {a}, {b}")
        chosen = self._select([first, a, b], kind)
        if any(self.graph.value(source) is not None for source in sources):
            return chosen
        odd = self.new(f"fcmp uno {many} {a}, {a}")
        return self._select([odd, a, chosen], kind)

    def _intrinsic(self, name: str, kind: str, names: list[str]) -> str:
        many = self.type(kind)
        suffix = kind if self.width == 1 else f"v{self.width}{kind}"
        full = f"@{name}.{suffix}"
        self.declared.add(f"declare {many} {full}({', '.join([many] * len(names))})")
        return self.new(
            f"call {many} {full}({', '.join(f'{many} {n}' for n in names)})"
        )

    def _convert(self, name: str, before: str, after: str) -> str:
        many_before, many_after = self.type(before), self.type(after)
        if before[0] == "f" and after[0] == "f":
            word = "fpext" if BYTES[after] > BYTES[before] else "fptrunc"
        elif before[0] == "f":
            letter = "s" if after[0] == "i" else "u"
            width = "" if self.width == 1 else f"v{self.width}"
            bits = TYPES[after]
            full = f"@llvm.fpto{letter}i.sat.{width}{bits}.{width}{before}"
            self.declared.add(f"declare {many_after} {full}({many_before})")
            return self.new(f"call {many_after} {full}({many_before} {name})")
        elif after[0] == "f":
            word = "sitofp" if before[0] == "i" else "uitofp"
        elif BYTES[after] == BYTES[before] and before != "b1":
            return self.new(f"or {many_after} {name}, {self.literal(0, after)}")
        elif BYTES[after] < BYTES[before]:
            word = "trunc"
        else:
            word = "sext" if before[0] == "i" else "zext"
        return self.new(f"{word} {many_before} {name} to {many_after}")


def literal(value: Any, kind: str) -> str:
    """Returns a number of type `kind` as LLVM text; floats in hexadecimal, exactly."""
    if kind == "b1":
        return "true" if value else "false"
    if kind[0] == "f":
        return f"0x{int(np.float64(value).view(np.uint64)):016X}"
    return str(int(value))
