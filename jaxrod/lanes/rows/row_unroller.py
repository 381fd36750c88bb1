"""Translation of a jaxpr of arrays to a graph of rows.

Rules of arithmetic, calls and branches are those of `jaxrod.lanes.jaxpr`. The rules
here are for primitives that move numbers, or combine those of one array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxrod.lanes.graph import DTYPES
import jaxrod.lanes.jaxpr  # noqa: F401  It registers the rules.
from jaxrod.lanes.jaxpr.arithmetic import as_kind
from jaxrod.lanes.jaxpr.unroll import (
    RULES,
    NotUnrolled,
    Rule,
    Unroller,
    kind_dtype,
    kind_of,
    rule,
)
from jaxrod.lanes.rows.arrays import Layout, Rows, long_axes
from jaxrod.lanes.rows.row_graph import Move, RowGraph, identity
from jaxrod.jax_internals.equations import scan_of

SHARED = (
    *("add_any", "square", "integer_pow", "sign", "logistic", "round", "is_finite"),
    *("clamp", "select_n", "convert_element_type", "copy", "stop_gradient"),
    *("optimization_barrier", "pvary", "reshard", "cond", "while", "platform_index"),
    *("custom_linear_solve", "closed_call", "custom_jvp_call", "custom_vjp_call"),
    *("jit", "remat2"),
)
"""Primitives whose rules know nothing of how arrays are laid out; elementwise
operations are further ones."""
MOST_UNROLLED = 64
"""Largest number of rounds of a loop that is unrolled."""


class RowUnroller(Unroller):
    """Translates jaxprs to nodes of one graph of rows."""

    graph: RowGraph

    def __init__(self, graph: RowGraph) -> None:
        """Makes an unroller.

        Args:
            graph: Graph to which nodes are added.
        """
        super().__init__(graph)
        self.rules = ROW_RULES
        self.layout = Layout(graph)

    def as_array(self, result: Any) -> Any:
        """Returns the result of a rule, which is an array of rows."""
        return result

    def number(self, array: Any) -> int:
        """Returns the node of an array of one number."""
        return array.scalar

    def each(self, operation: str, kind: str, *arrays: Any) -> Any:
        """Applies an operation to the entries of arrays of one shape."""
        return self.layout.each(operation, kind, *arrays)

    def mapped(self, function: Callable[..., int], kind: str, *arrays: Any) -> Any:
        """Applies a function of nodes, which makes a node of a kind, to entries."""
        return self.layout.mapped(function, kind, *arrays)

    def full(self, value: Any, shape: tuple[int, ...], kind: str) -> Any:
        """Returns an array of one known number."""
        return self.layout.full(self.graph.constant(value, kind), shape, kind)

    def known(self, value: Any, aval: Any) -> Any:
        """Returns an array whose numbers are known."""
        numbers = np.broadcast_to(np.asarray(value, kind_dtype(aval)), aval.shape)
        return self.layout.known(numbers, kind_of(aval))

    def input(self, which: int, aval: Any, rate: int) -> Rows:
        """Returns the array of operand number `which`."""
        kind, shape = kind_of(aval), tuple(map(int, aval.shape))
        size = int(np.prod(shape, dtype=int))
        node = self.graph.array(which, size, kind, rate)
        return self.layout.from_memory(node, shape, kind)


ROW_RULES: dict[str, Rule] = {}
"""Rules by name of the primitive: `(unroller, equation, *arrays)` to the results."""


def _row_rule(*names: str) -> Callable[[Rule], Rule]:
    return rule(*names, rules=ROW_RULES)


def _shape(equation: Any) -> tuple[int, ...]:
    """Returns the shape of the result of an equation."""
    return tuple(map(int, equation.outvars[0].aval.shape))


def _straight(array: Rows) -> list[Move]:
    return [Move(axis) for axis in range(len(array.shape))]


@_row_rule("slice")
def sliced(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a slice of an array."""
    starts = equation.params["start_indices"]
    strides = equation.params["strides"] or (1,) * len(starts)
    moves = [Move(axis, step) for axis, step in enumerate(strides)]
    shape = _shape(equation)
    return unroller.layout.taken(array, shape, starts, moves)


