"""LLVM IR that transposes between arrays of rods and blocks of vectors.

An array of the program has one row of numbers for every rod. A block has one vector for
every number, with a rod in each lane. Square tiles, with as many numbers as rods, are
transposed in registers; short rows are gathered and scattered number by number. If the
number of rods is not a multiple of the lanes, the last rod fills the remaining lanes;
it is then written several times with the same numbers.
"""

from __future__ import annotations

from jaxrod.lanes.llvm.vector_code import BYTES, TYPES


def is_tiled(kind: str, count: int, width: int) -> bool:
    """Whether rows of `count` numbers are transposed by square tiles in registers.

    A tile has `width` numbers, of type `kind`, of each of `width` rods.
    """
    return BYTES[kind] in (4, 8) and width > 1 and 2 * count >= width


def room_for(kind: str, count: int, width: int) -> int:
    """Returns the number of vectors in a block for rows of `count` numbers.

    There is one vector for each number of a row. A vector holds that number, of type
    `kind`, for each of `width` rods. For rows that are moved by tiles, the number of
    vectors is rounded up to a multiple of `width`.
    """
    return -(-count // width) * width if is_tiled(kind, count, width) else count


def transpose_text(kind: str, width: int) -> tuple[str, set[str]]:
    """Returns LLVM IR of `@fetch_KIND` and `@bring_KIND`, and its declarations.

    `fetch` copies an array to a block, `bring` a block to an array, for numbers of type
    KIND. Both loop over the numbers of a row: number k of rod r is at `r * stride +
    offset + k` in the array. `@fetch_squares_KIND` and `@bring_squares_KIND` do the
    same, a tile at a time.
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
    text = function("fetch", fetch) + function("bring", bring)
    if size in (4, 8) and width > 1:
        squares, more = _squares_text(kind, width)
        return text + squares, declared | more
    return text, declared


def _squares_text(kind: str, width: int) -> tuple[str, set[str]]:
    one = TYPES[kind]
    many, size = f"<{width} x {one}>", BYTES[kind]
    truth, whole = f"<{width} x i1>", f"<{width} x i64>"
    suffix = f"v{width}{_suffix(one)}.p0"
    load, store = f"@llvm.masked.load.{suffix}", f"@llvm.masked.store.{suffix}"
    declared = {
        f"declare {many} {load}(ptr, i32, {truth}, {many})",
        f"declare void {store}({many}, ptr, i32, {truth})",
        "declare i64 @llvm.smin.i64(i64, i64)",
    }
    numbers = "<" + ", ".join(f"i64 {lane}" for lane in range(width)) + ">"
    lanes = range(width)
    rows = "\n".join(
        f"%lane{r} = add i64 %first, {r}\n"
        f"%row{r} = call i64 @llvm.smin.i64(i64 %lane{r}, i64 %last)\n"
        f"%start{r} = mul i64 %row{r}, %stride\n"
        f"%at{r} = add i64 %start{r}, %offset\n"
        f"%base{r} = getelementptr {one}, ptr %array, i64 %at{r}"
        for r in lanes
    )
    places = "\n".join(
        f"%p{r} = getelementptr {one}, ptr %base{r}, i64 %k" for r in lanes
    )
    vectors = "\n".join(
        f"%q{j} = getelementptr i8, ptr %here, i64 {j * size * width}" for j in lanes
    )

    def moves(load_line: str, store_line: str) -> str:
        lines = [load_line.format(i=i) for i in lanes]
        names = [f"%v{i}" for i in lanes]
        names = _turned_over(lines, names, many, width)
        lines += [store_line.format(i=i, name=name) for i, name in enumerate(names)]
        return "\n".join(lines)

    fetch = moves(
        f"%v{{i}} = call {many} {load}(ptr %p{{i}}, i32 {size}, {truth} %inside, "
        f"{many} zeroinitializer)",
        f"store {many} {{name}}, ptr %q{{i}}, align {min(64, size * width)}",
    )
    bring = moves(
        f"%v{{i}} = load {many}, ptr %q{{i}}, align {min(64, size * width)}",
        f"call void {store}({many} {{name}}, ptr %p{{i}}, i32 {size}, {truth} %inside)",
    )

    def function(name: str, inner: str) -> str:
        return f"""
define internal void @{name}_squares_{kind}(ptr %array, i64 %stride, i64 %offset,
    i64 %count, i64 %first, i64 %rods, ptr %block) noinline nounwind {{
entry:
%last = sub i64 %rods, 1
{rows}
br label %loop
loop:
%k = phi i64 [0, %entry], [%next, %loop]
%left = sub i64 %count, %k
%left0 = insertelement {whole} poison, i64 %left, i64 0
%lefts = shufflevector {whole} %left0, {whole} poison, <{width} x i32> zeroinitializer
%inside = icmp slt {whole} {numbers}, %lefts
%to = mul i64 %k, {size * width}
%here = getelementptr i8, ptr %block, i64 %to
{places}
{vectors}
{inner}
%next = add i64 %k, {width}
%more = icmp slt i64 %next, %count
br i1 %more, label %loop, label %done
done:
ret void
}}
"""

    return function("fetch", fetch) + function("bring", bring), declared


def _turned_over(
    lines: list[str], names: list[str], many: str, width: int
) -> list[str]:
    """Appends lines that transpose a square tile of vectors, in log2(width) rounds.

    `names` are the vectors, one for each row of the tile, of the LLVM type `many`.

    Returns:
        The names of the transposed vectors.
    """
    distance = 1
    while distance < width:
        after = list(names)
        for i in range(width):
            if i & distance:
                continue
            a, b = names[i], names[i + distance]
            upper = [
                t if not t & distance else width + t - distance for t in range(width)
            ]
            lower = [
                t + distance if not t & distance else width + t for t in range(width)
            ]
            for place, order in ((i, upper), (i + distance, lower)):
                name = f"%s{distance}_{place}"
                mask = ", ".join(f"i32 {t}" for t in order)
                lines.append(
                    f"{name} = shufflevector {many} {a}, {many} {b}, "
                    f"<{width} x i32> <{mask}>"
                )
                after[place] = name
        names = after
        distance *= 2
    return names


def _suffix(one: str) -> str:
    return {"float": "f32", "double": "f64"}.get(one, one)
