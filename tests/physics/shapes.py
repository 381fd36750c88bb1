"""One body of every kind, and how to move it as a whole."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    multiply_quaternions,
    rotation_exp,
    split_quaternion,
    to_world,
)


def egg(point, parameters):
    """A sphere by its signed distance, smooth at its centre too."""
    centre, radius = parameters
    return jnp.sqrt(jnp.sum((point - centre) ** 2) + (1e-3 * radius) ** 2) - radius


# With volumes around the origin and 0.2 m in size.
BODIES = {
    "sphere": lambda: jaxrod.shapes.sphere((0.1, -0.02, 0.05), 0.2),
    "capsule": lambda: jaxrod.shapes.capsule((-0.2, 0.1, 0.0), (0.2, 0.0, 0.1), 0.15),
    "cylinder": lambda: jaxrod.shapes.cylinder((-0.2, 0.1, 0.0), (0.2, 0.0, 0.1), 0.15),
    "pipe": lambda: jaxrod.shapes.pipe(
        (-0.2, 0.1, 0.0), (0.2, 0.0, 0.1), 0.15, thickness=0.1
    ),
    "plane": lambda: jaxrod.shapes.plane((0.0, 0.1, 0.0), (0.3, 2.0, -0.5)),
    "box": lambda: jaxrod.shapes.box(
        (0.05, 0.0, -0.05), (0.1, 0.2, 0.3), (0.9, 0.1, -0.3, 0.2)
    ),
    "signed distance": lambda: jaxrod.shapes.signed_distance(
        egg, (np.array([0.0, 0.1, 0.0]), 0.2)
    ),
}


def turned(body, rotation, shift):
    """The body moved as a rigid whole."""
    turn = tuple(c[None] for c in rotation_exp(vectors.split(rotation)))

    def place(point):
        return rotated(rotation, point[:, None])[:, 0] + shift

    if isinstance(body, jaxrod.shapes.Sphere):
        return jaxrod.shapes.Sphere(place(body.centre), body.radius)
    if isinstance(body, jaxrod.shapes.Plane):
        return jaxrod.shapes.Plane(place(body.point), place(body.normal) - shift)
    if isinstance(body, jaxrod.shapes.Box):
        own = split_quaternion(body.orientation[:, None])
        both = jnp.stack(multiply_quaternions(turn, own))[:, 0]
        return jaxrod.shapes.Box(place(body.centre), body.half_lengths, both)
    if isinstance(body, jaxrod.shapes.SignedDistance):
        centre, radius = body.parameters
        return jaxrod.shapes.signed_distance(egg, (place(centre), radius))
    return replace(body, start=place(body.start), end=place(body.end))


def rotated(rotation, points):
    quaternion = rotation_exp(tuple(component[None] for component in rotation))
    frame = directors(quaternion)
    return vectors.join(to_world(frame, vectors.split(points)))
