"""Rendering of a frame: camera, shadows, shading, the ground, and front triangles.

A rasteriser in NumPy finds the front triangle at each pixel.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxrod.viz.colours import linear
from jaxrod.viz.geometry import Triangles

_LENS = np.tan(np.radians(14.0))
"""Tangent of half the vertical angle of view, which is 28 degrees [1]."""
_TAPS = 16
"""Number of samples of the shadow map per point, for soft edges of shadows."""
_SKY, _GROUND = linear("#f8fafc"), linear("#dfe5ee")
_GRID = linear("#8b98ab")
_SHADE = np.array([0.95, 0.88, 0.74], np.float32)
"""Twice the fraction of red, green and blue light that a full shadow removes from the
ground [1]."""


@dataclasses.dataclass(frozen=True)
class View:
    """Camera: its position `eye` [m], and unit vectors `right`, `above` and `backward`.

    All are in the world frame. The camera looks along -`backward`.
    """

    right: np.ndarray
    above: np.ndarray
    backward: np.ndarray
    eye: np.ndarray
    up: int
    """Index of the upward axis, 0 to 2."""

    @property
    def frame(self) -> np.ndarray:
        """Rotation matrix from the world to camera axes: right, above, backward."""
        return np.stack([self.right, self.above, self.backward])

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Coordinates of points to the right, above and in front of the camera [m]."""
        own = (points - self.eye) @ self.frame.T
        return own * np.array([1, 1, -1])

    @property
    def lamp(self) -> np.ndarray:
        """Unit vector towards the lamp, which is over the camera's left shoulder."""
        up = np.eye(3)[self.up]
        way = 0.95 * up - 0.5 * self.right + 0.42 * self.backward
        return way / np.linalg.norm(way)


def view_of(
    points: np.ndarray,
    up: int,
    azimuth: float,
    elevation: float,
    shape: tuple[float, float],
    zoom: float,
) -> View:
    """Computes the camera whose picture contains all points, as large as possible.

    Args:
        points: Points to contain [m], (N, 3).
        up: Index of the upward axis.
        azimuth: Angle around the upward axis [degrees].
        elevation: Angle above the ground [degrees].
        shape: Usable width and height of the picture, in picture heights [1].
        zoom: Zoom factor; above one, closer.
    """
    a, e = np.radians([azimuth, elevation])
    axes = np.roll(np.eye(3), -(up + 1), axis=0)  # first x second = up
    level = np.cos(a) * axes[0] + np.sin(a) * axes[1]
    backward = np.cos(e) * level + np.sin(e) * axes[2]
    right = np.cross(axes[2], level)
    above = np.cross(backward, right)
    frame = np.stack([right, above, backward])
    own = points @ frame.T
    wide, tall = _LENS * np.array(shape)
    low, high = own.min(axis=0), own.max(axis=0)
    middle = (low + high) / 2
    # Nearer parts look larger: a few iterations centre the picture.
    for _ in range(6):
        x, y, z = (own - middle).T
        distance = np.max(z + np.maximum(np.abs(x) / wide, np.abs(y) / tall)) + 1e-9
        far = np.maximum(distance - z, 1e-9)
        for axis, part in ((0, x), (1, y)):
            shift = ((part / far).max() + (part / far).min()) / 2 * distance
            middle[axis] += 0.8 * shift
    distance /= zoom
    eye = (middle + np.array([0, 0, distance])) @ frame
    return View(right, above, backward, eye, up)


