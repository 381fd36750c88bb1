"""Mesh axes over which arrays vary; they are part of types within `jax.shard_map`.

All operands and results of one operation vary over the same axes, as JAX's loops
require of their carry.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import lax
from jax.sharding import NamedSharding, PartitionSpec


def axes_of(*avals: Any) -> frozenset[str]:
    """Returns the axes over which at least one of the arrays varies."""
    found: frozenset[str] = frozenset()
    for aval in avals:
        kind = getattr(aval, "manual_axis_type", None)
        if kind is not None:
            found |= kind.varying
    return found


def pvary(arrays: Sequence[Any], axes: frozenset[str]) -> list[Any]:
    """Returns the same arrays, all marked as varying over these axes."""
    made = []
    for array in arrays:
        missing = sorted(axes - axes_of(jax.typeof(array)))
        made.append(
            lax.pcast(array, tuple(missing), to="varying") if missing else array
        )
    return made


def varying_aval(shape: tuple[int, ...], dtype: Any, like: Sequence[Any]) -> Any:
    """Returns the type of an array that varies over all axes of the arrays `like`."""
    axes = axes_of(*like)
    if not axes:
        return jax.core.ShapedArray(shape, dtype)
    return jax.core.ShapedArray(shape, dtype, **_placed(axes, like))


def varying_shape(aval: Any) -> jax.ShapeDtypeStruct:
    """Returns the shape and dtype of an array, with the axes over which it varies."""
    axes = axes_of(aval)
    if not axes:
        return jax.ShapeDtypeStruct(aval.shape, aval.dtype)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, **_placed(axes, [aval]))


def _placed(axes: frozenset[str], like: Sequence[Any]) -> dict[str, Any]:
    """Returns mesh and axes as keyword arguments for types of arrays."""
    mesh = next(aval.sharding.mesh for aval in like if axes_of(aval))
    return {
        "sharding": NamedSharding(mesh, PartitionSpec()),
        "manual_axis_type": jax.sharding.ManualAxisType(varying=axes),
    }
