"""Conversion of a frame of a replay into triangles with normals and colours."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from jaxrod.geometry import surfaces
from jaxrod.viz.colours import (
    FIXED,
    SPHERES,
    linear,
    mesh_colours,
    ramp,
    rod_colours,
)
from jaxrod.viz.recording import Recording
from jaxrod.viz.rods import at_nodes
from jaxrod.viz.shapes import Mesh, rotation, shaded

_SIDES = 24
_MOST_SEGMENTS = 4000
"""Limit on the number of segments of all rods' tubes. Elements are divided into one to
five segments to stay below it. With more elements than this, tubes have fewer sides."""


class Triangles(NamedTuple):
    """M triangles with normals and colours at their corners."""

    corners: np.ndarray
    """Corners in the world frame [m], (M, 3, 3): triangle, corner, x y z."""
    normals: np.ndarray
    """Outward unit normals at the corners in the world frame, (M, 3, 3)."""
    colours: np.ndarray
    """Linear red, green and blue at the corners, 0 to 1, (M, 3, 3)."""


class Shapes:
    """Converter of a replay's frames to triangles; surfaces are prepared once."""

    def __init__(self, replay: Recording, field: str | None = None) -> None:
        """Prepares surfaces of bodies; `field` is the label of the colouring field."""
        self.replay = replay
        self.field = field
        self.range = replay.field_range(field) if field else (0.0, 1.0)
        self.rods = [linear(colour) for colour in rod_colours(replay)]
        self.meshes = [shaded(mesh) for mesh in replay.meshes]
        self.ball = _unit_ball()
        low, high = replay.bounds()
        self.size = float(np.linalg.norm(high - low))
        self.arrows = [arrows.drawn(self.size)[0] for arrows in replay.arrows]
        segments = sum(r.num_rods * (r.num_nodes - 1) for r in replay.rods)
        self.along = int(np.clip(_MOST_SEGMENTS // max(segments, 1), 1, 5))
        self.sides = _SIDES if segments <= _MOST_SEGMENTS else 10

    def at(self, frame: int) -> Triangles:
        """Triangles of everything shown in frame number `frame`."""
        replay, parts = self.replay, []
        first = 0
        for rods in replay.rods:
            radii = at_nodes(rods.radii)
            for rod in range(rods.num_rods):
                colour = np.broadcast_to(self.rods[first + rod], (rods.num_nodes, 3))
                if self.field is not None and self.field in rods.fields:
                    colour = self._levels(rods.fields[self.field][frame, rod], colour)
                parts.append(self._tube(rods.positions[frame, rod], radii[rod], colour))
            first += rods.num_rods
        for mesh, (corners, normals), name in zip(
            replay.meshes, self.meshes, mesh_colours(replay), strict=True
        ):
            for body in range(mesh.count):
                turn = rotation(mesh.orientations[frame, body]).T
                place = mesh.positions[frame, body]
                parts.append(_alike(corners @ turn + place, normals @ turn, name))
        for k, sphere in enumerate(replay.spheres):
            corners, normals = self.ball
            where = sphere.positions[frame] + sphere.radius * corners
            parts.append(_alike(where, normals, SPHERES[k % len(SPHERES)]))
        for cylinder in replay.cylinders:
            ends, both = np.stack([cylinder.start, cylinder.end]), np.ones(2)
            grey = np.broadcast_to(linear(FIXED), (2, 3))
            parts.append(_tube(ends, cylinder.radius * both, grey, 40))
        for arrows, vectors in zip(replay.arrows, self.arrows, strict=True):
            parts += self._arrows(arrows.origins[frame], vectors[frame], arrows.colour)
        if not parts:
            return Triangles(*np.zeros((3, 0, 3, 3)))
        return Triangles(*(np.concatenate(some) for some in zip(*parts, strict=True)))

    def _levels(self, values: np.ndarray, colour: np.ndarray) -> np.ndarray:
        low, high = self.range
        known = np.isfinite(values)
        levels = (np.where(known, values, low) - low) / (high - low)
        return np.where(known[:, None], ramp(levels), colour)

    def _tube(
        self, nodes: np.ndarray, radii: np.ndarray, colour: np.ndarray
    ) -> Triangles:
        fine = refined(np.concatenate([nodes, radii[:, None], colour], 1), self.along)
        return _tube(fine[:, :3], fine[:, 3], fine[:, 4:], self.sides)

    def _arrows(
        self, origins: np.ndarray, vectors: np.ndarray, name: str
    ) -> list[Triangles]:
        parts = []
        for start, way in zip(origins, vectors, strict=True):
            length = float(np.linalg.norm(way))
            if not length:
                continue
            thick = 0.0035 * self.size
            head = min(5 * thick, 0.6 * length)
            marks = np.array([0, length - head, length - head, length])
            nodes = start + marks[:, None] * way / length
            radii = np.array([thick, thick, 2.4 * thick, 1e-3 * thick])
            colour = np.broadcast_to(linear(name), (4, 3))
            parts.append(_tube(nodes, radii, colour, 14, way / length))
        return parts


@cache
def _unit_ball() -> tuple[np.ndarray, np.ndarray]:
    return shaded(Mesh(*surfaces.ball(1.0)))


def _alike(corners: np.ndarray, normals: np.ndarray, colour: str) -> Triangles:
    return Triangles(corners, normals, np.broadcast_to(linear(colour), corners.shape))


def refined(nodes: np.ndarray, pieces: int) -> np.ndarray:
    """Inserts rows between those of the nodes, for a smooth curve.

    Positions follow a Catmull-Rom curve; other columns are interpolated linearly.

    Args:
        nodes: Rows of x, y, z [m] and k other numbers, (n+1, 3+k).
        pieces: Number of pieces per element; the result has n pieces + 1 rows.
    """
    if pieces == 1:
        return nodes
    before, after = nodes[:-1], nodes[1:]
    if len(nodes) > 2:
        first = 3 * nodes[:1] - 3 * nodes[1:2] + nodes[2:3]
        last = 3 * nodes[-1:] - 3 * nodes[-2:-1] + nodes[-3:-2]
    else:
        first, last = 2 * nodes[:1] - nodes[1:], 2 * nodes[1:] - nodes[:1]
    p0, p3 = np.concatenate([first, nodes[:-2]]), np.concatenate([nodes[2:], last])
    u = (np.arange(pieces) / pieces)[None, :, None]
    b = 0.5 * (after - p0)
    c = p0 - 2.5 * before + 2 * after - 0.5 * p3
    d = 1.5 * (before - after) + 0.5 * (p3 - p0)
    a, b, c, d, end = (x[:, None] for x in (before, b, c, d, after))
    curved = a + u * (b + u * (c + u * d))
    straight = a + u * (end - a)
    whole = np.concatenate([curved[..., :3], straight[..., 3:]], axis=-1)
    return np.concatenate([whole.reshape(-1, nodes.shape[1]), nodes[-1:]])


def _tube(
    nodes: np.ndarray,
    radii: np.ndarray,
    colours: np.ndarray,
    sides: int,
    direction: np.ndarray | None = None,
) -> Triangles:
    """Triangles of a tube around a line of nodes, closed by flat ends.

    Args:
        nodes: Points on the axis of the tube [m], (n, 3).
        radii: Radius at each node [m].
        colours: Linear red, green and blue at each node, (n, 3).
        sides: Number of sides of the tube's polygonal section.
        direction: Axis of a straight tube; by default it follows the nodes.
    """
    if direction is None:
        tangents = np.gradient(nodes, axis=0)
        size = np.linalg.norm(tangents, axis=1, keepdims=True)
        tangents = np.where(size > 0, tangents / np.maximum(size, 1e-300), [0, 0, 1.0])
    else:
        tangents = np.broadcast_to(direction, nodes.shape)
    # Carries one normal along the line without rotating it about the tangent.
    normal = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    across = np.empty_like(nodes)
    for node, tangent in enumerate(tangents):
        normal = normal - (normal @ tangent) * tangent
        normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
        across[node] = normal
    other = np.cross(tangents, across)
    angle = 2 * np.pi * np.arange(sides)[:, None] / sides
    outward = np.cos(angle) * across[:, None] + np.sin(angle) * other[:, None]
    rings = nodes[:, None] + radii[:, None, None] * outward
    i, j = np.arange(len(nodes) - 1)[:, None], np.arange(sides)[None]
    k = (j + 1) % sides
    quads = [(i, j), (i, k), (i + 1, k), (i, j), (i + 1, k), (i + 1, j)]
    pick = lambda table: np.stack([table[quad] for quad in quads], axis=2)
    corners = pick(rings).reshape(-1, 3, 3)
    normals = pick(outward).reshape(-1, 3, 3)
    shade = pick(np.broadcast_to(colours[:, None], rings.shape)).reshape(-1, 3, 3)
    parts = [Triangles(corners, normals, shade)]
    for end, sign in ((0, -1), (-1, 1)):
        disc = np.stack(
            [np.broadcast_to(nodes[end], (sides, 3)), rings[end], rings[end][k[0]]], 1
        )
        away = np.broadcast_to(sign * tangents[end], disc.shape)
        parts.append(Triangles(disc, away, np.broadcast_to(colours[end], disc.shape)))
    return Triangles(*(np.concatenate(some) for some in zip(*parts, strict=True)))
