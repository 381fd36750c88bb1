"""Rules of primitives that move numbers: slices, reshapes, gathers, scatters.

Those that only rearrange numbers add no operations to the graph. Known indices are
resolved while the program is unrolled. A dynamic slice with a varying start selects
from all numbers to which it may point, as long as these are few.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxrod.lanes.graph import UNIFORM
from jaxrod.lanes.jaxpr.unroll import NotUnrolled, Unroller, kind_of, rule

MOST_CHOICES = 64
"""Largest number of positions that a dynamic slice with varying starts may have. A
program with more is not unrolled."""


@rule("dynamic_slice")
def picked(unroller: Unroller, equation: Any, array: Any, *starts: Any) -> Any:
    """Translates `dynamic_slice`; the start is clamped so that the slice is inside."""
    sizes = equation.params["slice_sizes"]
    kind = kind_of(equation.outvars[0].aval)

    def box(at: Sequence[int]) -> Any:
        return array[tuple(slice(a, a + s) for a, s in zip(at, sizes, strict=True))]

    rooms = [n - s for n, s in zip(array.shape, sizes, strict=True)]
    return _chosen(unroller, equation, 1, kind, starts, rooms, box)


@rule("dynamic_update_slice")
def replaced(
    unroller: Unroller, equation: Any, array: Any, update: Any, *starts: Any
) -> Any:
    """Translates `dynamic_update_slice`, which replaces a slice of an array.

    The start is clamped so that the slice is inside the array.
    """
    kind = kind_of(equation.outvars[0].aval)

    def changed(at: Sequence[int]) -> Any:
        result = array.copy()
        places = zip(at, update.shape, strict=True)
        result[tuple(slice(a, a + s) for a, s in places)] = update
        return result

    rooms = [n - s for n, s in zip(array.shape, update.shape, strict=True)]
    return _chosen(unroller, equation, 2, kind, starts, rooms, changed)


@rule("gather")
def gathered(unroller: Unroller, equation: Any, array: Any, indices: Any) -> Any:
    """Translates a gather; out-of-bounds indices follow its mode.

    The indices are known, or single numbers are read from an array that all rods share.
    """
    graph, kind = unroller.graph, kind_of(equation.outvars[0].aval)
    outside = equation.params["fill_value"]
    if outside is None:
        outside = np.nan if kind[0] == "f" else 0
    known = _known(unroller, indices)
    if known is not None:
        # Index -1 is that of the fill value, which is appended.
        params = {**equation.params, "fill_value": np.int32(-1)}
        places = np.arange(array.size, dtype=np.int32).reshape(array.shape)
        found = _evaluated(equation, params, places, known)
        nodes = np.append(array.reshape(-1), graph.constant(outside, kind))
        return nodes[found]
    flat = array.reshape(-1)
    first = int(flat[0])
    is_input = graph.operations[first] == "input" and graph.rates[first] == UNIFORM
    is_whole = np.array_equal(flat, np.arange(first, first + flat.size))
    simple = array.ndim == 1 and tuple(equation.params["slice_sizes"]) == (1,)
    index_kind = kind_of(equation.invars[1].aval)
    clips = "CLIP" in str(equation.params["mode"])
    if not (is_input and is_whole and simple and clips and index_kind == "i32"):
        raise NotUnrolled("lanes do not gather from places that change")

    def entry(index: int) -> int:
        return graph.looked_up(first, _clamped(graph, index, flat.size - 1, "i32"))

    found = unroller.mapped(entry, kind, indices)
    return found.reshape(equation.outvars[0].aval.shape)


@rule("scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max")
def scattered(
    unroller: Unroller, equation: Any, array: Any, indices: Any, updates: Any
) -> Any:
    """Translates a scatter with known indices.

    Each update replaces an entry, or is added, multiplied, or combined by min or max.
    """
    graph, kind = unroller.graph, kind_of(equation.outvars[0].aval)
    known = _known(unroller, indices)
    if known is None:
        raise NotUnrolled("lanes do not scatter to places that change")
    operation = {
        "scatter-add": "add",
        "scatter-mul": "mul",
        "scatter-min": "min",
        "scatter-max": "max",
    }.get(equation.primitive.name)
    result = array.reshape(-1).copy()
    flat = updates.reshape(-1)
    # Apply the updates one by one, in order.
    for number, target in enumerate(_targets(equation, array.shape, known, updates)):
        if target is None:
            continue
        if operation is None:
            result[target] = flat[number]
        else:
            pair = (int(result[target]), int(flat[number]))
            result[target] = graph.add(operation, pair, kind)
    return result.reshape(array.shape)


def _targets(
    equation: Any, shape: tuple[int, ...], known: Any, updates: Any
) -> list[int | None]:
    """Returns the flat index of the entry that each update of a scatter changes.

    It is `None` for an update outside the array of shape `shape`, which is dropped.
    `known` has the indices of the scatter.
    """
    numbers = equation.params["dimension_numbers"]
    window = numbers.update_window_dims
    rows = [axis for axis in range(updates.ndim) if axis not in window]
    mode = str(equation.params["mode"])
    if numbers.operand_batching_dims:
        raise NotUnrolled("lanes do not scatter along two batches")
    inner = [
        axis for axis in range(len(shape)) if axis not in numbers.inserted_window_dims
    ]
    targets: list[int | None] = []
    for position in np.ndindex(*updates.shape):
        start = np.zeros(len(shape), int)
        row = known[tuple(position[axis] for axis in rows)]
        for axis, value in zip(
            numbers.scatter_dims_to_operand_dims, np.atleast_1d(row), strict=True
        ):
            start[axis] = value
        place, inside = start.copy(), True
        for axis, update_axis in zip(inner, window, strict=True):
            place[axis] += position[update_axis]
            room = shape[axis] - updates.shape[update_axis]
            inside &= 0 <= start[axis] <= room
        for axis in numbers.inserted_window_dims:
            inside &= 0 <= start[axis] < shape[axis]
        if not inside and "CLIP" in mode:
            raise NotUnrolled("lanes do not scatter with clipped places")
        flat = int(np.ravel_multi_index(place, shape)) if inside else None
        targets.append(flat)
    return targets


def _known(unroller: Unroller, indices: Any) -> Any:
    """Returns the numbers of an array of nodes; `None` unless all are constants."""
    values = [unroller.graph.value(int(node)) for node in indices.reshape(-1)]
    if any(value is None for value in values):
        return None
    return np.array(values, np.int32).reshape(indices.shape)


def _evaluated(equation: Any, params: dict[str, Any], *arrays: Any) -> Any:
    with jax.ensure_compile_time_eval():
        return np.asarray(
            equation.primitive.bind(*map(jax.numpy.asarray, arrays), **params)
        )


def _chosen(
    unroller: Unroller,
    equation: Any,
    first_index: int,
    kind: str,
    starts: Sequence[Any],
    rooms: Sequence[int],
    result_at: Callable[[Sequence[int]], Any],
) -> Any:
    """Selects the result of an operation at a start that may vary.

    The start is clamped to the array. The result is computed for every possible start.

    Args:
        unroller: Translator that adds the nodes.
        equation: The operation.
        first_index: Position of the first start among the operands of `equation`.
        kind: Type of the result's numbers.
        starts: Node of the start along each axis.
        rooms: Largest start along each axis.
        result_at: Function that returns the result for known starts.
    """
    graph = unroller.graph
    ranges = []
    for start, room in zip(starts, rooms, strict=True):
        value = graph.value(int(start))
        fixed = None if value is None else min(max(int(value), 0), room)
        ranges.append(range(room + 1) if fixed is None else (fixed,))
    if math.prod(map(len, ranges)) > MOST_CHOICES:
        raise NotUnrolled(f"an index that changes has more than {MOST_CHOICES} choices")
    result = None
    for at in itertools.product(*ranges):
        candidate = result_at(at)
        if result is None:
            result = candidate
            continue
        chosen = graph.constant(True, "b1")
        for axis, (start, room) in enumerate(zip(starts, rooms, strict=True)):
            if len(ranges[axis]) > 1:
                index_kind = kind_of(equation.invars[first_index + axis].aval)
                within = _clamped(graph, int(start), room, index_kind)
                number = graph.constant(at[axis], index_kind)
                same = graph.add("eq", (within, number), "b1")
                chosen = graph.add("and", (chosen, same), "b1")
        result = graph.each("select", kind, np.int64(chosen), candidate, result)
    return result


def _clamped(graph: Any, start: int, room: int, kind: str) -> int:
    lowest, highest = graph.constant(0, kind), graph.constant(room, kind)
    return graph.add("min", (graph.add("max", (start, lowest), kind), highest), kind)


@rule("slice")
def sliced(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `slice`: every n-th entry between two limits along each axis."""
    starts, limits = equation.params["start_indices"], equation.params["limit_indices"]
    strides = equation.params["strides"] or (1,) * len(starts)
    return array[tuple(map(slice, starts, limits, strides))]


