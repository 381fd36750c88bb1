"""Writer of programs as C99 headers with static memory, which need `math.h` alone."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxrod.training.exporting.program import (
    OPERATIONS,
    Buffer,
    Each,
    Join,
    Product,
    Program,
    Value,
)

TYPES = {"f": "float", "i": "long", "b": "unsigned char"}
"""C types by kind of number, see `KINDS`. `long` has at least 32 bits everywhere."""
BLOCK = 8
"""Number of terms of a scalar product that are summed before their sum is added to the
total, for less round-off."""
_BEYOND = {"inf": "INFINITY", "-inf": "(-INFINITY)", "nan": "NAN"}


def prefix_of(stem: str) -> str:
    """File name without ending, turned into a valid prefix of C identifiers."""
    name = re.sub(r"[^0-9A-Za-z_]", "_", stem)
    return name if re.match(r"[A-Za-z]", name) else f"policy_{name.lstrip('_')}"


def header(
    prefix: str, act: Program, start: Program | None, comment: Sequence[str]
) -> str:
    """The text of a header with a policy.

    Args:
        prefix: Prefix of all names in the header.
        act: Program from the arrays of the memory and the observation to the action and
            the next memory.
        start: Program from the first observation to the initial memory; `None` for a
            policy without memory.
        comment: Lines of the comment at the top.
    """
    guard = f"{prefix.upper()}_H"
    observation, action = act.inputs[-1].size, act.results[0].places.size
    lines = ["/*", *(f" * {_harmless(line)}".rstrip() for line in comment), " */"]
    lines += [f"#ifndef {guard}", f"#define {guard}", "", "#include <math.h>", ""]
    lines += [f"#define {prefix.upper()}_OBSERVATION_SIZE {observation}"]
    lines += [f"#define {prefix.upper()}_ACTION_SIZE {action}", ""]
    parameters = [f"const float observation[{observation}]"]
    memory: dict[Buffer, str] = {}
    if start is not None:
        memory, fields = _fields(act.inputs[:-1])
        lines += ["typedef struct {", *fields, f"}} {prefix}_memory;", ""]
        parameters.insert(0, f"{prefix}_memory *memory")
        names = list(memory.values())
        lines += [f"static inline void {prefix}_start({', '.join(parameters)})", "{"]
        lines += _Body(start, {start.inputs[-1]: "observation"}).text(names)
        lines += ["}", ""]
    parameters.append(f"float action[{action}]")
    lines += [f"static inline void {prefix}_act({', '.join(parameters)})", "{"]
    places = memory | {act.inputs[-1]: "observation"}
    lines += _Body(act, places).text(["action", *memory.values()])
    return "\n".join([*lines, "}", "", f"#endif /* {guard} */", ""])


def _harmless(line: str) -> str:
    """A line of text that is safe in a C comment: it neither ends nor opens one."""
    line = "".join(sign if sign.isprintable() else " " for sign in line)
    return line.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /")


def _fields(arrays: Sequence[Buffer]) -> tuple[dict[Buffer, str], list[str]]:
    """C expressions of a policy memory's arrays, by buffer, and its struct fields."""
    named = {buffer: f"memory->m{i}" for i, buffer in enumerate(arrays) if buffer.size}
    fields = [
        f"  {TYPES[buffer.kind]} {name.partition('->')[2]}[{buffer.size}];"
        for buffer, name in named.items()
    ]
    return named, fields


