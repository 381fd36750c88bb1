"""Quantities along a rod for colouring it; see `fields` of `Replay.from_states`."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.rods.elasticity import strains
from jaxrod.rods.rod import RodState


def speed(scene: Any, state: RodState) -> Float[Array, " n+1"]:
    """Speed of the nodes [m/s]."""
    return jnp.sqrt(jnp.sum(state.velocities**2, axis=0))


def stretch(scene: Any, state: RodState) -> Float[Array, " n"]:
    """Axial strain of the elements [1], positive in tension."""
    return (strains(scene.rod, state)[0] - scene.rod.rest_strains)[2]


def twist_rate(scene: Any, state: RodState) -> Float[Array, " n-1"]:
    """Twist per rest length at the joints, relative to the rest state [rad/m]."""
    return (strains(scene.rod, state)[1] - scene.rod.rest_curvatures)[2]


def bending(scene: Any, state: RodState) -> Float[Array, " n-1"]:
    """Curvature at the joints, relative to the rest state [1/m]."""
    first, second, _ = strains(scene.rod, state)[1] - scene.rod.rest_curvatures
    return jnp.hypot(first, second)
