"""Rasteriser in NumPy that finds the front triangle at each pixel."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

_AT_ONCE = 3_000_000
"""Largest number of pairs of triangle and pixel that are tested at once."""


def nearest(
    corners: Float[np.ndarray, "m 3 3"], width: int, height: int
) -> tuple[Int[np.ndarray, "pixels"], Float[np.ndarray, "pixels"]]:
    """Finds the triangle nearest to the camera at every pixel.

    Triangles of similar size are tested together, each at all pixels of a square that
    contains the triangle.

    Args:
        corners: Corners of the triangles: x to the right and y down in pixels, and a
            depth that is linear on the screen, smaller in front.
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].

    Returns:
        Index of the triangle, -1 where there is none, and depth, infinite there. Both
        list the pixels row by row.
    """
    depth = np.full(width * height, np.inf, np.float32)
    front = np.full(width * height, -1, np.int32)
    low = np.floor(corners[:, :, :2].min(axis=1)).astype(np.int32)
    high = np.ceil(corners[:, :, :2].max(axis=1)).astype(np.int32)
    seen = np.all(high >= 0, axis=1) & np.all(low < (width, height), axis=1)
    seen &= np.isfinite(corners).all(axis=(1, 2))
    size = (high - low).max(axis=1) + 1
    scale = np.ceil(np.log2(np.maximum(size, 2))).astype(int)
    for k in np.unique(scale[seen]):
        side = 1 << int(k)
        own = np.flatnonzero(seen & (scale == k))
        count = max(1, _AT_ONCE // (side * side))
        for first in range(0, len(own), count):
            some = own[first : first + count]
            _paint(some, corners[some], low[some], side, (width, height), depth, front)
    return front, depth


def _paint(
    numbers: np.ndarray,
    corners: np.ndarray,
    low: np.ndarray,
    side: int,
    size: tuple[int, int],
    depth: np.ndarray,
    front: np.ndarray,
) -> None:
    """Updates `depth` and `front` in place at pixels where these triangles are nearer.

    Args:
        numbers: Indices of the triangles, to write into `front`.
        corners: Their corners, as in `nearest`.
        low: Lower corner of the square of pixels to test for each triangle.
        side: Side of these squares [pixels].
        size: Width and height of the picture [pixels].
        depth: Smallest depth so far at each pixel, row by row.
        front: Index of the nearest triangle so far at each pixel, row by row.
    """
    width, height = size
    steps, half = np.arange(side, dtype=np.float32), np.float32(0.5)
    x, y = (low[:, k : k + 1].astype(np.float32) + steps + half for k in (0, 1))
    x, y = x[:, None, :], y[:, :, None]
    u, v, area = _shares(corners, x, y)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = u / area, v / area
        w = 1 - u - v
        inside = (u >= 0) & (v >= 0) & (w >= 0)
    inside &= (x > 0) & (x < width) & (y > 0) & (y < height)
    which, row, column = np.nonzero(inside)
    z = corners[:, :, 2].astype(np.float32)[which]
    deep = (
        u[which, row, column] * z[:, 0]
        + v[which, row, column] * z[:, 1]
        + w[which, row, column] * z[:, 2]
    )
    pixel = (low[which, 1] + row) * width + low[which, 0] + column
    np.minimum.at(depth, pixel, deep)
    first = deep == depth[pixel]
    front[pixel[first]] = numbers[which[first]]


def _shares(
    corners: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed areas, times 2, of (P, b, c), (P, c, a) and (a, b, c) in the picture.

    P is the point (x, y); a, b and c are a triangle's corners. The first two over the
    third are the barycentric coordinates of P with respect to a and b.
    """
    at = lambda c, axis: corners[:, c, axis].astype(np.float32)[:, None, None]
    ax, ay, bx, by, cx, cy = (at(c, k) for c in range(3) for k in range(2))
    u = (bx - x) * (cy - y) - (cx - x) * (by - y)
    v = (cx - x) * (ay - y) - (ax - x) * (cy - y)
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    return u, v, area


def shares_at(
    corners: Float[np.ndarray, "k 3 3"], places: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k 3"]:
    """Barycentric coordinates of one point in each triangle [1]."""
    u, v, area = (
        part[:, 0, 0]
        for part in _shares(
            corners, places[:, :1, None].astype(np.float32), places[:, 1:, None]
        )
    )
    area = np.where(np.abs(area) > 1e-20, area, 1)
    return np.stack([u / area, v / area, 1 - (u + v) / area], axis=-1)
