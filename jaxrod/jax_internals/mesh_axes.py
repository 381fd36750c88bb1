"""Mesh axes over which arrays vary: part of array types within `jax.shard_map`.

All operands and results of one operation must vary over the same axes, as JAX's loops
require for their carry.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import lax
from jax.sharding import NamedSharding, PartitionSpec


def axes_of(*avals: Any) -> frozenset[str]:
    """Returns the mesh axes over which at least one of the arrays varies."""
    found: frozenset[str] = frozenset()
    for aval in avals:
        kind = getattr(aval, "manual_axis_type", None)
        if kind is not None:
            found |= kind.varying
    return found


def pvary(arrays: Sequence[Any], axes: frozenset[str]) -> list[Any]:
    """Marks arrays as varying over mesh axes, and leaves their numbers unchanged."""
    made = []
    for array in arrays:
        missing = sorted(axes - axes_of(jax.typeof(array)))
        made.append(
            lax.pcast(array, tuple(missing), to="varying") if missing else array
        )
    return made


def varying_aval(shape: tuple[int, ...], dtype: Any, like: Sequence[Any]) -> Any:
    """Returns an array type that varies over every mesh axis of the types `like`."""
    axes = axes_of(*like)
    if not axes:
        return jax.core.ShapedArray(shape, dtype)
    return jax.core.ShapedArray(shape, dtype, **_placed(axes, like))


def varying_shape(aval: Any) -> jax.ShapeDtypeStruct:
    """Returns the shape, dtype and varying mesh axes of an array type, for tracing."""
    axes = axes_of(aval)
    if not axes:
        return jax.ShapeDtypeStruct(aval.shape, aval.dtype)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, **_placed(axes, [aval]))


def _placed(axes: frozenset[str], like: Sequence[Any]) -> dict[str, Any]:
    """Returns the keyword arguments that mark an array type as varying over mesh axes.

    The mesh is that of the first type in `like` that varies.
    """
    mesh = next(aval.sharding.mesh for aval in like if axes_of(aval))
    return {
        "sharding": NamedSharding(mesh, PartitionSpec()),
        "manual_axis_type": jax.sharding.ManualAxisType(varying=axes),
    }
