"""Scans that may have zero steps."""

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
    """Runs `lax.scan`, and allows zero steps under `jax.disable_jit()` too.

    Args:
        function: Step that takes a carry and a row, and returns the next carry and a
            row of results.
        carry: Carry before the first step.
        rows: Pytree of arrays, scanned along their leading axis.
        length: Number of steps; by default the number of rows.
        reverse: Whether the scan begins with the last row.

    Returns:
        The last carry, and the rows of results stacked along a leading axis.
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
