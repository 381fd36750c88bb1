"""Members of assemblies: equal rods with the same effects, with a leading axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.effects.base import Effect
from jaxrod.effects.clamps import clamp
from jaxrod.rods.factories import rod_along, straight_rod
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Scene, make_scene

MOST_RODS = 100_000
"""Largest number of rods in an assembly; a larger number must be a mistake."""

Made = tuple[Rod, RodState]


def equal_rods(n_elements: int, each: Mapping[str, Any], **rod: Any) -> Made:
    """Rod and state of equal straight rods, in arrays with a leading axis over rods.

    Args:
        n_elements: Elements of each rod.
        each: Arguments of `jaxrod.straight_rod` that differ between the rods: arrays
            with a leading axis.
        **rod: Arguments that all rods share.
    """

    def one(own: dict[str, Any]) -> Made:
        return straight_rod(n_elements, **own, **rod)

    made: Made = jax.vmap(one)({name: jnp.asarray(leaf) for name, leaf in each.items()})
    return made


def rods_along(curves: Sequence[np.ndarray], **rod: Any) -> Made:
    """Rods of `n` elements along curves `(3, n + 1)` [m], stacked on a leading axis.

    Further arguments are those of `rod_along`.
    """
    made = [rod_along(curve, **rod) for curve in curves]
    stacked: Made = jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)
    return stacked


def scenes(
    rods: Rod, states: RodState, effects: Sequence[Effect], *, clamped: bool = False
) -> Scene:
    """Scenes of equal rods with the same effects; the rods may be clamped at the base.

    All arrays of the scene have a leading axis, one entry for each rod.
    """

    def one(rod: Rod, state: RodState) -> Scene:
        held = (clamp(state),) if clamped else ()
        return make_scene(rod, *held, *effects)

    made: Scene = jax.vmap(one)(rods, states)
    return made
