"""Rules by which gathers, scatters and dynamic slices become operations on rows.

Indices may vary. They are clamped, so that no kernel reads or writes outside an array.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxrod.lanes.graph import DTYPES
from jaxrod.lanes.jaxpr.arithmetic import as_kind
from jaxrod.lanes.jaxpr.unroll import NotUnrolled
from jaxrod.lanes.rows.arrays import Rows
from jaxrod.lanes.rows.row_graph import Move
from jaxrod.lanes.rows.row_unroller import (
    RowUnroller,
    result_shape,
    row_of_places,
    row_rule,
    slice_at,
    straight,
)


@row_rule("dynamic_slice")
def picked(unroller: RowUnroller, equation: Any, array: Rows, *starts: Rows) -> Rows:
    """Translates `dynamic_slice`; the start is clamped so that the slice is inside."""
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
        return layout.taken(array, sizes, known, straight(array))
    places = []
    for axis, at in moving:
        column = row_of_places(unroller, (sizes[axis],), 0, "i32")
        given = Rows((), (), np.array(at), "i32")
        places.append((axis, unroller.each("add", "i32", column, given)))
    return _read(unroller, array, sizes, known, places)


def _clamped(unroller: RowUnroller, start: Rows, room: int) -> int:
    """Returns the node of an index, clamped to the range from 0 to `room`."""
    return _bounded(unroller, start, room)[0].scalar


def _read(
    unroller: RowUnroller,
    array: Rows,
    shape: tuple[int, ...],
    start: Sequence[int],
    places: Sequence[tuple[int, Rows]],
) -> Rows:
    """Reads an array at computed indices along some axes, at regular ones elsewhere.

    Args:
        unroller: Translator that adds the nodes.
        array: The array that is read.
        shape: Shape of the result, whose axes are those of the array.
        start: First index along each axis that is read at regular indices.
        places: Axes that are read at computed indices, with these indices, which must
            be inside the array.
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
            at = row_of_places(unroller, (shape[axis],), 0, "i32")
        moves = [Move(0 if a == axis else None) for a in range(len(shape))]
        spread = layout.taken(at, shape, [0], moves)
        step = unroller.full(stride[axis], (), "i32")
        part = unroller.each("mul", "i32", spread, step)
        total = unroller.each("add", "i32", total, part)
    return unroller.mapped(
        lambda index: graph.gathered(node, base, index), array.kind, total
    )


@row_rule("dynamic_update_slice")
def replaced(
    unroller: RowUnroller, equation: Any, array: Rows, update: Rows, *starts: Rows
) -> Rows:
    """Translates `dynamic_update_slice`, which replaces a slice of an array.

    The start is clamped so that the slice is inside the array.
    """
    layout, inside = unroller.layout, None
    known = [unroller.graph.value(start.scalar) for start in starts]
    if None not in known:
        rooms = [n - k for n, k in zip(array.shape, update.shape, strict=True)]
        first = [
            min(max(int(at), 0), room) for at, room in zip(known, rooms, strict=True)
        ]
        return _changed(unroller, array, first, update, "set")
    places: list[tuple[int, Rows]] = []
    for axis, start in enumerate(starts):
        room = array.shape[axis] - update.shape[axis]
        if room == 0:
            continue
        at = _clamped(unroller, start, room)
        given = Rows((), (), np.array(at), "i32")
        along = row_of_places(unroller, (array.shape[axis],), 0, "i32")
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
        inside = (
            within if inside is None else unroller.each("and", "b1", inside, within)
        )
        places.append((axis, safe))
    if inside is None:
        return update
    read = _read(unroller, update, array.shape, [0] * len(array.shape), places)
    return unroller.each("select", array.kind, inside, read, array)


