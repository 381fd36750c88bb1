"""LLVM IR of the loops of a schedule for a warp: 32 threads that share one scene.

Each thread computes every 32nd number of a row. Single numbers are computed by all
threads alike. Between the levels of a schedule all threads wait for each other, so that
stores of one level can be read in the next. If a number in memory is updated, only the
first thread does it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from jaxrod.lanes.llvm.vector_code import BYTES, TYPES
from jaxrod.lanes.rows.loop_code import RowWriter
from jaxrod.lanes.rows.schedule import Loop

Lines = list[str]
THREADS = 32
"""Threads of a warp."""
READ_ONLY = ("%in", "%row")
"""Prefixes of the names of pointers to operands, which no thread writes."""
WAIT = "call void @wait()"
"""LLVM line at which all threads of the warp wait for each other and for their
stores."""


class WarpWriter(RowWriter):
    """Writer of an LLVM function in which a warp runs the loops of a schedule.

    The first argument of the function is the index of the thread.
    """

    attributes = "alwaysinline nounwind"
    given = "i64 %thread, "
    level = 0
    """Level of the last loop that was written; a barrier precedes the first loop of
    another."""

    def function(self, name: str, pointers: Sequence[str], lines: Lines) -> str:
        """Returns an LLVM function whose first argument is the index of the thread.

        Pointers to memory that threads write are not `noalias`: each thread reads what
        others wrote before a barrier, and LLVM would move such loads across the
        barrier.
        """
        given = ", ".join(f"ptr {_claims(p)}nocapture {p}" for p in pointers)
        head = (
            f"define internal void @{name}(i64 %thread, {given}) {self.attributes} {{"
        )
        begin = ["entry:", "%alone = icmp eq i64 %thread, 0"]
        return "\n".join([head, *begin, *lines, WAIT, "ret void", "}", ""])

    def synchronise(self) -> None:
        """Appends a barrier, after which all threads can read all earlier stores."""
        self.lines.append(WAIT)

    def one_by_one(self, name: str, write: Callable[[], None]) -> None:
        """Appends code that updates memory, which only the first thread runs.

        The function `write` appends the code; its labels begin with `name`.
        """
        self.lines += [
            f"br i1 %alone, label %{name}_alone, label %{name}_all",
            f"{name}_alone:",
        ]
        write()
        self.lines += [f"br label %{name}_all", f"{name}_all:"]

    def _loop(self, number: int, loop: Loop) -> Lines:
        waits = [WAIT] if loop.level != self.level else []
        self.level = loop.level
        return [*waits, *super()._loop(number, loop)]

    def _width_of(self, loop: Loop) -> int:
        return 1

    def innermost(
        self, mark: str, latch: str, length: int, phis: Lines, body: Lines
    ) -> Lines:
        """Returns the lines of a loop over every 32nd number of a row.

        It begins at the index of the thread. The arguments are those of
        `RowWriter.innermost`.
        """
        body_label = f"{mark}_body"
        return [
            f"br label %{mark}_pre",
            f"{mark}_pre:",
            f"br label %{mark}",
            f"{mark}:",
            f"%i_{mark} = phi i64 [%thread, %{mark}_pre], [%d_{mark}, %{mark}_next]",
            *phis,
            f"%m_{mark} = icmp slt i64 %i_{mark}, {length}",
            f"br i1 %m_{mark}, label %{body_label}, label %{mark}_done",
            f"{body_label}:",
            *body,
            f"br label %{mark}_next",
            f"{mark}_next:",
            f"%d_{mark} = add nuw nsw i64 %i_{mark}, {THREADS}",
            f"br label %{mark}",
            f"{mark}_done:",
        ]

    def latch(self, mark: str) -> str:
        """Returns the label of the last block in the body of a loop with reductions.

        `mark` is the label of the loop.
        """
        return f"{mark}_next"

    def after_loop(self, before: str, after: str) -> str:
        """Returns the name of one thread's total of a reduction, after its loop.

        `before` and `after` are the names at the beginning and at the end of a round.
        The loop is left at the beginning of a round, so the result is `before`.
        """
        del after
        return before

    def across(self, operation: str, value: str, kind: str, rounds: int) -> str:
        """Appends the reduction of all threads' totals; returns the result's name.

        Every thread has the same result. If the smallest or largest number is zero, its
        sign may differ between threads.
        """
        if rounds == 1:
            return value
        step = THREADS // 2
        one = TYPES[kind]
        while step:
            other = self._of_other_thread(value, kind, one, step)
            value = self._combined(operation, value, other, kind)
            step //= 2
        return value

    def _of_other_thread(self, value: str, kind: str, one: str, step: int) -> str:
        """Appends the exchange of a number with the thread of index `thread xor step`.

        `one` is the LLVM type of the number `value`; `step` is a power of two.

        Returns:
            The name of that thread's number.
        """
        bits = 1 if kind == "b1" else 8 * BYTES[kind]
        whole = f"i{bits}"
        sent = value
        if kind[0] == "f":
            sent = self.new(f"bitcast {one} {value} to {whole}")
        if bits == 64:
            low = self.new(f"trunc i64 {sent} to i32")
            high = self.new(f"lshr i64 {sent}, 32")
            high = self.new(f"trunc i64 {high} to i32")
            low, high = self._exchanged(low, step), self._exchanged(high, step)
            low = self.new(f"zext i32 {low} to i64")
            high = self.new(f"zext i32 {high} to i64")
            high = self.new(f"shl i64 {high}, 32")
            found = self.new(f"or i64 {low}, {high}")
        elif bits == 32:
            found = self._exchanged(sent, step)
        else:
            wide = self.new(f"zext {whole} {sent} to i32")
            wide = self._exchanged(wide, step)
            found = self.new(f"trunc i32 {wide} to {whole}")
        if kind[0] == "f":
            found = self.new(f"bitcast {whole} {found} to {one}")
        return found

    def _exchanged(self, number: str, step: int) -> str:
        return self.new(f"call i32 @exchange(i64 %thread, i32 {number}, i32 {step})")

    def copy(self, to: str, source: str, count: int, kind: str) -> None:
        """Appends a copy of numbers from memory to memory, shared among the threads.

        The arguments are those of `RowWriter.copy`.
        """
        size = BYTES[kind]
        self.lines.append(copy_call(to, source, count * size, size))


def _claims(pointer: str) -> str:
    """Returns the LLVM attributes of a pointer argument.

    Pointers to operands are `noalias readonly`; others have neither attribute.
    """
    return "noalias readonly " if pointer.startswith(READ_ONLY) else ""


def copy_call(to: str, source: str, size: int, alignment: int) -> str:
    """Returns LLVM IR that copies memory, four bytes at a time if possible.

    Args:
        to: Name of the pointer to which numbers are copied.
        source: Name of the pointer from which they are copied.
        size: Total size of the numbers [bytes].
        alignment: Alignment of both pointers [bytes].
    """
    word = 4 if size % 4 == 0 and alignment % 4 == 0 else 1
    return (
        f"call void @copy_{8 * word}(i64 %thread, ptr {to}, ptr {source}, "
        f"i64 {size // word})"
    )


def _thread_loop(length: str, body: Lines) -> str:
    """Returns the body of a function that loops over every 32nd index below `length`.

    The lines `body` use the index `%i`.
    """
    return "\n".join(
        [
            "entry:",
            "br label %loop",
            "loop:",
            "%i = phi i64 [%thread, %entry], [%next, %body]",
            f"%more = icmp slt i64 %i, {length}",
            "br i1 %more, label %body, label %done",
            "body:",
            *body,
            f"%next = add i64 %i, {THREADS}",
            "br label %loop",
            "done:",
            "ret void",
        ]
    )


def copy_text(bits: int) -> str:
    """Returns LLVM IR of a function that copies memory by words of `bits` bits.

    The threads of a warp share the words.
    """
    body = _thread_loop(
        "%count",
        [
            f"%from = getelementptr i{bits}, ptr %source, i64 %i",
            f"%at = getelementptr i{bits}, ptr %to, i64 %i",
            f"%word = load i{bits}, ptr %from",
            f"store i{bits} %word, ptr %at",
        ],
    )
    given = "i64 %thread, ptr %to, ptr %source, i64 %count"
    return f"define internal void @copy_{bits}({given}) alwaysinline {{\n{body}\n}}\n"


def warp_fill_text(one: str) -> str:
    """Returns LLVM IR of a function that writes one number to runs of entries.

    Run j begins at entry j times `%stride` and has `%count` entries. The threads of a
    warp share the entries.
    """
    body = _thread_loop(
        "%all",
        [
            "%run = udiv i64 %i, %count",
            "%rest = urem i64 %i, %count",
            "%begin = mul i64 %run, %stride",
            "%place = add i64 %begin, %rest",
            f"%at = getelementptr {one}, ptr %start, i64 %place",
            f"store {one} %number, ptr %at",
        ],
    ).replace(
        "entry:\n",
        "entry:\n%start = getelementptr i8, ptr %to, i64 %offset\n"
        "%all = mul i64 %count, %runs\n",
    )
    given = (
        f"i64 %thread, ptr %to, i64 %offset, {one} %number, i64 %count, i64 %runs, "
        "i64 %stride"
    )
    return f"define internal void @fill_{one}({given}) alwaysinline {{\n{body}\n}}\n"
