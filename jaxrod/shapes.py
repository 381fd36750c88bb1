"""Shapes of bodies: for contact with a rod, and for rigid bodies of a system."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.contacts.bodies import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Pipe,
    Plane,
    SignedDistance,
    Sphere,
    box,
    capsule,
    cylinder,
    pipe,
    plane,
    signed_distance,
    sphere,
)
from jaxrod.contacts.distance_grid import (
    CoarseGridWarning,
    SignedDistanceGrid,
    from_mesh,
    load_mesh,
    signed_distance_grid,
)

__all__ = [
    "Body",
    "Box",
    "Capsule",
    "CoarseGridWarning",
    "Cylinder",
    "Pipe",
    "Plane",
    "SignedDistance",
    "SignedDistanceGrid",
    "Sphere",
    "box",
    "capsule",
    "cylinder",
    "from_mesh",
    "load_mesh",
    "pipe",
    "plane",
    "signed_distance",
    "signed_distance_grid",
    "sphere",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
