"""Poses of places in the state from which a coupling takes its rest shape."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxrod.geometry.rotations import Quaternion, split_quaternion
from jaxrod.structure import pytree
from jaxrod.systems.places import Place, layouts_of, resolved
from jaxrod.validation import is_traced


@pytree
class Pose:
    """Position and orientation of a place in a state."""

    place: Any
    """Position of the node, or of the body's origin [m]."""
    orientation: Quaternion
    """Orientation of the element that turns with the place, or of the body."""
    spacing: Any
    """Distance to the next node; infinite for a body [m]."""


def position_of(name: str, place: Place, state: Mapping[str, Any]) -> Pose:
    """Pose of a place in a state.

    Args:
        name: Name of the argument, for messages.
        place: See `jaxrod.systems.places.Place`.
        state: State of a system.
    """
    layouts = layouts_of(state)
    member, node, element = resolved(name, place, layouts)
    own, layout = state[member], layouts[member]
    positions, orientations = own.positions, own.orientations
    if not is_traced(positions, orientations):
        # On the host: this is little work, and compiling it would take long.
        positions, orientations = map(np.asarray, (positions, orientations))
    node_of, element_of = node, element
    if layout.is_rod and positions.ndim == 3:
        rod, node_of = divmod(node, layout.n_elements + 1)
        _, element_of = divmod(element, layout.n_elements)
        positions, orientations = positions[rod], orientations[rod]
    x = positions[:, node_of]
    w = split_quaternion(orientations[:, element_of])
    if not layout.is_rod:
        return Pose(x, w, np.inf)
    edge = positions[:, element_of + 1] - positions[:, element_of]
    return Pose(x, w, (edge[0] ** 2 + edge[1] ** 2 + edge[2] ** 2) ** 0.5)
