r"""Markers on a rod, in world coordinates or in camera images, and depth images.

The frame of a pin-hole camera has x to the right, y down and z forward. A point
$(X, Y, Z)$ in this frame [m] has the image, with focal length $f$ and principal point
$c$ [pixels],

$$u = c_1 + f X/Z, \qquad v = c_2 + f Y/Z.$$

A depth image has at each pixel the depth $Z$ of the nearest point of the rod on the ray
through the pixel's centre. The rod is the union of capsules: an element is a cylinder
with a hemisphere at each end.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import module_for, quaternions, unit_vector
from jaxrod.geometry.rotations import (
    directors,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.motion import motion_of
from jaxrod.rods.rod import RodState
from jaxrod.sensors.sensor import (
    Sensor,
    StationSensor,
    as_offsets,
    as_stations,
    in_section,
    stations_of,
)
from jaxrod.structure import pytree, static
from jaxrod.validation import (
    Numbers,
    as_array,
    check_array,
    check_count,
    check_kind,
)

MOST_PIXELS = 10_000
"""Largest number of rows and columns of an image; more are rejected as a mistake."""
_LEAST_ANGLE = 1e-3
"""Smallest angle between the optical axis and the direction `up` [rad]."""


@pytree
class Camera:
    """Pin-hole camera without distortion, made by `camera`.

    Example:
        >>> eye = sensors.camera(
        ...     position=(0.5, -2.0, 0.0),
        ...     target=(0.5, 0.0, 0.0),
        ...     focal_length=600.0,
        ...     principal_point=(320.0, 240.0),
        ... )
        >>> ends = jnp.stack([state.positions[:, 0], state.tip], axis=1)
        >>> print(eye.project(ends).round(2))  # from the left and from the top [pixels]
        [[170. 470.]
         [240. 240.]]
    """

    position: Float[Array, "3"]
    """Position of the pin-hole, world frame [m]."""
    orientation: Float[Array, "4"]
    """Unit quaternion (w, x, y, z), camera to world."""
    focal_length: Float[Array, ""]
    """Focal length [pixels]."""
    principal_point: Float[Array, "2"]
    """Image of the optical axis, from the left and from the top [pixels]."""

    def project(self, points: Float[Array, "3 *k"]) -> Float[Array, "2 *k"]:
        """Image coordinates (from left, from top) of world points [pixels].

        They are NaN, with zero derivatives, for points that are not in front of the
        camera. Points may lie outside the image.

        Args:
            points: Points, world frame [m].
        """
        x, y, depth = seen = self._seen(points)
        ahead = _is_ahead(seen)
        scale = self.focal_length / jnp.where(ahead, depth, 1)
        image = jnp.stack([scale * x, scale * y])
        centre = self.principal_point.reshape(2, *(1 for _ in depth.shape))
        return jnp.where(ahead, centre + image, jnp.nan)

    def in_front(self, points: Float[Array, "3 *k"]) -> Bool[Array, "*k"]:
        """Whether points, world frame [m], are in front of the camera."""
        return _is_ahead(self._seen(points))

    def rays(self, rows: int, columns: int) -> Vec3:
        """Vectors along the rays through the centres of pixels, world frame [1].

        Their component along the optical axis is 1. Each array is `(rows, columns)`.
        """
        dtype = self.focal_length.dtype
        u = jnp.arange(columns, dtype=dtype) + 0.5 - self.principal_point[0]
        v = jnp.arange(rows, dtype=dtype) + 0.5 - self.principal_point[1]
        x, y = jnp.meshgrid(u / self.focal_length, v / self.focal_length)
        return to_world(self._axes, (x, y, jnp.ones_like(x)))

    def _seen(self, points: Array) -> Vec3:
        """Converts points from the world frame to the camera's frame [m]."""
        apart = vectors.subtract(vectors.split(points), vectors.split(self.position))
        return to_material(self._axes, apart)

    @property
    def _axes(self) -> tuple[Vec3, Vec3, Vec3]:
        return directors(split_quaternion(self.orientation))


