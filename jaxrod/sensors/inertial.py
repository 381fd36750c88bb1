r"""Inertial sensors on a rod: accelerometers and gyroscopes.

A sensor at the offset $r$ from the centreline, fixed to a section that turns with the
angular velocity $\omega$, measures the specific force

$$f = a + \dot\omega\times r + \omega\times(\omega\times r) - g$$

in the sensor's frame, with the acceleration $a$ of the centreline and gravity $g$. $a$
and $\dot\omega$ follow from all loads by the equations of motion, not from differences
in time. An element has little rotary inertia, so $\dot\omega$ is large where couples
are not in balance.
"""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.analysis.dynamics import rates_of_change
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.geometry.rotations import (
    directors,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.motion import Motion, motion_of
from jaxrod.rods.rod import RodState
from jaxrod.sensors.sensor import (
    Stations,
    StationSensor,
    as_offsets,
    as_stations,
    in_section,
    stations_of,
)
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers

IDENTITY = (1.0, 0.0, 0.0, 0.0)


class InertialSensor(StationSensor):
    """Base class of accelerometers and gyroscopes, mounted on a section of a rod."""

    def check(self, scene: LoadedRod) -> None:
        """Raises a ValueError unless the scene has the consistent law with twist."""
        super().check(scene)
        if not (scene.method.has_energy and scene.method.twist):
            raise ValueError(
                f"the sensor {self.name!r} needs the consistent law with twist, got "
                f"{scene.method!r}"
            )


@pytree
class Accelerometer(InertialSensor):
    """Sensor of the specific force at stations, made by `accelerometer`.

    Example:
        >>> unit = sensors.accelerometer([0.5, 1.0], (0.0, 0.01))
        >>> unit.shape(scene), unit.unit
        ((3, 2), 'm/s^2')
    """

    unit: ClassVar[str] = "m/s^2"
    offsets: Float[Array, "2 _"]
    """Offsets of the sensors along d1 and d2 [m]."""
    orientation: Float[Array, "4"]
    """Unit quaternion (w, x, y, z) from the sensor's to the section's frame."""
    name: str = static(default="accelerometer")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Acceleration minus gravity at each station, sensor's frame [m/s^2]."""
        rod, motion = scene.rod, motion_of(state)
        stations = stations_of(rod, self.arc_length)
        change = rates_of_change(scene, motion)
        spins, faster = jax.jvp(
            lambda moved: moved.angular_velocities(rod), (motion,), (change,)
        )
        spin = stations.elements.of_vectors(spins)
        frame = directors(stations.orientation(motion))
        arm = to_world(frame, in_section(self.offsets, spin[0]))
        force = stations.nodes.of_vectors(change.velocity)
        turning = stations.elements.of_vectors(faster)
        force = vectors.add(force, vectors.cross(turning, arm))
        inwards = vectors.cross(spin, vectors.cross(spin, arm))
        force = vectors.add(force, inwards)
        for effect in scene.effects:
            field = effect.gravitational_field
            if field is not None:
                force = vectors.subtract(force, vectors.split(field))
        seen = _mounted(self.orientation, stations, motion, force)
        return self.placed(seen)


@pytree
class Gyroscope(InertialSensor):
    """Sensor of the angular velocity at stations, made by `gyroscope`.

    Example:
        >>> gyroscope = sensors.gyroscope([0.5, 1.0])
        >>> gyroscope.shape(scene), gyroscope.unit
        ((3, 2), 'rad/s')
    """

    unit: ClassVar[str] = "rad/s"
    orientation: Float[Array, "4"]
    """Unit quaternion (w, x, y, z) from the sensor's to the section's frame."""
    name: str = static(default="gyroscope")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Angular velocity of the section, sensor's frame [rad/s]."""
        motion = motion_of(state)
        stations = stations_of(scene.rod, self.arc_length)
        spin = stations.elements.of_vectors(motion.angular_velocities(scene.rod))
        seen = _mounted(self.orientation, stations, motion, spin)
        return self.placed(seen)


def _mounted(
    orientation: Array, stations: Stations, motion: Motion, vector: Vec3
) -> Vec3:
    """Converts world vectors at stations to the frames of the sensors there.

    `orientation` is the unit quaternion from the sensor's to the section's frame; the
    frames of the sections follow from `motion`.
    """
    in_sections = to_material(directors(stations.orientation(motion)), vector)
    mounting = split_quaternion(orientation.astype(vector[0].dtype))
    return to_material(directors(mounting), in_sections)


def accelerometer(
    arc_length: Numbers,
    offsets: Numbers = (0.0, 0.0),
    *,
    orientation: Numbers = IDENTITY,
) -> Accelerometer:
    """Makes an accelerometer that is fixed to a section of a rod.

    At rest it reads 9.81 m/s^2 upwards, in free fall zero. Together with a `gyroscope`
    at the same station it is an inertial unit.

    Args:
        arc_length: Arc length of the station in the unstressed rod, one number or
            `(k,)` [m].
        offsets: Offset from the centreline along d1 and d2 `(2,)`, or one per station
            `(k, 2)` [m].
        orientation: Quaternion (w, x, y, z), scaled to unit length, that turns vectors
            of the sensor's frame into the section's (d1, d2, d3).

    Returns:
        A sensor that reads three components per station, sensor's frame [m/s^2]. It
        needs a method with the consistent law and twist.

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> base = sensors.accelerometer(0.0)  # the clamp keeps it at rest
        >>> round(float(jnp.linalg.norm(base.read(scene, state))), 2)  # gravity [m/s^2]
        9.81
    """
    stations = as_stations(arc_length)
    mounting = _as_mounting(orientation)
    return Accelerometer(stations, as_offsets(offsets, stations), mounting)


def gyroscope(arc_length: Numbers, *, orientation: Numbers = IDENTITY) -> Gyroscope:
    """Makes a gyroscope that is fixed to a section of a rod.

    Args:
        arc_length: Arc length of the station in the unstressed rod, one number or
            `(k,)` [m].
        orientation: Quaternion from the sensor's to the section's frame, as for
            `accelerometer`.

    Returns:
        A sensor that reads three components per station, sensor's frame [rad/s]. It
        needs a method with the consistent law and twist.

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> turning = jnp.zeros((3, 10)).at[2].set(5.0)  # about d3 [rad/s]
        >>> spun = jaxrod.with_angular_velocities(rod, state, turning)
        >>> print(sensors.gyroscope(0.5).read(scene, spun).round(3))
        [0. 0. 5.]
    """
    return Gyroscope(as_stations(arc_length), _as_mounting(orientation))


def _as_mounting(orientation: Numbers) -> Array:
    """Unit quaternion from a quaternion of any length."""
    given = unit_vector("orientation", orientation, 4)
    return jnp.asarray(given, jnp.result_type(float))
