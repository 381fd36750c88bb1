"""Nodes of a rod: access to the components of a field that a support holds."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.effects.base import Effect
from jaxrod.effects.ends import End, at_end
from jaxrod.effects.held import Axes
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState


def end_node(rod: Rod, end: End) -> int:
    """Number of the node at an end."""
    return 0 if end == "start" else rod.n_elements


def at_node(field: Vec3, value: Array, node: int, axes: Axes) -> Vec3:
    """A field with the components along some axes replaced at one node."""
    here = np.arange(field[0].shape[0]) == node
    x, y, z = (
        jnp.where(here, value[k], component) if axes[k] else component
        for k, component in enumerate(field)
    )
    return x, y, z


def distance_from(
    place: Array, node: int, axes: Axes, rod: Rod, state: RodState
) -> Array:
    """Distance of a node from a place along some axes, over the radius there [1]."""
    apart = (state.positions[:, node] - place) * jnp.asarray(axes, place.dtype)
    return (
        vectors.safe_norm(vectors.split(apart))
        / rod.radii[min(node, rod.n_elements - 1)]
    )


def force_at(needed: Loads, node: int, axes: Axes) -> Vec3:
    """The components along some axes of the force needed at a node [N]."""
    assert needed.forces is not None
    x, y, z = (
        component[node] if held else jnp.zeros_like(component[node])
        for component, held in zip(needed.forces, axes, strict=True)
    )
    return x, y, z


def own_couple(effect: Effect, rod: Rod, motion: Motion, end: End) -> Vec3:
    """Couple of an effect on an end element, world frame [N m]."""
    couples = effect.loads(rod, motion).couples
    assert couples is not None
    index = 0 if end == "start" else -1
    x, y, z = (component[index] for component in couples)
    return to_world(directors(at_end(motion.orientation, end)), (x, y, z))


def axes_named(axes: str) -> Axes:
    """Flags of the axes named in a string such as "xz"."""
    if not isinstance(axes, str) or not axes or not set(axes) <= set("xyz"):
        raise ValueError(f'axes must be some of "xyz", got {axes!r}')
    return "x" in axes, "y" in axes, "z" in axes


def check_straight_end(rod: Rod, end: End) -> None:
    """Raises a `ValueError` if a rod's end is curved at rest."""
    index = 0 if end == "start" else -1
    if np.any(np.asarray(rod.rest_curvatures[:, index]) != 0):
        raise ValueError(
            "what holds the end of a rod that is curved at rest there cannot be "
            "resampled: make it anew for the new rod"
        )