def rendered(triangles: Triangles, ground: Ground, fine: int) -> np.ndarray:
    """Renders a picture in linear red, green and blue, (height, width, 3).

    Args:
        triangles: Triangles of the scene.
        ground: Ground and sky behind the triangles, with the camera's view.
        fine: 2 draws solids at twice the size and averages, which smooths their edges
            and darkens crevices; 1 does not, and takes a third of the time.
    """
    (width, height), view = ground.size, ground.view
    lamp = _Lamp(triangles.corners, view, int((0.6 if fine == 1 else 1.4) * width))
    picture = ground.light(lamp)
    if fine == 2:
        picture = np.repeat(np.repeat(picture, 2, axis=0), 2, axis=1)
    width, height = fine * width, fine * height
    picture = picture.reshape(-1, 3)
    screen = _on_screen(view, triangles.corners, (width, height))
    front, depth = nearest(screen, width, height)
    drawn = np.flatnonzero(front >= 0)
    y, x = np.divmod(drawn, width)
    spots = np.stack([x, y], axis=-1)
    falling = _rays(spots, (width, height)) @ view.frame[:, view.up]
    above = -1 / depth[drawn] <= _ground_distance(view, ground.floor, falling)
    drawn, spots = drawn[above], spots[above]
    if drawn.size:
        light = _lit(triangles, screen, front[drawn], spots, view, lamp)
        if fine == 2:
            near = np.full(len(picture), np.nan, np.float32)
            near[drawn] = depth[drawn]
            dark = _crevices(near.reshape(height, width)[::2, ::2])
            light *= dark[spots[:, 1] // 2, spots[:, 0] // 2, None]
        picture[drawn] = light
    picture = picture.reshape(height, width, 3)
    if fine == 1:
        return picture
    return picture.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))


