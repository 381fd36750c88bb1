"""Shapes of bodies: for contact with a rod, and for rigid bodies of a system."""

from jaxrod.contacts.bodies import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Plane,
    SignedDistance,
    Sphere,
    box,
    capsule,
    cylinder,
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
    "Plane",
    "SignedDistance",
    "SignedDistanceGrid",
    "Sphere",
    "box",
    "capsule",
    "cylinder",
    "from_mesh",
    "load_mesh",
    "plane",
    "signed_distance",
    "signed_distance_grid",
    "sphere",
]
