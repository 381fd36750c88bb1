"""Scans that may have no steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def scan(
    function: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    rows: Any = None,
    *,
    length: int | None = None,
    reverse: bool = False,
) -> tuple[Any, Any]:
    """The same as `lax.scan`, which under `jax.disable_jit()` refuses to have no steps.

    Args:
        function: Makes a carry and a row of results from a carry and a row.
        carry: The first carry.
        rows: What it goes along, by the leading axis.
        length: Number of steps; by default that of the rows.
        reverse: Whether it begins with the last row.
    """
    leaves = jax.tree.leaves(rows)
    steps = len(leaves[0]) if length is None else length
    if steps:
        return lax.scan(function, carry, rows, length=length, reverse=reverse)
    one = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), rows
    )
    _, made = jax.eval_shape(function, carry, one)
    return carry, jax.tree.map(lambda row: jnp.zeros((0, *row.shape), row.dtype), made)