def _on_screen(view: View, corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Projects corners (M, 3, 3) to pixels, and a depth -1/distance [1/m].

    x is to the right and y down, from the upper left corner of the picture, whose width
    and height [pixels] are `size`. The distance is along the camera's axis. A triangle
    with a corner behind the camera is NaN.
    """
    width, height = size
    focal = 0.5 * height / _LENS
    right, above, ahead = np.moveaxis(view.seen(corners), -1, 0)
    behind = np.any(ahead <= 1e-9, axis=1)
    ahead = np.where(ahead <= 1e-9, 1, ahead)
    x, y = 0.5 * width + focal * right / ahead, 0.5 * height - focal * above / ahead
    screen = np.stack([x, y, -1 / ahead], axis=-1)
    screen[behind] = np.nan
    return screen


def _rays(spots: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Directions of the rays through the centres of pixels, scaled to z = -1, (N, 3).

    `spots` are the pixels' indices x and y (N, 2), from the upper left corner. `size`
    is the width and height of the picture [pixels]. Rays are in camera axes (right,
    above, backward). The vertical angle of view is that of `_LENS`.
    """
    width, height = size
    focal = 0.5 * height / _LENS
    x, y = np.asarray(spots, np.float32).T
    x, y = (x + 0.5 - width / 2) / focal, (height / 2 - y - 0.5) / focal
    return np.stack([x, y, -np.ones_like(x)], axis=-1)


def _ground_distance(view: View, floor: float, rays: np.ndarray) -> np.ndarray:
    """Distance along the camera's axis at which rays hit the ground at `floor` [m].

    It is infinite for rays that miss the ground. `rays` are the upward components of
    the rays, per unit of distance along the camera's axis.
    """
    with np.errstate(divide="ignore"):
        away = (floor - view.eye[view.up]) / rays
    return np.where(away > 0, away, np.inf)


class Ground:
    """Background of the pictures: sky, and ground with grid lines.

    It is drawn once. Only the shadows on it change between frames.
    """

    def __init__(
        self,
        view: View,
        floor: float,
        step: float,
        size: tuple[int, int],
        centre: np.ndarray,
        span: float,
    ) -> None:
        """Draws the ground and the sky without shadows.

        Args:
            view: View of the camera.
            floor: Height of the ground [m].
            step: Distance between the lines on it [m].
            size: Width and height of the picture [pixels].
            centre: Point around which the lines are clearest [m], (3,).
            span: Size of the region with lines [m].
        """
        self.view, self.floor, self.size = view, floor, size
        width, height = size
        share = (np.linspace(0, 1, height) ** 1.2).astype(np.float32)[:, None, None]
        sky = np.broadcast_to(_SKY * (1 - share) + _GROUND * share, (height, width, 3))
        self.picture = sky.reshape(-1, 3).astype(np.float32)
        y, x = np.divmod(np.arange(width * height), width)
        rays = _rays(np.stack([x, y], axis=-1), size) @ view.frame.astype(np.float32)
        away = _ground_distance(view, floor, rays[:, view.up])
        self.seen = np.flatnonzero(np.isfinite(away))
        away = away[self.seen, None]
        self.places = (view.eye + away * rays[self.seen]).astype(np.float32)
        axes = [k for k in range(3) if k != view.up]
        flat, pixel = self.places[:, axes], away[:, 0] * 2 * _LENS / height
        reach = np.linalg.norm(flat - centre[axes], axis=1) / (1.1 * span)
        strength = np.zeros(len(flat))
        for spacing, weight in ((step / 5, 0.20), (step, 0.42)):
            off = np.abs(flat / spacing - np.rint(flat / spacing))
            thick = np.maximum(1.1 * pixel / spacing, 0.004)[:, None]
            line = np.clip(1 - off / thick, 0, 1).max(axis=1)
            fine = np.clip(spacing / (6 * pixel) - 0.5, 0, 1)
            strength = np.maximum(strength, weight * line * fine)
        strength = (strength * np.clip(1.6 - reach, 0, 1))[:, None]
        self.picture[self.seen] += strength * (_GRID - self.picture[self.seen])

    def light(self, lamp: _Lamp) -> np.ndarray:
        """Background with the shadows of a lamp: linear red, green and blue.

        The result is (height, width, 3).
        """
        picture = self.picture.copy()
        dark = 0.50 * (1 - lamp.reaches(self.places, 0.012 * lamp.span))
        some = np.flatnonzero(dark)
        picture[self.seen[some]] *= 1 - dark[some, None] * _SHADE
        return picture.reshape(self.size[1], self.size[0], 3)


class _Lamp:
    """Shadow map: for rays of a parallel lamp, the depth of the first surface."""

    def __init__(self, corners: np.ndarray, view: View, side: int) -> None:
        """Computes a map of `side` times `side` pixels from the triangles' corners.

        Light falls from the direction `view.lamp`.
        """
        lamp = view.lamp
        first = np.cross(lamp, np.eye(3)[np.argmin(np.abs(lamp))])
        first /= np.linalg.norm(first)
        self.frame = np.stack([first, np.cross(lamp, first), lamp])
        own = corners @ self.frame.T
        flat = own.reshape(-1, 3) if len(corners) else np.zeros((1, 3))
        self.low = flat.min(axis=0)
        span = float(np.max(np.ptp(flat, axis=0)[:2])) or 1.0
        self.side = side
        self.scale = 0.86 * side / span
        map_corners = np.concatenate(
            [(own[..., :2] - self.low[:2]) * self.scale + 0.07 * side, -own[..., 2:]],
            axis=-1,
        )
        _, self.depth = nearest(map_corners, side, side)
        self.span = span

    def reaches(self, places: np.ndarray, blur: float) -> np.ndarray:
        """Fraction of the lamp's light that reaches points, from 0 (shadow) to 1.

        The points are the rows of `places` (N, 3), world frame [m]. The edges of
        shadows are soft, over a width of `blur` [m].
        """
        own = places @ self.frame.T.astype(places.dtype)
        spots = (own[:, :2] - self.low[:2]) * self.scale + 0.07 * self.side
        reach = blur * self.scale
        light = np.ones(len(places), np.float32)
        mapped = np.flatnonzero(
            np.all((spots > reach) & (spots < self.side - reach), 1)
        )
        spots = spots[mapped].astype(np.float32)
        deep = (-own[mapped, 2] - 2.5 / self.scale).astype(np.float32)
        angles = 2.39996 * np.arange(_TAPS)
        away = reach * np.sqrt((np.arange(_TAPS) + 0.5) / _TAPS)
        lit = np.zeros(len(mapped), np.float32)
        for dx, dy in zip(away * np.cos(angles), away * np.sin(angles), strict=True):
            x = np.minimum(
                (spots[:, 0] + np.float32(dx)).astype(np.int32), self.side - 1
            )
            y = np.minimum(
                (spots[:, 1] + np.float32(dy)).astype(np.int32), self.side - 1
            )
            lit += self.depth[y * self.side + x] >= deep
        light[mapped] = lit / _TAPS
        return light


def _lit(
    triangles: Triangles,
    screen: np.ndarray,
    front: np.ndarray,
    pixels: np.ndarray,
    view: View,
    lamp: _Lamp,
) -> np.ndarray:
    shares = shares_at(screen[front], pixels + 0.5)
    # Linear on the screen is not linear in space: weights by inverse distance.
    shares = shares * -screen[front][:, :, 2]
    shares = (shares / shares.sum(axis=1, keepdims=True))[..., None]
    blend = lambda table: np.sum(table[front] * shares, axis=1)
    place, normal = blend(triangles.corners), blend(triangles.normals)
    base = blend(triangles.colours)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    towards = view.eye - place
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = np.sum(normal * towards, axis=1)
    normal = np.where(facing[:, None] < 0, -normal, normal)
    facing = np.abs(facing)
    half = towards + view.lamp
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    reach = lamp.reaches(place + normal * (3 / lamp.scale), 0.004 * lamp.span)
    sky = (0.5 + 0.5 * normal[:, view.up])[:, None]
    key = 0.66 * (np.clip(normal @ view.lamp, 0, 1) * reach)[:, None]
    gloss = 0.20 * (np.clip(np.sum(normal * half, axis=1), 0, 1) ** 42 * reach)[:, None]
    rim = 0.10 * ((1 - facing) ** 3)[:, None] * sky
    glow = np.array([0.22, 0.23, 0.27]) * (1 - sky) + np.array([0.44, 0.46, 0.50]) * sky
    return base * (glow + key) + gloss + rim


def _crevices(near: np.ndarray) -> np.ndarray:
    """Factor on the light of each pixel: below 1 where its surroundings are nearer.

    This darkens crevices, by at most 40 %.

    Args:
        near: Depth of each pixel, smaller in front; NaN where there is no surface.
    """
    reach = max(2, near.shape[0] // 70)
    there = np.isfinite(near)
    depth = np.where(there, near, 0)
    share = _blurred(_blurred(there.astype(float), reach), reach)
    around = _blurred(_blurred(depth, reach), reach) / np.maximum(share, 1e-3)
    scale = max(float(np.ptp(near[there])), 1e-12)
    return 1 - 0.40 * np.clip((depth - around) / (0.10 * scale), 0, 1)


def _blurred(values: np.ndarray, reach: int) -> np.ndarray:
    """Blurs an image: mean over the square of 2 reach + 1 pixels around each pixel."""
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (reach + 1, reach)
        total = np.cumsum(np.pad(values, pad, mode="edge"), axis=axis)
        side = 2 * reach + 1
        ends = [slice(None), slice(None)]
        starts = [slice(None), slice(None)]
        ends[axis], starts[axis] = slice(side, None), slice(None, -side)
        values = (total[tuple(ends)] - total[tuple(starts)]) / side
    return values


_AT_ONCE = 3_000_000
"""Largest number of pairs of triangle and pixel that are tested as one batch."""


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

    P is the point (x, y); a, b and c are a triangle's corners. The first two areas
    divided by the third are the barycentric coordinates of P with respect to a and b.
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
    """Barycentric coordinates of one point in each triangle [1].

    Row i of `places` is the point (x, y) of the triangle `corners[i]` in the picture.
    The coordinates are the weights of the triangle's three corners.
    """
    u, v, area = (
        part[:, 0, 0]
        for part in _shares(
            corners, places[:, :1, None].astype(np.float32), places[:, 1:, None]
        )
    )
    area = np.where(np.abs(area) > 1e-20, area, 1)
    return np.stack([u / area, v / area, 1 - (u + v) / area], axis=-1)
