"""Mobility of rigid bodies: how far an impulse at a point moves it by turning."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3


def turning_mobility(
    inertias: Float[Array, "3 *k"], arm: Vec3, around: Array | float = 0.0
) -> Array:
    r"""Largest velocity of a point per impulse there, by turning alone [1/kg].

    An impulse $f$ at the lever arm $r$ moves the point by $(r\times f)\cdot
    I^{-1}(r\times f)$ along $f$. For unit vectors $f$ this is at most $r^2$ times the
    larger eigenvalue of $I^{-1}$ in the plane across $r$. Points within a distance $d$
    of it have at most $(\sqrt\lambda + d/\sqrt{I_{min}})^2$.

    Args:
        inertias: Moments of inertia about the axes of the body [kg m^2].
        arm: Lever arms from the centre of mass, in the frame of the body [m].
        around: Distance d from the ends of the arms [m].
    """
    least = jnp.min(inertias, axis=0)
    length = vectors.safe_norm(arm)
    x, y, z = (c * c for c in vectors.scale(1 / length, arm))
    a, b, c = least[None] / inertias
    slow = jnp.minimum(jnp.minimum(a, b), c)
    # The eigenvalues above the least one: exact for equal moments.
    a, b, c = a - slow, b - slow, c - slow
    total = a * (y + z) + b * (z + x) + c * (x + y)
    product = b * c * x + c * a * y + a * b * z
    square = total * total - 4 * product
    apart = square > 0
    root = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)
    ease = length * jnp.sqrt((slow + 0.5 * (total + root)) / least)
    ease = ease + around / jnp.sqrt(least)
    return ease * ease
