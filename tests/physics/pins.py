"""Pins of a user's own: nodes held in place, elements free to turn."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod.structure import pytree, static


@pytree
class Place(jaxrod.extend.Effect):
    """Holds a node in place if it is on, and says nothing of its velocity."""

    place: jax.Array
    on: jax.Array
    node: int = static(default=0)

    def put(self, field, values):
        """A vector field with other values at the node."""
        x, y, z = (
            c.at[self.node].set(jnp.where(self.on > 0, value, c[self.node]))
            for c, value in zip(field, values, strict=True)
        )
        return x, y, z

    def constrain(self, rod, motion):
        return replace(motion, position=self.put(motion.position, self.place))


@pytree
class Pin(Place):
    """Holds a node in place and at rest."""

    def constrain_rates(self, rod, motion):
        return replace(motion, velocity=self.put(motion.velocity, (0.0,) * 3))


def pinned(state, kind=Pin, on=(1, 1)):
    """Pins at both ends, where the state has them."""
    switches = jnp.asarray(on, state.positions.dtype)
    return (
        kind(state.positions[:, 0], switches[0], 0),
        kind(state.positions[:, -1], switches[1], -1),
    )
