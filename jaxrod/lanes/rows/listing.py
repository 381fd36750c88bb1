"""Indices of the true entries of a mask, as a function of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxrod.lanes.jaxpr.unroll import Unroller, rule
from jaxrod.lanes.rows.arrays import Rows
from jaxrod.lanes.rows.row_unroller import RowUnroller, row_rule

_NAME = "jaxrod_true_entries"
_FUNCTION = """\
define internal void @listed(ptr noalias %mask, ptr noalias %list, i64 %n, i64 %size)
    noinline nounwind {
entry:
%whole = and i64 %n, -64
br label %chunks
chunks:
%c = phi i64 [0, %entry], [%c1, %chunk_end]
%k = phi i64 [0, %entry], [%k2, %chunk_end]
%inside = icmp slt i64 %c, %whole
br i1 %inside, label %chunk, label %rest
chunk:
%ca = getelementptr i8, ptr %mask, i64 %c
%bytes = load <64 x i8>, ptr %ca, align 1
%true = icmp ne <64 x i8> %bytes, zeroinitializer
%word = bitcast <64 x i1> %true to i64
%any = icmp ne i64 %word, 0
%room = icmp slt i64 %k, %size
%go = and i1 %any, %room
br i1 %go, label %bit, label %chunk_end
bit:
%bits = phi i64 [%word, %chunk], [%less, %bit]
%kb = phi i64 [%k, %chunk], [%k1, %bit]
%z = call i64 @llvm.cttz.i64(i64 %bits, i1 true)
%j = add i64 %c, %z
%jt = trunc i64 %j to i32
%ka = getelementptr i32, ptr %list, i64 %kb
store i32 %jt, ptr %ka, align 4
%k1 = add i64 %kb, 1
%minus = sub i64 %bits, 1
%less = and i64 %bits, %minus
%left = icmp ne i64 %less, 0
%fits = icmp slt i64 %k1, %size
%more = and i1 %left, %fits
br i1 %more, label %bit, label %chunk_end
chunk_end:
%k2 = phi i64 [%k, %chunk], [%k1, %bit]
%c1 = add i64 %c, 64
br label %chunks
rest:
%r = phi i64 [%c, %chunks], [%r1, %rest_end]
%kr = phi i64 [%k, %chunks], [%kr2, %rest_end]
%behind = icmp slt i64 %r, %n
%open = icmp slt i64 %kr, %size
%again = and i1 %behind, %open
br i1 %again, label %one, label %done
one:
%ra = getelementptr i8, ptr %mask, i64 %r
%byte = load i8, ptr %ra, align 1
%set = icmp ne i8 %byte, 0
br i1 %set, label %write, label %rest_end
write:
%rt = trunc i64 %r to i32
%kra = getelementptr i32, ptr %list, i64 %kr
store i32 %rt, ptr %kra, align 4
%kr1 = add i64 %kr, 1
br label %rest_end
rest_end:
%kr2 = phi i64 [%kr, %one], [%kr1, %write]
%r1 = add i64 %r, 1
br label %rest
done:
%end = getelementptr i32, ptr %list, i64 %kr
%unused = sub i64 %size, %kr
%zeros = mul i64 %unused, 4
call void @llvm.memset.p0.i64(ptr %end, i8 0, i64 %zeros, i1 false)
ret void
}
"""
"""LLVM function that lists the indices of the bytes of `n` that are not zero."""


class TrueEntries:
    """The list of the true entries of a mask, as an operation of its own."""

    def __init__(self, n: int, size: int, base: int) -> None:
        """Describes a mask of `n` entries and a list of `size` indices.

        The mask begins at the flat index `base` of its stored node.
        """
        self.n, self.size, self.base = n, size, base
        self.result = -1
        """Node of the list."""

    def write(self, writer: Any, mark: str, arguments: Sequence[int]) -> None:
        """Appends a call of the function that lists; `arguments` has the mask."""
        del mark
        schedule = writer.schedule
        mask, found = schedule.place(arguments[0]), schedule.place(self.result)
        pointers = [
            writer.new(f"getelementptr i8, ptr {place.pointer}, i64 {offset}")
            for place, offset in (
                (mask, mask.offset + self.base),
                (found, found.offset),
            )
        ]
        writer.declared |= {_FUNCTION, "declare i64 @llvm.cttz.i64(i64, i1)"}
        given = ", ".join(f"ptr {pointer}" for pointer in pointers)
        writer.lines.append(
            f"call void @listed({given}, i64 {self.n}, i64 {self.size})"
        )


@rule(_NAME)
def written_out(unroller: Unroller, equation: Any, mask: Any) -> Any:
    """Translates the list of true entries as the operations that XLA runs."""
    aval = equation.invars[0].aval
    program = equation.params["listing"].program
    given = jax.ShapeDtypeStruct(aval.shape, aval.dtype)
    return unroller.run(jax.make_jaxpr(program)(given), [mask])


@row_rule(_NAME)
def listed(unroller: RowUnroller, equation: Any, mask: Rows) -> Any:
    """Translates the list of true entries as a call of one function."""
    size = equation.params["listing"].size
    if unroller.nest is None or 0 in mask.shape:
        return written_out(unroller, equation, mask)
    graph, layout = unroller.graph, unroller.layout
    (n,) = mask.shape
    node, base = layout.stored(mask)
    how = TrueEntries(n, size, base)
    done = graph.place("nested", (node,), "i32", (), how)
    how.result = graph.place("result", (done,), "i32", (size,), 0)
    return [Rows((size,), (0,), np.array([how.result]), "i32")]