@_row_rule("squeeze", "expand_dims", "reshape")
def reshaped(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a change of shape."""
    if equation.params.get("new_sizes") and equation.params["dimensions"] is not None:
        raise NotUnrolled("rows have no reshape that permutes axes")
    shape = _shape(equation)
    return unroller.layout.reshaped(array, shape)


@_row_rule("broadcast_in_dim")
def broadcast(unroller: RowUnroller, equation: Any, array: Rows, *_: Any) -> Rows:
    """Translates a broadcast along new axes, and along those of length one."""
    shape = _shape(equation)
    moves = [Move(None)] * len(shape)
    for axis, to in enumerate(equation.params["broadcast_dimensions"]):
        if array.shape[axis] == shape[to]:
            moves[to] = Move(axis)
    return unroller.layout.taken(array, shape, [0] * len(array.shape), moves)


@_row_rule("transpose")
def transposed(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a transpose."""
    moves = [Move(axis) for axis in equation.params["permutation"]]
    shape = _shape(equation)
    return unroller.layout.taken(array, shape, [0] * len(shape), moves)


@_row_rule("rev")
def reversed_along(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a reversal along axes."""
    moves, start = _straight(array), [0] * len(array.shape)
    for axis in equation.params["dimensions"]:
        moves[axis], start[axis] = Move(axis, -1), array.shape[axis] - 1
    return unroller.layout.taken(array, array.shape, start, moves)


@_row_rule("concatenate")
def concatenated(unroller: RowUnroller, equation: Any, *arrays: Rows) -> Rows:
    """Translates a concatenation."""
    return unroller.layout.concatenated(arrays, equation.params["dimension"])


@_row_rule("stack")
def stacked(unroller: RowUnroller, equation: Any, *arrays: Rows) -> Rows:
    """Translates a stack along a new axis."""
    return _stacked(unroller, arrays, equation.params["axis"])


def _stacked(unroller: RowUnroller, arrays: Sequence[Rows], axis: int) -> Rows:
    shape = list(arrays[0].shape)
    shape.insert(axis, 1)
    made = [unroller.layout.reshaped(array, tuple(shape)) for array in arrays]
    return unroller.layout.concatenated(made, axis)


@_row_rule("unstack")
def unstacked(unroller: RowUnroller, equation: Any, array: Rows) -> list[Rows]:
    """Translates the separation into slices along an axis, which they lose."""
    axis = equation.params["axis"]
    return [_at(unroller, array, axis, i) for i in range(array.shape[axis])]


def _at(unroller: RowUnroller, array: Rows, axis: int, index: int) -> Rows:
    """Returns the slice at an index of an axis, which it loses."""
    moves = [Move(a) for a in range(len(array.shape)) if a != axis]
    start = [index if a == axis else 0 for a in range(len(array.shape))]
    shape = tuple(n for a, n in enumerate(array.shape) if a != axis)
    return unroller.layout.taken(array, shape, start, moves)


@_row_rule("split")
def parted(unroller: RowUnroller, equation: Any, array: Rows) -> list[Rows]:
    """Translates a split along an axis."""
    axis, begin, made = equation.params["axis"], 0, []
    for size in equation.params["sizes"]:
        made.append(unroller.layout.sliced(array, axis, begin, begin + size))
        begin += size
    return made


@_row_rule("pad")
def padded(unroller: RowUnroller, equation: Any, array: Rows, value: Rows) -> Rows:
    """Translates padding at the edges and between entries."""
    for axis, (low, high, inner) in enumerate(equation.params["padding_config"]):
        array = unroller.layout.padded(array, axis, low, high, inner, value.scalar)
    return array


@_row_rule("iota")
def counted(unroller: RowUnroller, equation: Any, *_: Any) -> Rows:
    """Translates the integers from zero along an axis."""
    shape, axis = _shape(equation), equation.params["dimension"]
    return _iota(unroller, shape, axis, kind_of(equation.outvars[0].aval))


def _iota(unroller: RowUnroller, shape: Any, axis: int, kind: str) -> Rows:
    graph, loops = unroller.graph, long_axes(shape)
    dims = tuple(shape[a] for a in loops)
    nodes = np.empty([1 if a in loops else n for a, n in enumerate(shape)], np.int64)
    for index in np.ndindex(*nodes.shape):
        if axis in loops:
            nodes[index] = graph.iota(dims, loops.index(axis), kind)
        else:
            nodes[index] = graph.constant(index[axis], kind)
    return Rows(shape, loops, nodes, kind)


_REDUCTIONS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "reduce_xor": "xor",
}


@_row_rule(*_REDUCTIONS)
def reduced(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a reduction along axes."""
    operation = _REDUCTIONS[equation.primitive.name]
    axes = tuple(equation.params["axes"])
    return _reduced(unroller, array, operation, axes)


def _reduced(
    unroller: RowUnroller, array: Rows, operation: str, axes: Sequence[int]
) -> Rows:
    graph, kind = unroller.graph, array.kind
    if 0 in array.shape:
        raise NotUnrolled("rows have no reduction of nothing")
    along = tuple(i for i, axis in enumerate(array.loops) if axis in axes)
    count = int(np.prod([array.dims[i] for i in along], dtype=int))

    def of(node: int) -> int:
        if not along:
            return node
        if graph.dims[node]:
            return graph.reduced(node, operation, along)
        if operation == "add":
            return graph.add("mul", (node, graph.constant(count, kind)), kind)
        if operation in ("mul", "xor"):
            raise NotUnrolled(f"rows have no '{operation}' of one number, repeated")
        return node

    nodes = graph.mapped(of, array.nodes) if along else array.nodes
    kept = [axis for axis in range(len(array.shape)) if axis not in axes]
    lines = np.transpose(nodes, (*axes, *kept))
    lines = lines.reshape(-1, *[nodes.shape[axis] for axis in kept])
    while len(lines) > 1:
        half = len(lines) // 2
        joined = graph.each(operation, kind, lines[:half], lines[half : 2 * half])
        lines = np.concatenate([joined, lines[2 * half :]])
    loops = tuple(kept.index(axis) for axis in array.loops if axis in kept)
    shape = tuple(array.shape[axis] for axis in kept)
    return Rows(shape, loops, lines[0], kind)


_CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}


@_row_rule(*_CUMULATIVE)
def accumulated(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a cumulative operation, by combination with ever longer shifts."""
    operation = _CUMULATIVE[equation.primitive.name]
    axis, kind = equation.params["axis"], array.kind
    none = unroller.graph.constant(identity(operation, kind), kind)
    n, shift = array.shape[axis], 1
    while shift < n:
        low, high = (-shift, shift) if equation.params["reverse"] else (shift, -shift)
        moved = unroller.layout.padded(array, axis, low, high, 0, none)
        array = unroller.each(operation, kind, array, moved)
        shift *= 2
    return array


@_row_rule("argmax", "argmin")
def place_of_extreme(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates the index of the largest or smallest entry; the first of equal ones.

    The first NaN wins, as in JAX.
    """
    kind = kind_of(equation.outvars[0].aval)
    (axis,) = equation.params["axes"]
    operation = "max" if equation.primitive.name == "argmax" else "min"
    best = _reduced(unroller, array, operation, (axis,))
    shape = tuple(1 if a == axis else n for a, n in enumerate(array.shape))
    best = unroller.layout.reshaped(best, shape)
    match = unroller.each("eq", "b1", array, best)
    if array.kind[0] == "f":
        odd = unroller.each("ne", "b1", array, array)
        match = unroller.each("or", "b1", match, odd)
    index = _iota(unroller, array.shape, axis, kind)
    beyond = unroller.full(array.shape[axis], (), kind)
    index = unroller.each("select", kind, match, index, beyond)
    return _reduced(unroller, index, "min", (axis,))


@_row_rule("tile")
def tiled(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates the repetition of a whole array."""
    for axis, count in enumerate(equation.params["reps"]):
        if count != 1:
            array = unroller.layout.concatenated([array] * count, axis)
    return array


@_row_rule("dot_general")
def product(unroller: RowUnroller, equation: Any, left: Rows, right: Rows) -> Rows:
    """Translates sums of products, such as matrix products."""
    kind = kind_of(equation.outvars[0].aval)
    summed, batch = equation.params["dimension_numbers"]
    layout = unroller.layout
    left = as_kind(unroller, left, left.kind, kind)
    right = as_kind(unroller, right, right.kind, kind)
    free = [
        [a for a in range(len(array.shape)) if a not in (*b, *s)]
        for array, s, b in zip((left, right), summed, batch, strict=True)
    ]
    n_batch, n_left, n_right = len(batch[0]), len(free[0]), len(free[1])
    shape = (
        *(left.shape[a] for a in batch[0]),
        *(left.shape[a] for a in free[0]),
        *(right.shape[a] for a in free[1]),
        *(left.shape[a] for a in summed[0]),
    )
    first_sum = n_batch + n_left + n_right
    moves_left = [Move(a) for a in (*batch[0], *free[0])]
    moves_left += [Move(None)] * n_right + [Move(a) for a in summed[0]]
    moves_right = [Move(a) for a in batch[1]] + [Move(None)] * n_left
    moves_right += [Move(a) for a in (*free[1], *summed[1])]
    a = layout.taken(left, shape, [0] * len(left.shape), moves_left)
    b = layout.taken(right, shape, [0] * len(right.shape), moves_right)
    terms = unroller.each("mul", kind, a, b)
    return _reduced(unroller, terms, "add", range(first_sum, len(shape)))


@_row_rule("scan")
def scanned(unroller: RowUnroller, equation: Any, *arrays: Rows) -> list[Rows]:
    """Unrolls a short loop of known length."""
    scan = scan_of(equation)
    if scan.length > MOST_UNROLLED or not scan.length:
        raise NotUnrolled(f"rows have no loop of {scan.length} rounds")
    n_carry, first_row = scan.n_carry, scan.n_constants + scan.n_carry
    consts, along = arrays[: scan.n_constants], arrays[first_row:]
    carry = list(arrays[scan.n_constants : first_row])
    rows: list[Any] = [None] * scan.length
    order = range(scan.length)
    for i in reversed(order) if scan.backwards else order:
        each = [_at(unroller, array, 0, i) for array in along]
        made = unroller.run(scan.body, [*consts, *carry, *each])
        carry, rows[i] = made[:n_carry], made[n_carry:]
    made = [
        _stacked(unroller, column, 0) for column in zip(*rows, strict=True)
    ]
    return [*carry, *made]


@_row_rule("dynamic_slice")
def picked(unroller: RowUnroller, equation: Any, array: Rows, *starts: Rows) -> Rows:
    """Translates a dynamic slice; its start is clamped so that it stays inside."""
    layout, graph = unroller.layout, unroller.graph
    sizes = tuple(map(int, equation.params["slice_sizes"]))
    known: list[int] = []
    moving = []
    for axis, start in enumerate(starts):
        room = array.shape[axis] - sizes[axis]
        value = graph.value(start.scalar)
        if room == 0 or value is not None:
            known.append(min(max(int(value or 0), 0), room))
        else:
            known.append(0)
            moving.append((axis, _clamped(unroller, start, room)))
    if not moving:
        return layout.taken(array, sizes, known, _straight(array))
    places = []
    for axis, start in moving:
        column = _iota(unroller, (sizes[axis],), 0, "i32")
        given = Rows((), (), np.array(start), "i32")
        places.append((axis, unroller.each("add", "i32", column, given)))
    return _read(unroller, array, sizes, known, places)


def _clamped(unroller: RowUnroller, start: Rows, room: int) -> int:
    """Returns the node of an index between 0 and `room`."""
    return _bounded(unroller, start, room)[0].scalar


def _read(
    unroller: RowUnroller,
    array: Rows,
    shape: tuple[int, ...],
    start: Sequence[int],
    places: Sequence[tuple[int, Rows]],
) -> Rows:
    """Reads an array at computed places along some axes, at known ones along others.

    Args:
        unroller: The unroller.
        array: The array that is read.
        shape: Shape of the result, whose axes are those of the array.
        start: First index along each axis.
        places: Axes with computed places, and those places, which are inside.
    """
    layout, graph = unroller.layout, unroller.graph
    node, base = layout.stored(array)
    stride = [
        int(np.prod(array.shape[axis + 1 :], dtype=int))
        for axis in range(len(array.shape))
    ]
    total = unroller.full(0, shape, "i32")
    computed = dict(places)
    for axis in range(len(shape)):
        at = computed.get(axis)
        if at is None:
            base += start[axis] * stride[axis]
            at = _iota(unroller, (shape[axis],), 0, "i32")
        moves = [Move(0 if a == axis else None) for a in range(len(shape))]
        spread = layout.taken(at, shape, [0], moves)
        step = unroller.full(stride[axis], (), "i32")
        part = unroller.each("mul", "i32", spread, step)
        total = unroller.each("add", "i32", total, part)
    return unroller.mapped(
        lambda index: graph.gathered(node, base, index), array.kind, total
    )


@_row_rule("dynamic_update_slice")
def replaced(
    unroller: RowUnroller, equation: Any, array: Rows, update: Rows, *starts: Rows
) -> Rows:
    """Translates the update of a dynamic slice, clamped like `picked`."""
    layout, graph = unroller.layout, unroller.graph
    result, inside = None, None
    places = []
    for axis, start in enumerate(starts):
        room = array.shape[axis] - update.shape[axis]
        if room == 0:
            continue
        at = _clamped(unroller, start, room)
        given = Rows((), (), np.array(at), "i32")
        along = _iota(unroller, (array.shape[axis],), 0, "i32")
        column = unroller.each("sub", "i32", along, given)
        last = unroller.full(update.shape[axis] - 1, (), "i32")
        zero = unroller.full(0, (), "i32")
        within = unroller.each(
            "and",
            "b1",
            unroller.each("ge", "b1", column, zero),
            unroller.each("le", "b1", column, last),
        )
        safe = unroller.each(
            "min", "i32", unroller.each("max", "i32", column, zero), last
        )
        moves = [Move(0 if a == axis else None) for a in range(len(array.shape))]
        within = layout.taken(within, array.shape, [0], moves)
        inside = within if inside is None else unroller.each("and", "b1", inside, within)
        places.append((axis, safe))
    if inside is None:
        return update
    read = _read(unroller, update, array.shape, [0] * len(array.shape), places)
    result = unroller.each("select", array.kind, inside, read, array)
    return result


@_row_rule("gather")
def gathered(unroller: RowUnroller, equation: Any, array: Rows, indices: Rows) -> Rows:
    """Translates a gather along one or more axes.

    Axes of the array of which a whole slice is taken stay as they are: of a table, each
    column is gathered.
    """
    numbers = equation.params["dimension_numbers"]
    sizes = tuple(map(int, equation.params["slice_sizes"]))
    if numbers.operand_batching_dims:
        raise NotUnrolled("rows do not gather along two batches")
    shape = _shape(equation)
    offset = tuple(numbers.offset_dims)
    batch = [axis for axis in range(len(shape)) if axis not in offset]
    window = [a for a in range(len(array.shape)) if a not in numbers.collapsed_slice_dims]
    indexed = tuple(numbers.start_index_map)
    columns = _index_columns(unroller, indices)
    mode = str(equation.params["mode"])
    valid = None
    starts = {}
    for axis, column in zip(indexed, columns, strict=True):
        room = array.shape[axis] - sizes[axis]
        clamped, inside = _bounded(unroller, column, room)
        if "FILL" in mode:
            valid = inside if valid is None else unroller.each("and", "b1", valid, inside)
        starts[axis] = clamped
    moves = [Move(batch.index(a) if a in batch else None) for a in range(len(shape))]
    across = [a for a in window if a not in indexed and sizes[a] == array.shape[a]]
    result = _gathered(
        unroller, array, shape, starts, window, offset, sizes, moves, across
    )
    if valid is None:
        return result
    outside = equation.params["fill_value"]
    if outside is None:
        outside = np.nan if array.kind[0] == "f" else 0
    spread = unroller.layout.taken(valid, shape, [0] * len(valid.shape), moves)
    none = unroller.full(outside, (), array.kind)
    return unroller.each("select", array.kind, spread, result, none)


def _gathered(
    unroller: RowUnroller,
    array: Rows,
    shape: tuple[int, ...],
    starts: dict[int, Rows],
    window: Sequence[int],
    offset: Sequence[int],
    sizes: Sequence[int],
    moves: Sequence[Move],
    across: Sequence[int],
) -> Rows:
    """Gathers for every index along axes `across` that are unrolled in the array."""
    layout, graph = unroller.layout, unroller.graph
    apart = [axis for axis in across if axis not in array.loops]
    places = {axis: offset[window.index(axis)] for axis in apart}
    inner = tuple(1 if a in places.values() else n for a, n in enumerate(shape))
    total = unroller.full(0, inner, "i32")
    rest = tuple(1 if a in apart else n for a, n in enumerate(array.shape))
    for axis in range(len(array.shape)):
        stride = int(np.prod(rest[axis + 1 :], dtype=int))
        parts = []
        if axis in starts:
            own = starts[axis]
            parts.append(layout.taken(own, inner, [0] * len(own.shape), moves))
        if axis in window and axis not in apart and sizes[axis] > 1:
            along = offset[window.index(axis)]
            column = _iota(unroller, (shape[along],), 0, "i32")
            aside = [Move(0 if a == along else None) for a in range(len(shape))]
            parts.append(layout.taken(column, inner, [0], aside))
        for part in parts:
            step = unroller.full(stride, (), "i32")
            part = unroller.each("mul", "i32", part, step)
            total = unroller.each("add", "i32", total, part)
    made = np.empty([array.shape[axis] for axis in apart], object)
    for index in np.ndindex(*made.shape):
        start = [0] * len(array.shape)
        for axis, i in zip(apart, index, strict=True):
            start[axis] = i
        part = layout.taken(
            array, rest, start, [Move(None if a in apart else a) for a in range(len(rest))]
        )
        node, base = layout.stored(part)
        made[index] = unroller.mapped(
            lambda at, node=node, base=base: graph.gathered(node, base, at),
            array.kind,
            total,
        )
    whole = list(made.reshape(-1)) if apart else [made[()]]
    for axis in reversed(apart):
        n = array.shape[axis]
        whole = [
            layout.concatenated(whole[i : i + n], places[axis])
            for i in range(0, len(whole), n)
        ]
    return whole[0]


def _index_columns(unroller: RowUnroller, indices: Rows) -> list[Rows]:
    """Returns the indices of each axis, which are along the last axis of `indices`."""
    last = len(indices.shape) - 1
    return [_at(unroller, indices, last, i) for i in range(indices.shape[last])]


def _bounded(unroller: RowUnroller, column: Rows, room: int) -> tuple[Rows, Rows]:
    """Returns indices between 0 and `room`, and whether they were so before."""
    kind = column.kind
    if kind not in ("i32", "i64", "u32"):
        raise NotUnrolled(f"rows have no indices of type {DTYPES[kind]}")
    zero, most = (unroller.full(n, (), kind) for n in (0, room))
    clamped = unroller.each("max", kind, column, zero)
    clamped = unroller.each("min", kind, clamped, most)
    inside = unroller.each("eq", "b1", clamped, column)
    return as_kind(unroller, clamped, kind, "i32"), inside


@_row_rule("scatter-add", "scatter-mul", "scatter-min", "scatter-max", "scatter")
def scattered(
    unroller: RowUnroller, equation: Any, array: Rows, indices: Rows, updates: Rows
) -> Rows:
    """Translates a scatter to computed places along one axis."""
    numbers = equation.params["dimension_numbers"]
    if numbers.operand_batching_dims:
        raise NotUnrolled("rows do not scatter along two batches")
    layout, graph = unroller.layout, unroller.graph
    (axis,) = numbers.scatter_dims_to_operand_dims or (None,)
    if axis is None or tuple(numbers.inserted_window_dims) != (axis,):
        raise NotUnrolled("rows do not scatter slices")
    window = tuple(numbers.update_window_dims)
    inner = [a for a in range(len(array.shape)) if a != axis]
    batch = [a for a in range(len(updates.shape)) if a not in window]
    for a, b in zip(inner, window, strict=True):
        if array.shape[a] != updates.shape[b]:
            raise NotUnrolled("rows do not scatter slices")
    (column,) = _index_columns(unroller, indices)
    n = array.shape[axis]
    clamped, inside = _bounded(unroller, column, n - 1)
    outside = unroller.full(n, (), "i32")
    if "CLIP" in str(equation.params["mode"]):
        raise NotUnrolled("rows do not scatter with clipped places")
    safe = unroller.each("select", "i32", inside, clamped, outside)
    count = int(np.prod(safe.shape, dtype=int))
    known = graph.value(safe.scalar) if count == 1 else None
    operation = {
        "scatter-add": "add",
        "scatter-mul": "mul",
        "scatter-min": "min",
        "scatter-max": "max",
        "scatter": "set",
    }[equation.primitive.name]
    if known is not None:
        return _changed_at(unroller, array, axis, int(known), updates, operation)
    flat_index = layout.looped(layout.reshaped(safe, (count,)), (0,))
    made = np.empty([array.shape[a] for a in inner], object)
    for at in np.ndindex(*made.shape):
        start, start_update = [0] * len(array.shape), [0] * len(updates.shape)
        for a, b, i in zip(inner, window, at, strict=True):
            start[a], start_update[b] = i, i
        own = layout.taken(array, (n,), start, [Move(axis)])
        shape = tuple(updates.shape[b] for b in batch)
        new = layout.taken(updates, shape, start_update, [Move(b) for b in batch])
        new = layout.looped(layout.reshaped(new, (count,)), (0,))
        own = layout.looped(own, (0,))
        rows = [int(row.nodes.reshape(-1)[0]) for row in (own, flat_index, new)]
        node = graph.scattered(*rows, operation, n, count)
        made[at] = layout.from_memory(node, (n,), array.kind)
    whole = [
        layout.reshaped(part, tuple(n if a == axis else 1 for a in range(len(array.shape))))
        for part in made.reshape(-1)
    ]
    for a in reversed(inner):
        k = array.shape[a]
        whole = [
            layout.concatenated(whole[i : i + k], a) for i in range(0, len(whole), k)
        ]
    return whole[0]


def _changed_at(
    unroller: RowUnroller,
    array: Rows,
    axis: int,
    index: int,
    update: Rows,
    operation: str,
) -> Rows:
    """Combines a slice at a known index with an update; none if it is outside."""
    layout, n = unroller.layout, array.shape[axis]
    if not 0 <= index < n:
        return array
    old = layout.sliced(array, axis, index, index + 1)
    new = layout.reshaped(update, old.shape)
    if operation != "set":
        new = unroller.each(operation, array.kind, old, new)
    before = layout.sliced(array, axis, 0, index)
    after = layout.sliced(array, axis, index + 1, n)
    return layout.concatenated([before, new, after], axis)


for _name in SHARED:
    ROW_RULES[_name] = RULES[_name]
for _name, _rule in RULES.items():
    if _rule.__module__.endswith("arithmetic"):
        ROW_RULES.setdefault(_name, _rule)