def _is_ahead(seen: Vec3) -> Array:
    """Whether points in the camera's frame are in front of it, beyond round-off."""
    x, y, depth = seen
    return depth > 1e-6 * (jnp.abs(x) + jnp.abs(y))


@pytree
class Markers(StationSensor):
    """Sensor of world positions of points fixed to a rod, made by `markers`.

    Example:
        >>> balls = sensors.markers([0.5, 1.0])
        >>> balls.shape(scene), balls.unit
        ((3, 2), 'm')
    """

    unit: ClassVar[str] = "m"
    offsets: Float[Array, "2 _"] | Float[Array, "3 _"]
    """Offsets of the markers along d1, d2 and, if any, d3 [m]."""
    name: str = static(default="markers")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Positions of the markers: centreline plus offset, world frame [m]."""
        motion = motion_of(state)
        stations = stations_of(scene.rod, self.arc_length)
        centre = stations.nodes.of_vectors(motion.position)
        frame = directors(stations.orientation(motion))
        arm = to_world(frame, in_section(self.offsets, centre[0]))
        return self.placed(vectors.add(centre, arm))


@pytree
class ImageMarkers(Sensor):
    """Sensor of image coordinates of points fixed to a rod, made by `image_markers`.

    Example:
        >>> eye = sensors.camera(
        ...     position=(0.5, -2.0, 0.0),
        ...     target=(0.5, 0.0, 0.0),
        ...     focal_length=600.0,
        ...     principal_point=(320.0, 240.0),
        ... )
        >>> dots = sensors.image_markers(eye, [0.25, 0.5, 0.75, 1.0])
        >>> dots.shape(scene), dots.unit
        ((2, 4), 'pixel')
    """

    unit: ClassVar[str] = "pixel"
    camera: Camera
    """Camera that takes the image."""
    markers: Markers
    """Markers on the rod."""
    name: str = static(default="image markers")

    def check(self, scene: LoadedRod) -> None:
        """Raises a ValueError if a marker is beyond the rod's end, unless traced."""
        self.markers.check(scene)

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "2 *k"]:
        """Image coordinates (from left, from top) [pixels]; NaN behind the camera."""
        return self.camera.project(self.markers.measure(scene, state))


@pytree
class DepthImage(Sensor):
    """Sensor of the depth of the rod's surface at each pixel, made by `depth_image`.

    Example:
        >>> eye = sensors.camera(
        ...     position=(0.5, -1.0, 0.0),
        ...     target=(0.5, 0.0, 0.0),
        ...     focal_length=60.0,
        ...     principal_point=(32.0, 24.0),
        ... )
        >>> image = sensors.depth_image(eye, rows=48, columns=64)
        >>> image.shape(scene), image.unit
        ((48, 64), 'm')
    """

    unit: ClassVar[str] = "m"
    camera: Camera
    """Camera that takes the image."""
    max_range: Float[Array, ""] | None = None
    """Largest depth, also the reading at pixels without rod [m]; infinite if `None`."""
    rows: int = static(default=48)
    """Height of the image [pixels]."""
    columns: int = static(default=64)
    """Width of the image [pixels]."""
    name: str = static(default="depth image")

    def measure(
        self, scene: LoadedRod, state: RodState
    ) -> Float[Array, "rows columns"]:
        """Depth Z of the nearest point of the rod at each pixel [m]."""
        motion = motion_of(state)
        nodes = vectors.subtract(motion.position, vectors.split(self.camera.position))
        rays = self.camera.rays(self.rows, self.columns)
        depth = _nearest(rays, nodes, motion.edges, scene.rod.radii)
        return depth if self.max_range is None else jnp.minimum(depth, self.max_range)


