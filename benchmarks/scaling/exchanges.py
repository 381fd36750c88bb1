"""Bytes that devices of a compiled program send each other, read from its text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.-]+) .*\{$")
_INSTRUCTION = re.compile(
    r"^\s+(?:ROOT )?%[\w.-]+ = (?P<type>.+?) (?P<operation>[a-z-]+)\("
)
_SHAPE = re.compile(r"\b([a-z]+\d*)\[([\d,]*)\]")
_CALLED = re.compile(r"(?:body|condition|to_apply|calls)=%?([\w.-]+)")
_BRANCHES = re.compile(r"branch_computations=\{([^}]*)\}")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
_EXCHANGES = (
    "all-reduce",
    "all-gather",
    "reduce-scatter",
    "all-to-all",
    "collective-permute",
    "collective-broadcast",
)
_BITS = {"pred": 8, "bf16": 16}


@dataclass(frozen=True)
class Exchange:
    """One instruction of a program by which devices exchange arrays.

    Attributes:
        operation: its name in XLA, "all-reduce" say.
        size: of what a device has afterwards [bytes].
        times: how often one pass of the loops of unknown length does it.
        open_loops: loops around it whose length the program's text does not tell.
    """

    operation: str
    size: int
    times: int
    open_loops: int

    @property
    def bytes(self) -> int:
        """Bytes of one pass of the loops of unknown length."""
        return self.size * self.times


def exchanges(program: str) -> list[Exchange]:
    """All exchanges of a program, in the order of its text.

    Args:
        program: the text of a compiled program, `jax.stages.Compiled.as_text`.

    Raises:
        ValueError: the text holds an exchange that is not reached from its entry.
    """
    computations: dict[str, list[str]] = {}
    entry, lines = "", []
    for line in program.splitlines():
        if found := _COMPUTATION.match(line):
            lines = computations.setdefault(found[2], [])
            entry = found[2] if found[1] else entry
        else:
            lines.append(line)

    seen: set[str] = set()

    def walk(name: str, times: int, open_loops: int) -> Iterator[Exchange]:
        seen.add(name)
        for line in computations[name]:
            instruction = _INSTRUCTION.match(line)
            if not instruction:
                continue
            operation = instruction["operation"].removesuffix("-start")
            if operation in _EXCHANGES:
                size = _bytes(instruction["type"])
                yield Exchange(operation, size, times, open_loops)
                continue
            trips = _TRIPS.search(line)
            inside = times * int(trips[1]) if trips else times
            deeper = open_loops + (operation == "while" and not trips)
            called = _CALLED.findall(line)
            for branches in _BRANCHES.findall(line):
                called += re.findall(r"[\w.-]+", branches)
            for other in called:
                yield from walk(other, inside, deeper)

    found = list(walk(entry, 1, 0))
    for name, lines in computations.items():
        left = [i for i in map(_INSTRUCTION.match, lines) if i and name not in seen]
        if any(i["operation"].removesuffix("-start") in _EXCHANGES for i in left):
            raise ValueError(f"nothing calls {name}, which exchanges arrays")
    return found


def _bytes(type_: str) -> int:
    return sum(
        _bits(name) // 8 * math.prod(int(n) for n in sizes.split(",") if n)
        for name, sizes in _SHAPE.findall(type_)
    )


def _bits(name: str) -> int:
    return _BITS.get(name) or int(re.sub(r"\D", "", name))
