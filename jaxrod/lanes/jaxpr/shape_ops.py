"""Rules of primitives that rearrange numbers: they add no operations to the graph."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxrod.lanes.jaxpr.unroll import Unroller, kind_of, rule


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
    """Translates `broadcast_in_dim`: entries repeat along axes of length one or new."""
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