class _Body:
    """Writer of the statements of one C function."""

    def __init__(self, program: Program, inputs: dict[Buffer, str]) -> None:
        self.program = program
        self.where = {buffer: (name, 0) for buffer, name in inputs.items()}
        self.tables: list[str] = []
        self.lines: list[str] = []
        self.counted: dict[Any, str] = {}
        scratch, self.sizes = _allocated(program)
        for buffer, at in scratch.items():
            self.where[buffer] = (f"scratch_{buffer.kind}", at)

    def text(self, outputs: Iterable[str]) -> list[str]:
        """All lines of the function's body, given the C names of the result arrays."""
        for step in self.program.steps:
            step.write(self)
        kept = [value for value in self.program.results if value.places.size]
        for name, value in zip(outputs, kept, strict=True):
            self._copy(value, f"{name}[k]")
        first = [
            f"  static {TYPES[k]} scratch_{k}[{n}];" for k, n in self.sizes.items()
        ]
        index = ["  int k;"] if any("k++" in line for line in self.lines) else []
        if any("j++" in line for line in self.lines):
            index = ["  int i, j, k;"]
        read = {value.buffer for value in self.program.operands()}
        unread = [b for b in self.program.inputs if b.size and b not in read]
        silent = [f"  (void){self.where[b][0].partition('->')[0]};" for b in unread]
        return [*self.tables, *first, *index, *silent, *self.lines]

    def each(self, step: Each) -> None:
        """Adds a loop that computes an elementwise operation."""
        name, at = self.where[step.out]
        taken = "; ".join(
            f"const {TYPES[value.buffer.kind]} {letter} = {self._read(value)}"
            for letter, value in zip("abc", step.operands, strict=False)
        )
        expression = OPERATIONS[step.operation].c
        self._loop(step.out.size, f"{{ {taken}; {name}[{at} + k] = {expression}; }}")

    def product(self, step: Product) -> None:
        """Adds a matrix product, row by row, with the columns in the inner loop.

        The terms are added in blocks of `BLOCK`, so round-off grows with the number of
        blocks.
        """
        batch, m, k, n = step.sizes
        left, right = step.operands
        name, at = self.where[step.out]
        block = " + ".join(
            f"(x[{i}] * w[{i * n} + j] + x[{i + 1}] * w[{(i + 1) * n} + j])"
            for i in range(0, BLOCK, 2)
        )
        for row in range(batch * m):
            out = f"{name}[{at + row * n} + j]"
            a = self._pointer(left, row * k)
            b = self._pointer(right, row // m * k * n)
            self.lines += [
                f"  {{ const float *x = {a}, *w = {b};",
                f"    for (j = 0; j < {n}; j++) {out} = 0.0f;",
            ]
            loops = (k // BLOCK, BLOCK, block), (k % BLOCK, 1, "x[0] * w[j]")
            for rounds, taken, terms in loops:
                if rounds:
                    ahead = f"x += {taken}, w += {taken * n}"
                    self.lines += [
                        f"    for (i = 0; i < {rounds}; i++, {ahead})",
                        f"      for (j = 0; j < {n}; j++) {out} += {terms};",
                    ]
            self.lines.append("  }")

    def join(self, step: Join) -> None:
        """Adds a loop that copies each operand of a concatenation."""
        name, at = self.where[step.out]
        for value in step.operands:
            self._copy(value, f"{name}[{at} + k]")
            at += value.places.size

    def _copy(self, value: Value, target: str) -> None:
        self._loop(value.places.size, f"{target} = {self._read(value)};")

    def _loop(self, count: int, statement: str) -> None:
        self.lines.append(f"  for (k = 0; k < {count}; k++) {statement}")

    def _read(self, value: Value) -> str:
        """C expression of entry k of a value in flat order; k is the loop variable."""
        if value.uniform:
            return _literal(value.numbers.ravel()[0], value.buffer.kind)
        if value.known:
            return f"{self._constant(value.numbers, value.buffer.kind)}[k]"
        name, at = self.where[value.buffer]
        if value.stride is None:
            places = at + value.places.ravel()
            table = self._table("unsigned long", places, lambda place: f"{place}")
            return f"{name}[{table}[k]]"
        first, apart = value.stride
        index = "k" if apart == 1 else f"{apart} * k"
        return (
            f"{name}[{at + first}]" if apart == 0 else f"{name}[{at + first} + {index}]"
        )

    def _pointer(self, value: Value, first: int) -> str:
        """C address of entry `first` of a value that fills its buffer."""
        if value.known:
            return f"{self._constant(value.numbers, value.buffer.kind)} + {first}"
        name, at = self.where[value.buffer]
        return f"{name} + {at + first}"

    def _constant(self, numbers: np.ndarray, kind: str) -> str:
        return self._table(TYPES[kind], numbers.ravel(), lambda x: _literal(x, kind))

    def _table(self, kind: str, numbers: np.ndarray, shown: Any) -> str:
        """Name of a static array of constants; equal arrays are written once.

        `kind` is the C type, and `shown` a function that returns the C text of a
        number.
        """
        key = kind, numbers.tobytes()
        if key not in self.counted:
            name = self.counted[key] = f"c{len(self.counted)}"
            words = [shown(number) for number in numbers]
            rows = [", ".join(words[i : i + 6]) for i in range(0, len(words), 6)]
            self.tables.append(f"  static const {kind} {name}[{len(words)}] = {{")
            self.tables += [f"    {row}," for row in rows[:-1]]
            self.tables.append(f"    {rows[-1]} }};")
        return self.counted[key]


def _literal(number: Any, kind: str) -> str:
    """C literal of a constant, exact to the last bit."""
    if kind != "f":
        return f"{int(number)}"
    text = f"{float(number):.9g}"
    if text in _BEYOND:
        return _BEYOND[text]
    return f"{text}f" if re.search(r"[.e]", text) else f"{text}.0f"


def _allocated(program: Program) -> tuple[dict[Buffer, int], dict[str, int]]:
    """Offset of each result in scratch memory, and the size of that memory, by kind.

    The kinds of numbers are those of `KINDS`. Results that no later step reads are
    overwritten.
    """
    last: dict[Buffer, int] = {}
    for i, step in enumerate(program.steps):
        last |= {operand.buffer: i for operand in step.operands}
    last |= {value.buffer: len(program.steps) for value in program.results}
    places: dict[Buffer, int] = {}
    sizes: dict[str, int] = {}
    for i, step in enumerate(program.steps):
        kind, at = step.out.kind, 0
        living = [b for b in places if b.kind == kind and last[b] >= i]
        for begin, size in sorted((places[b], b.size) for b in living):
            if at + step.out.size <= begin:
                break
            at = max(at, begin + size)
        places[step.out] = at
        sizes[kind] = max(sizes.get(kind, 0), at + step.out.size)
    return places, sizes
