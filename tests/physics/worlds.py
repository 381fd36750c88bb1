"""The same rod elsewhere: moved, turned, in other units, in another precision."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod


@dataclass(frozen=True)
class World:
    """How a rod at home is seen: turned, then moved, then measured in other units."""

    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where home's origin is [m]."""
    axis: tuple[float, float, float] | None = None
    """Axis of the turn, of any length; none without."""
    length: float = 1.0
    """Units per metre."""
    mass: float = 1.0
    """Units per kilogram."""
    time: float = 1.0
    """Units per second."""
    dtype: str = "float64"

    @property
    def rotation(self):
        """The matrix that turns home's vectors, by two radians."""
        if self.axis is None:
            return np.eye(3)
        x, y, z = np.asarray(self.axis) / np.linalg.norm(self.axis)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + np.sin(2.0) * cross + (1 - np.cos(2.0)) * cross @ cross

    def cast(self, tree):
        """In this world's precision."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, self.dtype), tree)

    def unit(self, length=0, mass=0, time=0):
        """This world's units in one of home's."""
        return self.length**length * self.mass**mass * self.time**time

    def vector(self, value, **powers):
        """A vector, component axis first, or fields of them."""
        turned = np.tensordot(self.rotation, np.asarray(value, float), 1)
        return turned * self.unit(**powers)

    def place(self, value):
        """A point, or fields of them [m]."""
        value = np.asarray(value, float)
        shift = np.reshape(self.shift, (3,) + (1,) * (value.ndim - 1))
        return self.vector(value, length=1) + self.length * shift

    def rod(self, rod):
        """The rod."""
        scaled = replace(
            rod,
            rest_lengths=rod.rest_lengths * self.unit(1),
            radii=rod.radii * self.unit(1),
            linear_density=rod.linear_density * self.unit(-1, 1),
            rotary_inertia=rod.rotary_inertia * self.unit(1, 1),
            shear_stretch_stiffness=rod.shear_stretch_stiffness * self.unit(1, 1, -2),
            bend_twist_stiffness=rod.bend_twist_stiffness * self.unit(3, 1, -2),
            rest_curvatures=rod.rest_curvatures * self.unit(-1),
        )
        return self.cast(scaled)

    def state(self, state):
        """The state."""
        turn = np.array([1.0, 0.0, 0.0, 0.0])
        if self.axis is not None:
            unit = np.asarray(self.axis) / np.linalg.norm(self.axis)
            turn = np.concatenate([[np.cos(1.0)], np.sin(1.0) * unit])
        moved = jaxrod.RodState(
            positions=self.place(state.positions),
            orientations=product(turn[:, None], np.asarray(state.orientations)),
            velocities=self.vector(state.velocities, length=1, time=-1),
            angular_momenta=self.vector(
                state.angular_momenta, length=2, mass=1, time=-1
            ),
        )
        return self.cast(moved)


def product(a, b):
    """Hamilton product of quaternions, component axis first."""
    v, w = a[1:], b[1:]
    scalar = a[0] * b[0] - np.sum(v * w, axis=0)
    return np.stack([scalar, *(a[0] * w + b[0] * v + np.cross(v, w, axis=0))])


HERE = World()
WORLDS = {
    "here": HERE,
    "5 m up": World(shift=(0.0, 5.0, 0.0)),
    "1 m down": World(shift=(0.0, -1.0, 0.0)),
    "1 km down": World(shift=(0.0, -1000.0, 0.0)),
    "turned": World(axis=(0.3, -1.0, 0.7)),
    "in mm, g and ms": World(length=1e3, mass=1e3, time=1e3),
    "all at once": World((3.0, 50.0, -7.0), (1.0, 2.0, -0.5), 1e3, 1e3, 1e3),
}
