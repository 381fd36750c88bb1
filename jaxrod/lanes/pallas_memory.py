"""Memory of a kernel for GPUs: a row of numbers for each rod, read in tiles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxrod.lanes.cycle import Plan
from jaxrod.lanes.pallas_code import from_memory
from jaxrod.lanes.pallas_layout import Layout

BLOCK = 32
"""Number of rods in a block: the threads of one warp. Not tuned on a GPU."""
TILE = 512
"""Largest count of a rod's numbers that are loaded or stored at once: a power of 2."""

Refs = Mapping[tuple[str, str], Any]
"""Arrays in memory, by region and dtype."""


# Outside the kernel ---------------------------------------------------------------


def numbers_of(layout: Layout, operands: Mapping[int, Any]) -> list[Any]:
    """Packs the operands that all rods share into arrays, one of each dtype."""
    return [
        jnp.concatenate([array.reshape(-1) for array in arrays])
        for arrays in _by_type(layout, "numbers", operands)
    ]


def rows_of(layout: Layout, operands: Mapping[int, Any], padded: int) -> list[Any]:
    """Packs the operands of rods into arrays with a row for each rod.

    Rows are padded to whole tiles. The last block is padded with the last rod.
    """
    return [
        _filled(
            jnp.concatenate([a.reshape(a.shape[0], -1) for a in arrays], axis=1), padded
        )
        for region in ("own", "given")
        for arrays in _by_type(layout, region, operands)
    ]


def _by_type(
    layout: Layout, region: str, operands: Mapping[int, Any]
) -> list[list[Any]]:
    """Groups the operands of a region by dtype."""
    found: dict[str, list[Any]] = {dtype: [] for dtype in layout.sizes[region]}
    for which, (where, dtype, _) in layout.arrays.items():
        if where == region:
            found[dtype].append(lax.convert_element_type(operands[which], dtype))
    return list(found.values())


def _filled(rows: Any, padded: int) -> Any:
    rods, size = rows.shape
    if padded > rods:
        last = jnp.broadcast_to(rows[-1:], (padded - rods, size))
        rows = jnp.concatenate([rows, last])
    return jnp.pad(rows, ((0, 0), (0, _in_tiles(size) - size)))


def results_of(
    layout: Layout, plan: Plan, made: Mapping[str, Any], rods: int
) -> list[Any]:
    """Unpacks the arrays of results from rows."""
    avals = plan.ends.made if plan.ends is not None else plan.cycle.avals
    results = []
    for aval, entries, (dtype, first) in zip(
        avals, layout.ends.made, layout.made, strict=True
    ):
        rows = jnp.zeros((rods, 0), dtype)
        if entries.size:
            rows = made[dtype][:rods, first : first + entries.size]
        results.append(from_memory(rows, entries.kind).reshape(rods, *aval.shape))
    return results


# Within the kernel ----------------------------------------------------------------


def shared_numbers(layout: Layout, refs: Refs) -> Callable[[int], Any]:
    """Returns a function that loads the number of a node that all rods share."""

    def load(node: int) -> Any:
        region, dtype, which = layout.where(node)
        return from_memory(refs[region, dtype][which], layout.step.graph.kinds[node])

    return load


def given_columns(layout: Layout, refs: Refs) -> dict[int, Any]:
    """Loads all inputs that belong to rods, by node."""
    graph = layout.step.graph
    columns = {
        name: _loaded(refs[name])
        for region in ("own", "given")
        for name in layout.names(region)
    }
    found = {}
    for node in layout.used:
        if graph.operations[node] != "input" or graph.places[node][0] not in (
            layout.arrays
        ):
            continue
        region, dtype, which = layout.where(node)
        if (region, dtype) in columns:
            value = columns[region, dtype][which]
            found[node] = from_memory(value, graph.kinds[node])
    return found


def _loaded(ref: Any) -> list[Any]:
    """Loads all columns of a block."""
    columns: list[Any] = []
    width = min(TILE, ref.shape[1])
    for start in range(0, ref.shape[1], width):
        columns += _cut(ref[:, start : start + width])
    return columns


def store_columns(ref: Any, columns: list[Any]) -> None:
    """Stores columns; the rest of the last tile is filled with the last column."""
    width = min(TILE, ref.shape[1])
    columns = [*columns, *columns[-1:] * (ref.shape[1] - len(columns))]
    for start in range(0, ref.shape[1], width):
        ref[:, start : start + width] = _joined(columns[start : start + width])


def _cut(tile: Any) -> list[Any]:
    """Splits a tile into columns by repeated halving: Triton has no other way."""
    width = tile.shape[1]
    if width == 1:
        return [lax.reshape(tile, (BLOCK,))]
    return [c for half in lax.split(tile, (width // 2,) * 2, 1) for c in _cut(half)]


def _joined(columns: Sequence[Any]) -> Any:
    """Joins columns to a tile, by pairs."""
    if len(columns) == 1:
        return lax.reshape(columns[0], (BLOCK, 1))
    pairs = jnp.stack([_joined(columns[0::2]), _joined(columns[1::2])], axis=-1)
    return lax.reshape(pairs, (BLOCK, len(columns)))


def _in_tiles(size: int) -> int:
    """Rounds a size up to whole tiles, or to a power of two within one tile."""
    if size > TILE:
        return -(-size // TILE) * TILE
    return 1 << (size - 1).bit_length()


def shape_of(
    layout: Layout, name: tuple[str, str], padded: int | None = None
) -> jax.ShapeDtypeStruct:
    """Returns the shape and dtype of an array in memory."""
    size = layout.sizes[name[0]][name[1]]
    shape = (size,) if padded is None else (padded, _in_tiles(size))
    return jax.ShapeDtypeStruct(shape, np.dtype(name[1]))
