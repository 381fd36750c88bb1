r"""The base of all sensors, and interpolation along a rod at their stations.

A station is an arc length $s$ of the unstressed rod. A field that is known at points
$s_j$ (nodes, element midpoints or joints) is interpolated linearly in $s$, and
extrapolated linearly beyond the first and the last point. Orientations are interpolated
along the rotation vector $\phi_j$ of the joint, $q(s) = q_j\,e^{\lambda\phi_j}$, with
the fraction $\lambda$ of the interval. The error is second order in the length of the
elements, and zero in a circular arc (orientation) and under constant strain.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrod.effects.own_classes import trial_motion
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    multiply_quaternions,
    rotation_exp,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod, scene_of
from jaxrod.rods.elasticity import joint_rotations
from jaxrod.rods.motion import Motion, state_of
from jaxrod.rods.rod import Rod, RodState, middle_places, node_places
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, is_traced, numeric

_BEYOND = 1e-5
"""Largest accepted distance of a station beyond the end, as a fraction of the rod's
length [1]."""


class Sensor(ABC):
    """Base class of all sensors: a sensor computes a reading from a state of a scene.

    A sensor is a frozen pytree. `read` is a pure function: `jax.vmap` of it reads a
    batch or a recording, and it is differentiable in forward and reverse mode.

    Example:
        >>> @extend.pytree
        ... class Height(sensors.Sensor):
        ...     name: str = extend.static(default="height of the tip")
        ...     unit = "m"
        ...
        ...     def measure(self, scene, state):
        ...         return state.tip[2]
        >>> float(Height().read(scene, state))
        0.0
    """

    name: str
    """Name of the sensor, for messages."""
    unit: ClassVar[str]
    """SI unit of the reading."""

    def read(self, scene: LoadedRod, state: RodState) -> Array:
        """Computes the reading in a state, in `unit`.

        Args:
            scene: The scene of one rod; if it depends on time, the scene at the time of
                the state, `scene.at(time)`.
            state: The state.

        Raises:
            ValueError: If the scene depends on time, lacks what the sensor measures, or
                its rod ends before the sensor's arc length. If the arc length is
                traced, the reading is NaN instead.
            TypeError: If `scene` or `state` has the wrong type.
        """
        scene = scene_of(scene, state)
        self.check(scene)
        return _read(self, scene, state)

    @abstractmethod
    def measure(self, scene: LoadedRod, state: RodState) -> Array:
        """Computes the reading in a state; `read` calls it compiled, after `check`."""

    def check(self, scene: LoadedRod) -> None:  # noqa: B027
        """Raises if the scene lacks what the sensor measures; by default never."""

    def shape(self, scene: LoadedRod) -> tuple[int, ...]:
        """Shape of the reading, found without computing it."""
        state = jax.eval_shape(lambda: state_of(trial_motion(scene.rod)))
        return jax.eval_shape(lambda given: self.read(scene, given), state).shape


@jax.jit
def _read(sensor: Sensor, scene: LoadedRod, state: RodState) -> Array:
    return sensor.measure(scene, state)


@pytree
class Weights:
    """Linear interpolation of a field from `m` points of a rod to `k` stations."""

    before: Bool[Array, "k m-1"]
    """Whether a station (row) is in an interval between two points (column)."""
    share: Float[Array, "k"]
    """Position of each station within its interval, from 0 to 1; outside this range
    beyond the first and the last point [1]."""
    valid: Bool[Array, "k"]
    """Whether each station is on the rod."""

    def of(self, values: Array) -> Array:
        """Interpolates values `(m,)` to the stations `(k,)`; NaN off the rod."""
        if values.shape[-1] > 1:
            first = jnp.sum(jnp.where(self.before, values[None, :-1], 0), axis=1)
            last = jnp.sum(jnp.where(self.before, values[None, 1:], 0), axis=1)
            found = first + self.share * (last - first)
        else:
            found = jnp.broadcast_to(jnp.sum(values), self.valid.shape)
        return jnp.where(self.valid, found, jnp.nan)

    def of_vectors(self, field: Vec3) -> Vec3:
        """Interpolates vectors to the stations, each component as in `of`."""
        return self.of(field[0]), self.of(field[1]), self.of(field[2])


def _weights(rod: Rod, stations: Array, places: Array) -> Weights:
    """Makes the interpolation to stations `(k,)` from points `places` `(m,)` [m]."""
    stations = stations.astype(rod.rest_lengths.dtype)
    valid = (stations >= 0) & (stations <= (1 + _BEYOND) * rod.length)
    here = stations[:, None]
    if places.shape[0] < 2:
        nowhere = jnp.zeros((stations.shape[0], 0), bool)
        return Weights(nowhere, jnp.zeros_like(stations), valid)
    row = places[None, :]
    inner = row[:, 1:-1]
    from_here = jnp.pad(here >= inner, ((0, 0), (1, 0)), constant_values=True)
    to_here = jnp.pad(here < inner, ((0, 0), (0, 1)), constant_values=True)
    before = from_here & to_here
    start = jnp.sum(jnp.where(before, row[:, :-1], 0), axis=1)
    length = jnp.sum(jnp.where(before, row[:, 1:] - row[:, :-1], 0), axis=1)
    # A station that is NaN is in no interval.
    safe = jnp.where(valid, length, 1)
    return Weights(before, (stations - start) / safe, valid)


@pytree
class Stations:
    """Interpolation of fields on nodes, elements and joints to stations of a rod."""

    nodes: Weights
    """Interpolation of values at nodes."""
    elements: Weights
    """Interpolation of values at element midpoints."""
    joints: Weights
    """Interpolation of values at joints, taken halfway between the midpoints of two
    elements."""

    def orientation(self, motion: Motion) -> Quaternion:
        """Unit quaternion of the section at each station, material to world."""
        q = motion.orientation
        turn, _ = joint_rotations(q)
        before, share = self.elements.before, self.elements.share

        def chosen(part: Array) -> Array:
            return jnp.sum(jnp.where(before, part[None, :], 0), axis=1)

        w, x, y, z = (chosen(part[:-1]) for part in q)
        a, b, c = (share * chosen(part) for part in turn)
        turned = multiply_quaternions((w, x, y, z), rotation_exp((a, b, c)))
        w, x, y, z = (jnp.where(self.elements.valid, p, jnp.nan) for p in turned)
        return w, x, y, z


@pytree
class StationSensor(Sensor):
    """Base class of sensors at stations: arc lengths of a rod."""

    arc_length: Float[Array, "*k"]
    """Arc lengths of the stations in the unstressed rod [m]."""

    def check(self, scene: LoadedRod) -> None:
        """Raises a ValueError if a station is beyond the rod's end, unless traced."""
        length = scene.rod.length
        if is_traced(self.arc_length, length):
            return
        most = np.max(np.asarray(self.arc_length))
        if most > (1 + _BEYOND) * float(length):
            raise ValueError(
                f"arc_length must be at most the rod's length, {float(length):g} m, "
                f"got {most:g} m"
            )

    def placed(self, reading: Vec3) -> Array:
        """Stacks three components `(k,)` to `(3, k)`, or to `(3,)` for one station."""
        return vectors.join(reading).reshape(3, *self.arc_length.shape)