def _nearest(rays: Vec3, nodes: Vec3, axes: Vec3, radii: Array) -> Array:
    """Smallest factor of each ray vector at which it enters a capsule, else infinity.

    Args:
        rays: Vectors of the rays from the origin, each component `(h, w)`.
        nodes: Ends of the axes of the capsules `(n + 1,)`.
        axes: Vectors from one end of each axis to the other `(n,)`.
        radii: Radii of the capsules `(n,)`.
    """
    a, b, c = (part[:, :, None] for part in rays)
    x, y, z = (part[None, None, :] for part in nodes)
    u, v, w = (part[None, None, :] for part in axes)
    ray, axis, start = (a, b, c), (u, v, w), (x[..., :-1], y[..., :-1], z[..., :-1])
    wide = radii[None, None, :]
    square = vectors.dot(axis, axis)

    def across(vector: Vec3) -> Vec3:
        """Component of a vector perpendicular to the axis of each capsule."""
        along = vectors.dot(vector, axis) / square
        return vectors.subtract(vector, vectors.scale(along, axis))

    entry, hit = _entry(across(ray), across(start), wide)
    there = vectors.subtract(vectors.scale(entry, ray), start)
    along = vectors.dot(there, axis)
    hit = hit & (along >= 0) & (along <= square)
    depth = jnp.min(jnp.where(hit, entry, jnp.inf), axis=-1)
    # The sphere at a node has the larger radius of its two elements.
    wide = jnp.pad(wide, ((0, 0), (0, 0), (1, 1)), mode="edge")
    entry, hit = _entry(ray, (x, y, z), jnp.maximum(wide[..., 1:], wide[..., :-1]))
    return jnp.minimum(depth, jnp.min(jnp.where(hit, entry, jnp.inf), axis=-1))


def _entry(ray: Vec3, centre: Vec3, radius: Array) -> tuple[Array, Array]:
    """Factor of a ray vector at which it enters a sphere, and whether it does.

    The sphere has a `centre` and a `radius`. The ray begins at the origin of `centre`.
    With `ray` and `centre` projected perpendicular to an axis, the sphere is a cylinder
    around this axis.
    """
    square = vectors.dot(ray, ray)
    # A ray along the axis never enters through the side.
    crossing = square > jnp.finfo(square.dtype).eps * 1e-3
    safe = jnp.where(crossing, square, 1)
    middle = vectors.dot(ray, centre) / safe
    miss = vectors.subtract(centre, vectors.scale(middle, ray))
    inside = (radius * radius - vectors.dot(miss, miss)) / safe
    hit = crossing & (inside > 0)
    entry = middle - jnp.sqrt(jnp.where(hit, inside, 1))
    hit = hit & (entry > 0)
    return jnp.where(hit, entry, 0), hit


def camera(
    position: Numbers,
    target: Numbers,
    *,
    focal_length: Numbers,
    principal_point: Numbers,
    up: Numbers = (0.0, 0.0, 1.0),
) -> Camera:
    """Makes a pin-hole camera that looks at a point.

    Args:
        position: Position of the pin-hole, world frame `(3,)` [m].
        target: Point on the optical axis, world frame `(3,)` [m].
        focal_length: Focal length, above 0 [pixels].
        principal_point: Image of the optical axis, from the left and from the top
            `(2,)` [pixels]; usually half the width and half the height. The centre of
            the first pixel is at (0.5, 0.5).
        up: Direction that is up in the image, of any length `(3,)`.

    Raises:
        ValueError: If a number is out of range, the target is at the position, or `up`
            is along the optical axis.

    Example:
        >>> eye = sensors.camera(
        ...     position=(0.5, -2.0, 0.0),
        ...     target=(0.5, 0.0, 0.0),
        ...     focal_length=600.0,
        ...     principal_point=(320.0, 240.0),
        ... )
        >>> print(eye.project(state.tip).round(2))  # right of the middle [pixels]
        [470. 240.]
    """
    here = check_array("position", position, [(3,)], "m")
    aim = check_array("target", target, [(3,)], "m")
    forward = unit_vector("the way from position to target", aim - here)
    upwards = unit_vector("up", up)
    xp = module_for(forward, upwards)
    across = xp.cross(forward, upwards)
    size = xp.sqrt(xp.sum(across**2))
    if xp is np and size < _LEAST_ANGLE:
        raise ValueError("up must not be parallel to the optical axis")
    right = across / size
    axes = xp.stack([right, xp.cross(forward, right), forward])
    orientation = quaternions(axes[:, :, None])[:, 0]
    return Camera(
        position=as_array("position", here, "m", [(3,)]),
        orientation=jnp.asarray(orientation, jnp.result_type(float)),
        focal_length=as_array("focal_length", focal_length, "pixels", positive=True),
        principal_point=as_array("principal_point", principal_point, "pixels", [(2,)]),
    )


