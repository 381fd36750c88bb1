"""Loops of a schedule for a warp: 32 threads that share the memory of one scene.

Each thread computes every 32nd number of a row. All threads compute single numbers, and
come to the same. Stores of a level are visible in the next level, because all threads
wait for each other in between. Where a number is added to another in memory, the first
thread does it.
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
"""Beginnings of the names of pointers to operands."""
WAIT = "call void @wait()"
"""Line that waits for all threads of the warp, and for their stores."""


class WarpWriter(RowWriter):
    """Writer of a function that runs the loops of a schedule in the threads of a warp.

    The first argument of the function is the number of the thread.
    """

    attributes = "alwaysinline nounwind"
    given = "i64 %thread, "
    level = 0
    """Level of the last loop that was written."""

    def function(self, name: str, pointers: Sequence[str], lines: Lines) -> str:
        """Writes a function with these lines.

        Pointers to memory that threads write are not `noalias`: every thread has a
        copy, and waits for what others wrote. LLVM would move loads across the wait.
        """
        given = ", ".join(f"ptr {_claims(p)}nocapture {p}" for p in pointers)
        head = (
            f"define internal void @{name}(i64 %thread, {given}) {self.attributes} {{"
        )
        begin = ["entry:", "%alone = icmp eq i64 %thread, 0"]
        return "\n".join([head, *begin, *lines, WAIT, "ret void", "}", ""])

    def synchronise(self) -> None:
        """Appends a line that waits until all stores before it can be read."""
        self.lines.append(WAIT)

    def one_by_one(self, name: str, write: Callable[[], None]) -> None:
        """Writes code that only the first thread runs."""
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
        """Writes the loop over the numbers of a row that are this thread's."""
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
        """Returns the label of the last block of a loop that has reductions."""
        return f"{mark}_next"

    def after_loop(self, before: str, after: str) -> str:
        """Returns the name of a thread's total once its loop is done."""
        del after
        return before

    def across(self, operation: str, value: str, kind: str, rounds: int) -> str:
        """Combines the totals of all threads; every thread has the same result.

        Only the sign of a zero may differ, for the smallest or largest number.
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
        """Writes the exchange of a number with the thread `step` from this one."""
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
        """Writes a copy of numbers in memory."""
        size = BYTES[kind]
        self.lines.append(copy_call(to, source, count * size, size))


def _claims(pointer: str) -> str:
    """Returns what LLVM may rely on: operands are read, and never written."""
    return "noalias readonly " if pointer.startswith(READ_ONLY) else ""


def copy_call(to: str, source: str, size: int, alignment: int) -> str:
    """Writes a call that copies memory, four bytes at a time if that is possible.

    Args:
        to: Pointer to which numbers are copied.
        source: Pointer from which they are copied.
        size: Size of all of them [bytes].
        alignment: Alignment of both pointers [bytes].
    """
    word = 4 if size % 4 == 0 and alignment % 4 == 0 else 1
    return (
        f"call void @copy_{8 * word}(i64 %thread, ptr {to}, ptr {source}, "
        f"i64 {size // word})"
    )


def _thread_loop(length: str, body: Lines) -> str:
    """Writes the body of a function that is a loop over the numbers of a thread."""
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
    """Writes the function that copies memory, `bits` bits at a time."""
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
    """Writes a function that repeats a number in memory, in runs."""
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
