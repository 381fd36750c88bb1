"""Composing a scene from a rod, effects and a method, with checks in words."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod._validation import check_held, check_kind, is_traced
from jaxrod.effects import Effect
from jaxrod.methods.consistent import Consistent
from jaxrod.rod import Rod
from jaxrod.scene import Method, Scene


def make_scene(rod: Rod, *effects: Effect, method: Method | None = None) -> Scene:
    """A scene: a rod and all that acts on it.

    Floating-point numbers of effects and of the method are converted to the rod's type.

    Args:
        rod: The rod.
        *effects: What acts on it, in the order in which it is applied.
        method: How it is stepped; by default `consistent()`. Others are
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
    listed, method = jax.tree_util.tree_map_with_path(
        partial(_cast, rod.rest_lengths.dtype), (tuple(effects), method)
    )
    scene = Scene(rod, listed, method)
    method.check(scene)
    return scene


def _cast(dtype: Any, path: Any, leaf: Any) -> Array:
    """A number of an effect or setting, in the rod's type if it is a real one."""
    if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
        return jnp.asarray(leaf)
    if not is_traced(leaf) and leaf.dtype != dtype:
        where = ("effects", "method")[path[0].idx]
        name = where + jax.tree_util.keystr(path[1:])
        check_held(name, np.asarray(leaf, np.float64), "", dtype)
    return jnp.asarray(leaf, dtype)
