"""Axes of a mesh over which arrays vary: within `jax.shard_map`, part of their type.

Everything that goes through one operation varies over the same axes, as loops of JAX
ask of what they carry.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import lax
from jax.sharding import NamedSharding, PartitionSpec


def axes_of(*avals: Any) -> frozenset[str]:
    """Axes over which at least one of some arrays varies."""
    found: frozenset[str] = frozenset()
    for aval in avals:
        kind = getattr(aval, "manual_axis_type", None)
        if kind is not None:
            found |= kind.varying
    return found


def varied(arrays: Sequence[Any], axes: frozenset[str]) -> list[Any]:
    """The same arrays, all varying over some axes."""
    made = []
    for array in arrays:
        missing = sorted(axes - axes_of(jax.typeof(array)))
        made.append(
            lax.pcast(array, tuple(missing), to="varying") if missing else array
        )
    return made


def varying_aval(shape: tuple[int, ...], dtype: Any, like: Sequence[Any]) -> Any:
    """The type of an array that varies over all axes over which some others vary."""
    axes = axes_of(*like)
    if not axes:
        return jax.core.ShapedArray(shape, dtype)
    return jax.core.ShapedArray(shape, dtype, **_placed(axes, like))


def varying_shape(aval: Any) -> jax.ShapeDtypeStruct:
    """The shape and type of an array, and the axes over which it varies."""
    axes = axes_of(aval)
    if not axes:
        return jax.ShapeDtypeStruct(aval.shape, aval.dtype)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, **_placed(axes, [aval]))


def _placed(axes: frozenset[str], like: Sequence[Any]) -> dict[str, Any]:
    """Mesh and axes, as types of arrays are given them."""
    mesh = next(aval.sharding.mesh for aval in like if axes_of(aval))
    return {
        "sharding": NamedSharding(mesh, PartitionSpec()),
        "manual_axis_type": jax.sharding.ManualAxisType(varying=axes),
    }