@row_rule("gather")
def gathered(unroller: RowUnroller, equation: Any, array: Rows, indices: Rows) -> Rows:
    """Translates a gather with indices along one or more axes.

    An axis that is taken as a whole remains an axis of the result: the same gather is
    repeated for each of its entries, such as the columns of a table.
    """
    numbers = equation.params["dimension_numbers"]
    sizes = tuple(map(int, equation.params["slice_sizes"]))
    if numbers.operand_batching_dims:
        raise NotUnrolled("rows do not gather along two batches")
    shape = result_shape(equation)
    offset = tuple(numbers.offset_dims)
    batch = [axis for axis in range(len(shape)) if axis not in offset]
    window = [
        a for a in range(len(array.shape)) if a not in numbers.collapsed_slice_dims
    ]
    indexed = tuple(numbers.start_index_map)
    columns = _index_columns(unroller, indices)
    mode = str(equation.params["mode"])
    valid = None
    starts = {}
    for axis, column in zip(indexed, columns, strict=True):
        room = array.shape[axis] - sizes[axis]
        clamped, inside = _bounded(unroller, column, room)
        if "FILL" in mode:
            valid = (
                inside if valid is None else unroller.each("and", "b1", valid, inside)
            )
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
    """Gathers numbers at clamped indices, for each index along unrolled axes.

    Args:
        unroller: Translator that adds the nodes.
        array: The array that is read.
        shape: Shape of the result.
        starts: Indices along the axes of `array` that have indices, by axis.
        window: Axes of `array` that remain axes of the result.
        offset: Axes of the result for the axes in `window`.
        sizes: Length of the gathered slice along each axis of `array`.
        moves: Path of each axis of the result through the arrays of indices.
        across: Axes of `array` that are taken as a whole.
    """
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
            column = row_of_places(unroller, (shape[along],), 0, "i32")
            aside = [Move(0 if a == along else None) for a in range(len(shape))]
            parts.append(layout.taken(column, inner, [0], aside))
        for part in parts:
            step = unroller.full(stride, (), "i32")
            part = unroller.each("mul", "i32", part, step)
            total = unroller.each("add", "i32", total, part)
    made: Any = np.empty([array.shape[axis] for axis in apart], object)
    for index in np.ndindex(*made.shape):
        start = [0] * len(array.shape)
        for axis, i in zip(apart, index, strict=True):
            start[axis] = i
        part = layout.taken(
            array,
            rest,
            start,
            [Move(None if a in apart else a) for a in range(len(rest))],
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
    """Splits `indices` along its last axis, into one array for each indexed axis."""
    last = len(indices.shape) - 1
    return [slice_at(unroller, indices, last, i) for i in range(indices.shape[last])]


def _bounded(unroller: RowUnroller, column: Rows, room: int) -> tuple[Rows, Rows]:
    """Returns indices clamped to 0 ... `room`, and a mask: whether each was inside."""
    kind = column.kind
    if kind not in ("i32", "i64", "u32"):
        raise NotUnrolled(f"rows have no indices of type {DTYPES[kind]}")
    zero, most = (unroller.full(n, (), kind) for n in (0, room))
    clamped = unroller.each("max", kind, column, zero)
    clamped = unroller.each("min", kind, clamped, most)
    inside = unroller.each("eq", "b1", clamped, column)
    return as_kind(unroller, clamped, kind, "i32"), inside


_SCATTERS = {
    "scatter-add": "add",
    "scatter-mul": "mul",
    "scatter-min": "min",
    "scatter-max": "max",
    "scatter": "set",
}


@row_rule("scatter-add", "scatter-mul", "scatter-min", "scatter-max", "scatter")
def scattered(
    unroller: RowUnroller, equation: Any, array: Rows, indices: Rows, updates: Rows
) -> Rows:
    """Translates a scatter at computed indices along one axis.

    A scatter of one slice at known indices may have several indexed axes.
    """
    numbers = equation.params["dimension_numbers"]
    if numbers.operand_batching_dims:
        raise NotUnrolled("rows do not scatter along two batches")
    layout, graph = unroller.layout, unroller.graph
    operation = _SCATTERS[equation.primitive.name]
    columns = _index_columns(unroller, indices)
    known = [graph.value(column.scalar) for column in columns]
    if np.prod(indices.shape[:-1]) == 1 and None not in known:
        places = dict(zip(numbers.scatter_dims_to_operand_dims, known, strict=True))
        clip = "CLIP" in str(equation.params["mode"])
        return _scattered_once(
            unroller, numbers, array, places, updates, operation, clip
        )
    if len(columns) != 1:
        raise NotUnrolled("rows do not scatter along several axes")
    (axis,) = numbers.scatter_dims_to_operand_dims
    if tuple(numbers.inserted_window_dims) != (axis,):
        raise NotUnrolled("rows do not scatter slices")
    window = tuple(numbers.update_window_dims)
    inner = [a for a in range(len(array.shape)) if a != axis]
    batch = [a for a in range(len(updates.shape)) if a not in window]
    for a, b in zip(inner, window, strict=True):
        if array.shape[a] != updates.shape[b]:
            raise NotUnrolled("rows do not scatter slices")
    (column,) = columns
    n = array.shape[axis]
    clamped, inside = _bounded(unroller, column, n - 1)
    outside = unroller.full(n, (), "i32")
    if "CLIP" in str(equation.params["mode"]):
        raise NotUnrolled("rows do not scatter with clipped places")
    safe = unroller.each("select", "i32", inside, clamped, outside)
    count = int(np.prod(safe.shape, dtype=int))
    flat_index = layout.looped(layout.reshaped(safe, (count,)), (0,))
    made: Any = np.empty([array.shape[a] for a in inner], object)
    for at in np.ndindex(*made.shape):
        start, start_update = [0] * len(array.shape), [0] * len(updates.shape)
        for a, b, i in zip(inner, window, at, strict=True):
            start[a], start_update[b] = i, i
        own = layout.taken(array, (n,), start, [Move(axis)])
        shape = tuple(updates.shape[b] for b in batch)
        new = layout.taken(updates, shape, start_update, [Move(b) for b in batch])
        new = layout.looped(layout.reshaped(new, (count,)), (0,))
        own = layout.looped(own, (0,))
        into, index, put = (
            int(row.nodes.reshape(-1)[0]) for row in (own, flat_index, new)
        )
        node = graph.scattered(into, index, put, operation, n, count)
        made[at] = layout.from_memory(node, (n,), array.kind)
    whole = [
        layout.reshaped(
            part, tuple(n if a == axis else 1 for a in range(len(array.shape)))
        )
        for part in made.reshape(-1)
    ]
    for a in reversed(inner):
        k = array.shape[a]
        whole = [
            layout.concatenated(whole[i : i + k], a) for i in range(0, len(whole), k)
        ]
    return whole[0]


def _scattered_once(
    unroller: RowUnroller,
    numbers: Any,
    array: Rows,
    places: dict[int, Any],
    update: Rows,
    operation: str,
    clip: bool,
) -> Rows:
    """Combines an update with one slice of an array that begins at known indices.

    Args:
        unroller: Translator that adds the nodes.
        numbers: Dimension numbers of the scatter.
        array: The array.
        places: Start of the slice, by indexed axis.
        update: The update.
        operation: Operation that combines the two, or `"set"`.
        clip: Whether a start outside the array is clamped; otherwise the update is
            dropped.
    """
    # The other axes of the update are those of the indices, each of length one.
    sizes = iter([update.shape[axis] for axis in numbers.update_window_dims])
    inserted = numbers.inserted_window_dims
    shape = [1 if a in inserted else next(sizes) for a in range(len(array.shape))]
    rooms = [n - size for n, size in zip(array.shape, shape, strict=True)]
    start = [int(places.get(axis, 0)) for axis in range(len(shape))]
    inside = [min(max(at, 0), room) for at, room in zip(start, rooms, strict=True)]
    if inside != start and not clip:
        return array
    new = unroller.layout.reshaped(update, tuple(shape))
    return _changed(unroller, array, inside, new, operation)


def _changed(
    unroller: RowUnroller,
    array: Rows,
    start: Sequence[int],
    new: Rows,
    operation: str,
    axis: int = 0,
) -> Rows:
    """Combines a slice of an array, from known indices `start` on, with `new`.

    `operation` is that of a scatter, such as `"add"`, or `"set"`. The function calls
    itself for one axis after another: along the axes before `axis`, `array` has been
    cut to the slice.
    """
    layout = unroller.layout
    if axis == len(array.shape):
        if operation == "set":
            return new
        return unroller.each(operation, array.kind, array, new)
    n, first = array.shape[axis], start[axis]
    last = first + new.shape[axis]
    middle = layout.sliced(array, axis, first, last)
    middle = _changed(unroller, middle, start, new, operation, axis + 1)
    if last - first == n:
        return middle
    before = layout.sliced(array, axis, 0, first)
    after = layout.sliced(array, axis, last, n)
    return layout.concatenated([before, middle, after], axis)
