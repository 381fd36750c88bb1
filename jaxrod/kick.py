"""Kicks: what loads and damping make of a rate over one step."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod._pytree import pytree


@pytree
class Kick:
    """Solution after a time h of r' = load / inertia - damping r, per component.

    Attributes:
        gain: Change of the rate per unit of load.
        decay: What is left of the initial rate; `None` without damping.
    """

    gain: Array
    decay: Array | None

    @staticmethod
    def create(inverse_inertia: Array | None, damping: Array | None, dt: Array) -> Kick:
        """Works out both factors for a step of size `dt` [s]."""
        duration = dt
        decay = None
        if damping is not None:
            exponent = damping * dt
            decay = jnp.exp(-exponent)
            # (1 - exp(-x)) / x, by its series where the quotient loses digits.
            small = exponent < 1e-2
            series = 1 - exponent * (
                1 / 2 - exponent * (1 / 6 - exponent * (1 / 24 - exponent / 120))
            )
            quotient = -jnp.expm1(-exponent) / jnp.where(small, 1, exponent)
            duration = dt * jnp.where(small, series, quotient)
        gain = duration if inverse_inertia is None else inverse_inertia * duration
        return Kick(gain, decay)

    def __call__(self, rate: Array, load: Array) -> Array:
        """Applies the kick to one component."""
        if self.decay is not None:
            rate = self.decay * rate
        return rate + self.gain * load
