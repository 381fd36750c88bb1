"""Streams: loops along rows that run together, each a few entries behind another.

A loop that reads a row of an earlier loop at index i + 1 need not wait for the whole
row: it may be one entry behind. So rows are read soon after they are written, while
they are in the fastest cache.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxrod.lanes.rows.row_graph import RowGraph
from jaxrod.lanes.rows.schedule import Loop, Schedule

Lines = list[str]
FARTHEST = 4
"""Largest distance between the index of an entry and that of one which is read for it.
A loop that reads farther begins a new stream."""


@dataclass(frozen=True)
class Read:
    """A stored node that a loop reads."""

    node: int
    shift: int | None
    """Entry i + shift is read at index i; `None` if entries are read in any order."""


@dataclass(frozen=True)
class Write:
    """Entries of a stored node that a stream writes."""

    delay: int
    """Round of the stream in which the first of them is written."""
    base: int | None
    """Index of that entry; each round writes the next one. `None` if the entries do not
    lie beside each other."""
    place: int
    """Place among the members of the one that writes them."""


@dataclass
class Member:
    """Loops in a stream that have the same rounds."""

    mark: str
    """Beginning of its labels. Its index is `%i_` and the mark."""
    delay: int
    """Round of the stream in which the loops begin."""
    rounds: int
    body: Lines = field(default_factory=list)


class Stream:
    """Loops that run together."""

    def __init__(self) -> None:
        """Begins a stream without loops."""
        self.members: list[Member] = []
        self._written: dict[int, list[Write]] = {}

    def admits(self, loop: Loop, reads: list[Read]) -> bool:
        """Whether a loop can run in this stream or, without rows, before it.

        `reads` are the nodes that the loop reads.
        """
        found = [(r, w) for r in reads for w in self._written.get(r.node, ())]
        return all(
            loop.dims
            and read.shift is not None
            and write.base is not None
            and abs(read.shift - write.base) <= FARTHEST
            for read, write in found
        )

    def add(
        self, schedule: Schedule, loop: Loop, reads: list[Read], mark: str
    ) -> Member:
        """Adds a loop, which begins as early as its reads allow.

        Args:
            schedule: Schedule of the loop.
            loop: The loop.
            reads: Nodes that the loop reads.
            mark: Beginning of its labels.
        """
        delay, place, rounds = 0, 0, loop.dims[0]
        for read in reads:
            for write in self._written.get(read.node, ()):
                assert read.shift is not None and write.base is not None
                delay = max(delay, write.delay + read.shift - write.base)
                place = max(place, write.place)
        while place < len(self.members):
            member = self.members[place]
            if (member.delay, member.rounds) == (delay, rounds):
                break
            place += 1
        else:
            member = Member(mark, delay, rounds)
            self.members.append(member)
        for node in loop.nodes:
            if schedule.is_kept(node):
                self._written.setdefault(node, []).append(Write(delay, 0, place))
        for goal in loop.goals:
            word, _, number = goal.place.pointer.partition(" ")
            if word == "node":
                beside = goal.piece.strides == (1,)
                write = Write(delay, goal.piece.base if beside else None, place)
                self._written.setdefault(int(number), []).append(write)
        return member

    def lines(self) -> Lines:
        """Returns LLVM IR of one loop that runs all members."""
        if not self.members:
            return []
        mark = f"s_{self.members[0].mark}"
        rounds = max(member.delay + member.rounds for member in self.members)
        lines = [
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br label %{mark}",
            f"{mark}:",
            f"%t_{mark} = phi i64 [0, %{mark}_pre], [%u_{mark}, %{mark}_end]",
        ]
        for member in self.members:
            own = member.mark
            lines.append(f"%i_{own} = sub nsw i64 %t_{mark}, {member.delay}")
            if member.rounds == rounds:
                lines += member.body
                continue
            lines += [
                f"%h_{own} = icmp ult i64 %i_{own}, {member.rounds}",
                f"br i1 %h_{own}, label %{own}_go, label %{own}_gone",
                f"{own}_go:",
                *member.body,
                f"br label %{own}_gone",
                f"{own}_gone:",
            ]
        return [
            *lines,
            f"br label %{mark}_end",
            f"{mark}_end:",
            f"%u_{mark} = add nuw nsw i64 %t_{mark}, 1",
            f"%m_{mark} = icmp slt i64 %u_{mark}, {rounds}",
            f"br i1 %m_{mark}, label %{mark}, label %{mark}_done",
            f"{mark}_done:",
        ]


def flows(loop: Loop) -> bool:
    """Whether a loop can run with others: it goes along one row, without sums."""
    alone = loop.reductions or loop.scatters or loop.recurrence is not None
    return len(loop.dims) == 1 and not alone


def reads_of(graph: RowGraph, schedule: Schedule, loop: Loop) -> list[Read]:
    """Returns the stored nodes that a loop reads."""
    made: set[Read] = set()
    own = set(loop.nodes)

    def read(node: int) -> None:
        """Records the read of an argument of an operation."""
        if node in own and graph.operations[node] != "view":
            return
        if graph.operations[node] == "view":
            base, strides = graph.extras[node]
            made.add(Read(graph.arguments[node][0], base if strides == (1,) else None))
        elif schedule.place(node) is not None:
            made.add(Read(node, 0 if len(graph.dims[node]) == 1 else None))

    for fill in schedule.fills.get(loop.level, ()) if not loop.dims else ():
        read(graph.arguments[fill.node][-1])
    for node in loop.nodes:
        if graph.operations[node] == "gather":
            table, index = graph.arguments[node]
            made.add(Read(table, None))
            read(index)
        elif graph.operations[node] == "view":
            read(node)
        else:
            for argument in graph.arguments[node]:
                read(argument)
    for goal in loop.goals:
        read(goal.node)
    if loop.mask is not None:
        read(loop.mask)
    return list(made)
