"""Surface triangles of fixed bodies that rods touch, and of moving rigid bodies."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.contacts.bodies import Body
from jaxrod.geometry import surfaces
from jaxrod.geometry.surfaces import Triangles
from jaxrod.systems.members.parts import Parts
from jaxrod.viz.colours import FIXED
from jaxrod.viz.meshes import Mesh

_DOUBLINGS = 6


def mesh_of(bodies: Parts) -> Triangles:
    """Triangles of the surface of rigid bodies, in the body frame.

    If only the signed distance of a body is known, its surface is searched in a cube
    around the ellipsoid with its mass and inertia. The cube is doubled until the body
    fits inside.

    Raises:
        ValueError: No surface is found.
    """
    assert bodies.shape is not None
    known = bodies.shape.mesh()
    if known is not None:
        return known
    mass = float(bodies.node_masses[0])
    a, b, c = (float(x) for x in bodies.inertias[:, 0])
    axes = [2.5 * (p + q - r) / mass for p, q, r in ((b, c, a), (a, c, b), (a, b, c))]
    half = 1.2 * max(axes) ** 0.5
    for _ in range(_DOUBLINGS):
        cube = np.full(3, half)
        if not _touches(bodies.shape, half):
            return surfaces.of_distance(_surface(bodies.shape), -cube, cube)
        half *= 2
    raise ValueError("the surface of a rigid body must be closed to be drawn")


def _touches(shape: Body, half: float) -> bool:
    """Whether a body reaches a face of the cube from -half to half along each axis."""
    side = np.linspace(-half, half, 41)
    u, v = (x.ravel() for x in np.meshgrid(side, side))
    w = np.full_like(u, half)
    faces = [
        s * np.roll(np.stack([w, u, v]), k, axis=0) for k in range(3) for s in (1, -1)
    ]
    distance, _ = _surface(shape)(np.concatenate(faces, axis=1).T)
    return bool(np.any(np.asarray(distance) <= 0))


def solid_mesh(body: Body, low: np.ndarray, high: np.ndarray) -> Mesh:
    """Mesh of a fixed body, for drawing.

    A body that provides triangles is drawn completely. Any other body is drawn inside
    the box from `low` to `high`, widened by a quarter of its longest side.
    """
    known = body.mesh()
    if known is not None:
        return Mesh(*known, name="obstacle", colour=FIXED)
    margin = 0.25 * float(np.max(high - low))
    vertices, faces = surfaces.of_distance(
        _surface(body), low - margin, high + margin, cells=64
    )
    return Mesh(vertices, faces, name="obstacle", colour=FIXED)


def leaning_plane(body: Any, low: np.ndarray, high: np.ndarray) -> Mesh | None:
    """Mesh of a tilted plane inside the box from `low` to `high`; `None` if outside."""
    normal = np.asarray(body.normal, float)
    normal = normal / np.linalg.norm(normal)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    middle = (low + high) / 2
    centre = middle - ((middle - np.asarray(body.point)) @ normal) * normal
    reach = 2 * float(np.linalg.norm(high - low))
    square = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [centre + reach * (a * first + b * second) for a, b in square]
    for axis in range(3):
        for sign, bound in ((1, high[axis]), (-1, -low[axis])):
            corners = _cut(corners, axis, sign, bound)
    if len(corners) < 3:
        return None
    faces = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
    return Mesh(np.array(corners), np.array(faces), name="plane", colour=FIXED)


def _cut(
    corners: list[np.ndarray], axis: int, sign: int, bound: float
) -> list[np.ndarray]:
    """Clips a flat polygon at a plane: keeps points with sign x[axis] <= bound."""
    kept = []
    for here, after in zip(corners, corners[1:] + corners[:1], strict=True):
        a, b = sign * here[axis] - bound, sign * after[axis] - bound
        if a <= 0:
            kept.append(here)
        if a * b < 0:
            kept.append(here + a / (a - b) * (after - here))
    return kept


def _surface(body: Body) -> Any:
    """Function from points (N, 3) to signed distances (N,) and normals (N, 3)."""

    def at(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = jnp.asarray(points).T
        distance, normal = body.surface((x, y, z))
        return np.asarray(distance), np.stack([np.asarray(n) for n in normal], axis=-1)

    return at
