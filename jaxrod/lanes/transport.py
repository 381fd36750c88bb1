"""Transport: numbers between arrays with a row for each rod and blocks of vectors.

An array of the program has one row of numbers for every rod; a block has one vector for
every number, with a rod in each lane. Where rods are no multiple of the lanes, the last
rod fills what is left; it is written several times with the same numbers.
"""

from __future__ import annotations

from jaxrod.lanes.vector_code import BYTES, TYPES


def transport_text(kind: str, width: int) -> tuple[str, set[str]]:
    """Functions `@fetch_KIND` and `@bring_KIND` of one kind of numbers.

    Both go through the numbers of a row: entry k of rod r of the array is at
    `base + (r * stride + offset + k)`.
    """
    one = "i8" if kind == "b1" else TYPES[kind]
    many, size = f"<{width} x {one}>", BYTES[kind]
    suffix = f"v{width}{_suffix(one)}.v{width}p0"
    gather, scatter = f"@llvm.masked.gather.{suffix}", f"@llvm.masked.scatter.{suffix}"
    lanes, pointers = f"<{width} x i1>", f"<{width} x ptr>"
    declared = {
        f"declare {many} {gather}({pointers}, i32, {lanes}, {many})",
        f"declare void {scatter}({many}, {pointers}, i32, {lanes})",
        f"declare <{width} x i64> @llvm.smin.v{width}i64"
        f"(<{width} x i64>, <{width} x i64>)",
    }
    truths = "<" + ", ".join(["i1 true"] * width) + ">"
    numbers = "<" + ", ".join(f"i64 {lane}" for lane in range(width)) + ">"
    index = f"<{width} x i64>"
    align = min(64, size * width)

    def spread(name: str, source: str) -> str:
        return (
            f"%{name}0 = insertelement {index} poison, i64 {source}, i64 0\n"
            f"%{name} = shufflevector {index} %{name}0, {index} poison, "
            f"<{width} x i32> zeroinitializer\n"
        )

    def function(name: str, inner: str) -> str:
        return f"""
define internal void @{name}_{kind}(ptr %array, i64 %stride, i64 %offset, i64 %count,
    i64 %first, i64 %rods, ptr %block) noinline nounwind {{
entry:
%final = sub i64 %rods, 1
{spread("last", "%final")}{spread("firsts", "%first")}{spread("strides", "%stride")}
%lanes = add {index} %firsts, {numbers}
%rows = call {index} @llvm.smin.v{width}i64({index} %lanes, {index} %last)
%starts = mul {index} %rows, %strides
%any = icmp sgt i64 %count, 0
br i1 %any, label %loop, label %done
loop:
%k = phi i64 [0, %entry], [%next, %loop]
%at = add i64 %k, %offset
{spread("ats", "%at")}
%places = add {index} %starts, %ats
%pointers = getelementptr {one}, ptr %array, {index} %places
%to = mul i64 %k, {size * width}
%here = getelementptr i8, ptr %block, i64 %to
{inner}
%next = add i64 %k, 1
%more = icmp slt i64 %next, %count
br i1 %more, label %loop, label %done
done:
ret void
}}
"""

    fetch = (
        f"%found = call {many} {gather}({pointers} %pointers, i32 {size}, "
        f"{lanes} {truths}, {many} poison)\n"
        f"store {many} %found, ptr %here, align {align}"
    )
    bring = (
        f"%found = load {many}, ptr %here, align {align}\n"
        f"call void {scatter}({many} %found, {pointers} %pointers, i32 {size}, "
        f"{lanes} {truths})"
    )
    return function("fetch", fetch) + function("bring", bring), declared


def _suffix(one: str) -> str:
    return {"float": "f32", "double": "f64"}.get(one, one)