@rule("squeeze")
def squeezed(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `squeeze`: axes of length one are removed."""
    return np.squeeze(array, axis=tuple(equation.params["dimensions"]))


@rule("expand_dims")
def expanded(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `expand_dims`: axes of length one are inserted."""
    return np.expand_dims(array, tuple(equation.params["dimensions"]))


@rule("reshape")
def reshaped(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates a reshape: the nodes get the shape of the result."""
    return array.reshape(equation.outvars[0].aval.shape)


@rule("broadcast_in_dim")
def broadcast(unroller: Unroller, equation: Any, array: Any, *_: Any) -> Any:
    """Translates `broadcast_in_dim`: repeats entries along new or length-1 axes."""
    shape = equation.params["shape"]
    kept = [1] * len(shape)
    for axis, to in enumerate(equation.params["broadcast_dimensions"]):
        kept[to] = array.shape[axis]
    return np.broadcast_to(array.reshape(kept), shape)


@rule("transpose")
def transposed(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates a transpose: the axes are permuted."""
    return np.transpose(array, equation.params["permutation"])


@rule("rev")
def reversed_along(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `rev`: the order of entries is reversed along axes."""
    return np.flip(array, equation.params["dimensions"])


@rule("concatenate")
def concatenated(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates `concatenate`: arrays are joined along an axis."""
    return np.concatenate(arrays, axis=equation.params["dimension"])


@rule("stack")
def stacked(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates `stack`: arrays are joined along a new axis."""
    return np.stack(arrays, axis=equation.params["axis"])


@rule("unstack")
def unstacked(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `unstack`: returns the slices along an axis, without that axis."""
    return list(np.moveaxis(array, equation.params["axis"], 0))


@rule("split")
def parted(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `split`: returns parts of the given sizes along an axis."""
    cuts = np.cumsum(equation.params["sizes"])[:-1]
    return list(np.split(array, cuts, axis=equation.params["axis"]))


@rule("tile")
def tiled(unroller: Unroller, equation: Any, array: Any) -> Any:
    """Translates `tile`: an array is repeated along each axis."""
    return np.tile(array, equation.params["reps"])


@rule("pad")
def padded(unroller: Unroller, equation: Any, array: Any, value: Any) -> Any:
    """Translates padding at the edges and between entries.

    Negative padding removes entries at the edges.
    """
    result = array
    for axis, (low, high, inner) in enumerate(equation.params["padding_config"]):
        result = np.moveaxis(result, axis, 0)
        n = result.shape[0]
        length = n + max(n - 1, 0) * inner
        spread = np.full((length, *result.shape[1:]), value, np.int64)
        spread[:: inner + 1] = result
        spread = spread[max(0, -low) : max(length - max(0, -high), 0)]
        low, high = max(low, 0), max(high, 0)
        wide = np.full((low + len(spread) + high, *result.shape[1:]), value, np.int64)
        wide[low : low + len(spread)] = spread
        result = np.moveaxis(wide, 0, axis)
    return result


@rule("iota")
def counted(unroller: Unroller, equation: Any, *_: Any) -> Any:
    """Translates `iota`: the integers 0, 1, 2, ... along an axis."""
    shape, axis = equation.params["shape"], equation.params["dimension"]
    kind = kind_of(equation.outvars[0].aval)
    nodes = [unroller.graph.constant(i, kind) for i in range(shape[axis])]
    column = np.array(nodes, np.int64).reshape(
        [-1 if i == axis else 1 for i in range(len(shape))]
    )
    return np.broadcast_to(column, shape)
