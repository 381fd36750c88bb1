"""Kicks: the change of a rate by loads and damping over one step."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.structure import pytree


@pytree
class Kick:
    """Solution after a time h of r' = load / inertia - damping r, per component."""

    gain: Array
    """Change of the rate per unit of load: (1 - exp(-g h)) / (g inertia), with the
    damping g."""
    loss: Array | None
    """Fraction of the initial rate that is lost, 1 - exp(-g h) [1]; `None` without
    damping. The fraction left is not stored: it is close to one, and its round-off
    would bias the damping."""

    @staticmethod
    def create(inverse_inertia: Array | None, damping: Array | None, dt: Array) -> Kick:
        """Computes `gain` and `loss` for a step of size `dt` [s]."""
        duration = dt
        loss = None
        if damping is not None:
            exponent = damping * dt
            # (1 - exp(-x)) / x; its series where the quotient loses digits.
            small = exponent < 1e-2
            series = 1 - exponent * (
                1 / 2 - exponent * (1 / 6 - exponent * (1 / 24 - exponent / 120))
            )
            quotient = -jnp.expm1(-exponent) / jnp.where(small, 1, exponent)
            share = jnp.where(small, series, quotient)
            duration = dt * share
            loss = exponent * share
        gain = duration if inverse_inertia is None else inverse_inertia * duration
        return Kick(gain, loss)

    def __call__(self, rate: Array, load: Array) -> Array:
        """Rate after the kick, rate + gain load - loss rate, of one component."""
        return rate + self.change(rate, load)

    def change(self, rate: Array, load: Array) -> Array:
        """Change of the rate by the kick, gain load - loss rate, of one component."""
        change = self.gain * load
        return change if self.loss is None else change - self.loss * rate