def markers(arc_length: Numbers, offsets: Numbers = (0.0, 0.0)) -> Markers:
    """Makes markers: points fixed to sections of a rod, as in motion capture.

    Args:
        arc_length: Arc length of the station in the unstressed rod, one number or
            `(k,)` [m].
        offsets: Offset from the centreline along d1 and d2 `(2,)`, or also along d3
            `(3,)`, or one per station `(k, 2)` or `(k, 3)` [m].

    Returns:
        A sensor that reads three coordinates per station, world frame [m].

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> flag = sensors.markers(1.0, (0.0, 0.0, 0.25))  # 25 cm beyond the tip
        >>> print(flag.read(scene, state).round(3))
        [1.25 0.   0.  ]
    """
    stations = as_stations(arc_length)
    return Markers(stations, as_offsets(offsets, stations, (2, 3)))


def image_markers(
    camera: Camera, arc_length: Numbers, offsets: Numbers = (0.0, 0.0)
) -> ImageMarkers:
    """Makes a sensor of the images of markers: points fixed to a rod, seen by a camera.

    Markers are never hidden, even behind the rod.

    Args:
        camera: The camera.
        arc_length: Arc length of the station in the unstressed rod, one number or
            `(k,)` [m].
        offsets: Offsets from the centreline, as for `markers` [m].

    Returns:
        A sensor that reads two coordinates per station, from the left and from the top
        [pixels]; NaN for markers that are not in front of the camera.

    Raises:
        ValueError: If a number is out of range or of the wrong shape.
        TypeError: If `camera` is not a `Camera`.

    Example:
        >>> eye = sensors.camera(
        ...     position=(0.5, -2.0, 0.0),
        ...     target=(0.5, 0.0, 0.0),
        ...     focal_length=600.0,
        ...     principal_point=(320.0, 240.0),
        ... )
        >>> print(sensors.image_markers(eye, [0.5, 1.0]).read(scene, state).round(2))
        [[320. 470.]
         [240. 240.]]
    """
    check_kind("camera", camera, Camera)
    return ImageMarkers(camera, markers(arc_length, offsets))


def depth_image(
    camera: Camera, rows: int, columns: int, *, max_range: Numbers | None = None
) -> DepthImage:
    """Makes a depth image of a rod: distances along the optical axis, by ray casting.

    It is differentiable with respect to the state and the camera, except at the rod's
    outline, where depth jumps. The camera must be outside the rod. Obstacles and other
    rods do not appear.

    Args:
        camera: The camera.
        rows: Height of the image [pixels].
        columns: Width of the image [pixels].
        max_range: Largest depth, above 0, also the reading at pixels without rod [m];
            infinite by default.

    Returns:
        A sensor that reads `(rows, columns)` depths [m].

    Raises:
        ValueError: If a number is out of range.
        TypeError: If `camera` is not a `Camera`.

    Example:
        >>> eye = sensors.camera(
        ...     position=(0.5, -1.0, 0.0),
        ...     target=(0.5, 0.0, 0.0),
        ...     focal_length=60.0,
        ...     principal_point=(32.5, 24.5),
        ... )
        >>> image = sensors.depth_image(eye, rows=48, columns=64, max_range=3.0)
        >>> depth = image.read(scene, state)
        >>> round(float(depth[24, 32]), 3), float(depth[0, 0])  # its surface, nothing
        (0.98, 3.0)
    """
    check_kind("camera", camera, Camera)
    most = None
    if max_range is not None:
        most = as_array("max_range", max_range, "m", positive=True)
    return DepthImage(
        camera,
        most,
        check_count("rows", rows, 1, MOST_PIXELS),
        check_count("columns", columns, 1, MOST_PIXELS),
    )