def stations_of(rod: Rod, arc_length: Array) -> Stations:
    """Makes the interpolation of a rod at arc lengths `()` or `(k,)` [m]."""
    stations = jnp.ravel(arc_length)
    middles = jnp.asarray(middle_places(rod))
    joints = 0.5 * (middles[1:] + middles[:-1])
    nodes = jnp.asarray(node_places(rod))
    return Stations(*(_weights(rod, stations, p) for p in (nodes, middles, joints)))


def as_stations(arc_length: Numbers) -> Array:
    """Validates arc lengths of stations and returns them, `()` or `(k,)` [m]."""
    given = numeric("arc_length", arc_length, "m")
    shapes = [(), (given.size,)]
    return as_array("arc_length", given, "m", shapes, non_negative=True)


def as_offsets(
    offsets: Numbers, arc_length: Array, components: tuple[int, ...] = (2,)
) -> Array:
    """Validates offsets along d1, d2 and possibly d3 [m], and returns them.

    Args:
        offsets: Offsets `(2,)` or `(3,)`, or one per station `(k, 2)` or `(k, 3)` [m].
        arc_length: Arc lengths of the stations.
        components: Allowed numbers of components.

    Returns:
        The offsets, components first: `(2, 1)` or `(2, k)`, or three rows.
    """
    given = numeric("offsets", offsets, "m")
    shapes: list[tuple[int, ...]] = [(count,) for count in components]
    if arc_length.ndim:
        shapes += [(arc_length.shape[0], count) for count in components]
    checked = as_array("offsets", given, "m", shapes)
    return checked.reshape(-1, checked.shape[-1]).T


def in_section(offsets: Array, like: Array) -> Vec3:
    """Offsets `(2, k)` or `(3, k)` as vectors (d1, d2, d3), in the dtype of `like`."""
    x, y, *rest = (
        jnp.broadcast_to(part, like.shape).astype(like.dtype) for part in offsets
    )
    return x, y, rest[0] if rest else jnp.zeros_like(x)
