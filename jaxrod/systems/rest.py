"""How members are placed in the state from which a coupling takes its rest shape."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion, split_quaternion
from jaxrod.structure import pytree
from jaxrod.systems.parts import in_one_row
from jaxrod.systems.places import Place, layouts_of, resolved


@pytree
class Pose:
    """A place in a state: where it is, how what turns with it is turned."""

    place: Float[Array, "3"]
    """Position of the node, or origin of the body [m]."""
    orientation: Quaternion
    """Of the element, or of the body."""
    spacing: Array
    """Distance to the next node; infinite for a body [m]."""


def position_of(name: str, place: Place, state: Mapping[str, Any]) -> Pose:
    """A place's pose in a state.

    Args:
        name: Of the argument, for messages.
        place: See `jaxrod.systems.places.Place`.
        state: State of a system.
    """
    layouts = layouts_of(state)
    member, node, element = resolved(name, place, layouts)
    own, layout = state[member], layouts[member]
    positions, orientations = own.positions, own.orientations
    if layout.is_rod and positions.ndim == 3:
        positions, orientations = in_one_row((positions, orientations))
    x = positions[:, node]
    w = split_quaternion(orientations[:, element])
    if not layout.is_rod:
        return Pose(x, w, jnp.full((), jnp.inf, positions.dtype))
    per_rod = layout.n_elements + 1
    first = element // layout.n_elements * per_rod + element % layout.n_elements
    edge = positions[:, first + 1] - positions[:, first]
    return Pose(x, w, vectors.safe_norm(vectors.split(edge)))
