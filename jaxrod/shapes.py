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

__all__ = [
    "Body",
    "Box",
    "Capsule",
    "Cylinder",
    "Plane",
    "SignedDistance",
    "Sphere",
    "box",
    "capsule",
    "cylinder",
    "plane",
    "signed_distance",
    "sphere",
]
