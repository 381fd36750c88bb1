"""Sorting of a row by whole numbers, as a function of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxrod.lanes.jaxpr.unroll import NotUnrolled
from jaxrod.lanes.rows.arrays import Rows
from jaxrod.lanes.rows.row_unroller import RowUnroller, row_rule

_COUNTS = 256
"""Number of values of a digit."""
_FUNCTION = """\
define internal void @ordered(ptr noalias %keys, ptr noalias %order, ptr noalias %room,
    i64 %n) noinline nounwind {
entry:
%size = mul i64 %n, 4
%keys0 = getelementptr i8, ptr %room, i64 1024
%keys1 = getelementptr i8, ptr %keys0, i64 %size
%order1 = getelementptr i8, ptr %keys1, i64 %size
br label %copy
copy:
%c = phi i64 [0, %entry], [%c1, %copy]
%ca = getelementptr i32, ptr %keys, i64 %c
%cb = getelementptr i32, ptr %keys0, i64 %c
%cc = getelementptr i32, ptr %order, i64 %c
%key = load i32, ptr %ca, align 4
%unsigned = xor i32 %key, -2147483648
%place = trunc i64 %c to i32
store i32 %unsigned, ptr %cb, align 4
store i32 %place, ptr %cc, align 4
%c1 = add i64 %c, 1
%cm = icmp slt i64 %c1, %n
br i1 %cm, label %copy, label %digits
digits:
%shift = phi i32 [0, %copy], [%shift1, %digit_done]
%ka = phi ptr [%keys0, %copy], [%kb, %digit_done]
%kb = phi ptr [%keys1, %copy], [%ka, %digit_done]
%oa = phi ptr [%order, %copy], [%ob, %digit_done]
%ob = phi ptr [%order1, %copy], [%oa, %digit_done]
call void @llvm.memset.p0.i64(ptr %room, i8 0, i64 1024, i1 false)
br label %count
count:
%i = phi i64 [0, %digits], [%i1, %count]
%ia = getelementptr i32, ptr %ka, i64 %i
%ik = load i32, ptr %ia, align 4
%is = lshr i32 %ik, %shift
%id = and i32 %is, 255
%ic = getelementptr i32, ptr %room, i32 %id
%in = load i32, ptr %ic, align 4
%in1 = add i32 %in, 1
store i32 %in1, ptr %ic, align 4
%i1 = add i64 %i, 1
%im = icmp slt i64 %i1, %n
br i1 %im, label %count, label %sum
sum:
%s = phi i64 [0, %count], [%s1, %sum]
%before = phi i32 [0, %count], [%after, %sum]
%sa = getelementptr i32, ptr %room, i64 %s
%sn = load i32, ptr %sa, align 4
store i32 %before, ptr %sa, align 4
%after = add i32 %before, %sn
%s1 = add i64 %s, 1
%sm = icmp slt i64 %s1, 256
br i1 %sm, label %sum, label %move
move:
%j = phi i64 [0, %sum], [%j1, %move]
%ja = getelementptr i32, ptr %ka, i64 %j
%jo = getelementptr i32, ptr %oa, i64 %j
%jk = load i32, ptr %ja, align 4
%jp = load i32, ptr %jo, align 4
%js = lshr i32 %jk, %shift
%jd = and i32 %js, 255
%jc = getelementptr i32, ptr %room, i32 %jd
%jn = load i32, ptr %jc, align 4
%jn1 = add i32 %jn, 1
store i32 %jn1, ptr %jc, align 4
%jka = getelementptr i32, ptr %kb, i32 %jn
%joa = getelementptr i32, ptr %ob, i32 %jn
store i32 %jk, ptr %jka, align 4
store i32 %jp, ptr %joa, align 4
%j1 = add i64 %j, 1
%jm = icmp slt i64 %j1, %n
br i1 %jm, label %move, label %digit_done
digit_done:
%shift1 = add i32 %shift, 8
%more = icmp slt i32 %shift1, 32
br i1 %more, label %digits, label %done
done:
ret void
}
"""
"""LLVM function that writes the order of `n` keys, which are sorted by four digits of
eight bits each (radix sort). Equal keys keep their order."""


class Order:
    """The order of a row of keys, as an operation of its own in a schedule."""

    def __init__(self, n: int, base: int) -> None:
        """Describes a row of `n` keys.

        They begin at the flat index `base` of their stored node.
        """
        self.n, self.base = n, base
        self.result = -1
        """Node of the order."""

    def write(self, writer: Any, mark: str, arguments: Sequence[int]) -> None:
        """Appends a call of the function that sorts; `arguments` has the keys."""
        del mark
        schedule = writer.schedule
        keys, order = schedule.place(arguments[0]), schedule.place(self.result)
        room = schedule.room(4 * _COUNTS + 12 * self.n)
        pointers = [
            writer.new(f"getelementptr i8, ptr {place.pointer}, i64 {offset}")
            for place, offset in (
                (keys, keys.offset + 4 * self.base),
                (order, order.offset),
                (room, room.offset),
            )
        ]
        writer.declared.add(_FUNCTION)
        given = ", ".join(f"ptr {pointer}" for pointer in pointers)
        writer.lines.append(f"call void @ordered({given}, i64 {self.n})")


@row_rule("sort")
def ordered(unroller: RowUnroller, equation: Any, *arrays: Rows) -> list[Rows]:
    """Translates `sort` of rows by one key of whole numbers; equal keys keep order.

    Raises:
        NotUnrolled: The keys are others, or the kernel has no functions of its own.
    """
    keys, graph, layout = arrays[0], unroller.graph, unroller.layout
    fits = len(keys.shape) == 1 and keys.shape[0] > 0 and keys.kind == "i32"
    if unroller.nest is None or not fits or equation.params["num_keys"] != 1:
        raise NotUnrolled("lanes have no 'sort'")
    (n,) = keys.shape
    node, base = layout.stored(keys)
    how = Order(n, base)
    done = graph.place("nested", (node,), "i32", (), how)
    how.result = graph.place("result", (done,), "i32", (n,), 0)
    results = []
    for array in arrays:
        table, start = layout.stored(array)
        read = graph.gathered(table, start, how.result)
        results.append(Rows((n,), (0,), np.array([read]), array.kind))
    return results
