"""Closed surfaces of triangles with known distances."""

import numpy as np


def torus(radius=0.15, thickness=0.05, along=100, around=50):
    """A ring about the z axis, of twice `along * around` triangles."""
    a = 2 * np.pi * np.arange(along) / along
    b = 2 * np.pi * np.arange(around) / around
    a, b = np.meshgrid(a, b, indexing="ij")
    out = radius + thickness * np.cos(b)
    corners = [out * np.cos(a), out * np.sin(a), thickness * np.sin(b)]
    return np.stack(corners, axis=-1).reshape(-1, 3), net(along, around)


def net(along, around):
    """Triangles between the corners of a net that is closed in both directions."""
    i, j = np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    at = lambda p, q: ((i + p) % along * around + (j + q) % around).ravel()
    one = np.stack([at(0, 0), at(1, 0), at(1, 1)], axis=-1)
    two = np.stack([at(0, 0), at(1, 1), at(0, 1)], axis=-1)
    return np.concatenate([one, two])


def from_torus(points, radius=0.15, thickness=0.05):
    """Distances of points `(3, n)` from the smooth ring, and normals there."""
    x, y, z = points
    axis = np.hypot(x, y)
    out = axis - radius
    apart = np.hypot(out, z)
    normal = np.stack([out * x / axis, out * y / axis, z]) / apart
    return apart - thickness, normal


def from_box(points, half_lengths):
    """Distances of points `(3, n)` from a block around the origin."""
    beyond = np.abs(points) - np.asarray(half_lengths)[:, None]
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=0)
    return outside + np.minimum(beyond.max(axis=0), 0)
