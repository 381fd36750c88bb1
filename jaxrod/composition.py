"""Composing a scene from a rod, effects and a method, with checks in words."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.effects.base import Effect
from jaxrod.methods.consistent import Consistent
from jaxrod.rods.rod import Rod
from jaxrod.scene import Method, Scene
from jaxrod.validation import check_held, check_kind, is_traced


def make_scene(rod: Rod, *effects: Effect, method: Method | None = None) -> Scene:
    """A scene: a rod and all that acts on it.

    Floating-point numbers of effects and of the method are converted to the rod's type.

    Args:
        rod: The rod.
        *effects: Effects on it, in the order in which they are applied.
        method: Method that steps it; by default `consistent()`. Others are
            `planar("xy")`, `torsion_free()`, `implicit()`, `pyelastica()` and
            `planar("xy", pyelastica())`.

    Raises:
        ValueError: If the scene is not one for the method.
        TypeError: If an effect is not an `Effect`, the rod is not a `Rod`, or the
            method is not a `Method`.
    """
    check_kind("rod", rod, Rod)
    for effect in effects:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"effects must be jaxrod effects, got {type(effect).__name__}"
            )
        effect.check(rod)
    if method is None:
        method = Consistent()
    if not isinstance(method, Method):
        raise TypeError(
            "method must be one such as jaxrod.consistent() or jaxrod.planar('xy'), "
            f"got {method!r}"
        )
    dtype = rod.rest_lengths.dtype
    listed = _in_type(dtype, "effects", tuple(effects))
    method = _in_type(dtype, "method", method)
    scene = Scene(rod, listed, method)
    method.check(scene)
    return scene


def _in_type(dtype: Any, name: str, tree: Any) -> Any:
    """Effects or a method with their real numbers in the rod's type."""

    def cast(path: Any, leaf: Any) -> Array:
        array = jnp.asarray(leaf)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            return array
        if not is_traced(array) and array.dtype != dtype:
            where = f"{name}{jax.tree_util.keystr(path)}"
            check_held(where, np.asarray(array, np.float64), "", dtype)
        return array.astype(dtype)

    return jax.tree_util.tree_map_with_path(cast, tree)
