"""Composing a scene from a rod, effects and a method, with checks in words."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

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
    if not isinstance(rod, Rod):
        raise TypeError(
            f"rod must be a jaxrod.Rod, got {type(rod).__name__} "
            "(factories return the pair rod, state)"
        )
    for effect in effects:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"effects must be jaxrod effects, got {type(effect).__name__}"
            )
    if method is None:
        method = Consistent()
    if not isinstance(method, Method):
        raise TypeError(
            "method must be one such as jaxrod.consistent() or jaxrod.planar('xy'), "
            f"got {method!r}"
        )
    dtype = rod.rest_lengths.dtype

    def cast(leaf: Array) -> Array:
        leaf = jnp.asarray(leaf)
        return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    scene = Scene(rod, *jax.tree.map(cast, (tuple(effects), method)))
    method.check(scene)
    return scene
