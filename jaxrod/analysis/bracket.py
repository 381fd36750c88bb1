"""A bracket of the zero of a decreasing function, and its narrowing.

Chandrupatla's method: inverse quadratic interpolation through the last three places if
it can be trusted, else bisection. It takes one function value per narrowing, and no
derivative.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.structure import pytree


@pytree
class Bracket:
    """Two places around the zero of a decreasing function, and the next to evaluate."""

    place: Float[Array, ""]
    """Place to evaluate next."""
    last: tuple[Array, Array]
    """Place evaluated last, and the value there."""
    other: tuple[Array, Array]
    """Other end of the bracket, and the value there, of opposite sign."""
    former: tuple[Array, Array]
    """Former end of the bracket, and the value there."""

    @staticmethod
    def between(lower: Array, upper: Array) -> Bracket:
        """Bracket of two places at which nothing has been evaluated."""
        # Guessed values of a function that decreases like a hyperbolic tangent: only
        # their signs must be right.
        guess = jnp.tanh(0.5 * (upper - lower))
        return Bracket(
            0.5 * (lower + upper), (lower, guess), (upper, -guess), (upper, -guess)
        )

    @property
    def width(self) -> Float[Array, ""]:
        """Distance between the ends."""
        return jnp.abs(self.other[0] - self.last[0])

    @property
    def lower(self) -> Float[Array, ""]:
        """End at which the function is not negative."""
        return jnp.minimum(self.last[0], self.other[0])

    def narrowed(self, value: Array, shift: float) -> Bracket:
        """Bracket after the value at its `place` is known.

        Args:
            value: Value of the function there.
            shift: Smallest distance of the next place from either end.
        """
        same = (value >= 0) == (self.last[1] >= 0)
        last = self.place, value
        former = jax.tree.map(lambda a, b: jnp.where(same, a, b), self.last, self.other)
        other = jax.tree.map(lambda a, b: jnp.where(same, a, b), self.other, self.last)
        (x1, f1), (x2, f2), (x3, f3) = last, other, former
        share = jnp.asarray(0.5, x1.dtype)
        place = (x1 - x2) / _not_zero(x3 - x2)
        height = (f1 - f2) / _not_zero(f3 - f2)
        trusted = (height**2 < place) & ((1 - height) ** 2 < 1 - place)
        apart = _not_zero(x2 - x1)
        curved = f1 / _not_zero(f2 - f1) * f3 / _not_zero(f2 - f3) + (
            (x3 - x1) / apart * f1 / _not_zero(f3 - f1) * f2 / _not_zero(f3 - f2)
        )
        share = jnp.where(trusted, curved, share)
        margin = jnp.minimum(shift / jnp.abs(apart), 0.5)
        share = jnp.clip(share, margin, 1 - margin)
        return Bracket(x1 + share * (x2 - x1), last, other, former)


def _not_zero(a: Array) -> Array:
    return jnp.where(a == 0, 1, a)
