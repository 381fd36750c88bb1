"""Effects of a user's own that couple distant parts of a rod, each by its energy."""

from __future__ import annotations

from abc import ABC, abstractmethod

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static


class Potential(jaxrod.extend.Effect, ABC):
    """Forces on the nodes that are minus the gradient of an energy."""

    @abstractmethod
    def potential(self, rod, positions):
        """The energy [J]."""

    def loads(self, rod, motion):
        slope = jax.grad(self.potential, 1)(rod, jnp.stack(motion.position))
        return Loads(forces=(-slope[0], -slope[1], -slope[2]))

    def energy(self, rod, state):
        return self.potential(rod, state.positions)


def length_along(points):
    """Of a line from point to point (3, m) [m]."""
    return jnp.sum(jnp.sqrt(jnp.sum(jnp.diff(points, axis=1) ** 2, axis=0)))


@pytree
class Tendon(Potential):
    """A line through eyelets at some nodes, without friction; of two, a spring."""

    tension: jax.Array
    stiffness: jax.Array
    rest: jax.Array
    nodes: jax.Array

    def potential(self, rod, positions):
        length = length_along(positions[:, self.nodes])
        return self.tension * length + 0.5 * self.stiffness * (length - self.rest) ** 2


@pytree
class Repulsion(Potential):
    """Pushes all nodes apart that are further from each other than some arc length."""

    strength: jax.Array
    width: jax.Array
    apart: int = static(default=3)

    def potential(self, rod, positions):
        first, second = jnp.triu_indices(positions.shape[1], self.apart)
        gap = positions[:, first] - positions[:, second]
        return self.strength * jnp.sum(jnp.exp(-jnp.sum(gap**2, 0) / self.width**2))
