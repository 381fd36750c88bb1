"""The muscles of the published benchmark: rate-limited control values, held couples.

Every direction (bending about d1, about d2, twist) is a muscle of its own. In a
simulation step in which its control values are not yet the commanded ones, they move
towards them, by no more than a given change if there is one, and the couples are read
off the spline through them at the elements' far ends, in the arc length of that moment.
Once the commanded values are reached the couples stay as they are, whatever the arm
does.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod import ControlSpline, Rod
from jaxrod.structure import pytree


@pytree
class MuscleParams:
    """Parameters of the muscles."""

    spline: ControlSpline
    """Spline through the control points, in rest arc length."""
    torque: Float[Array, ""]
    """Couple on an element for a control value of one [N m]."""
    largest_change: Float[Array, ""] | None
    """Largest change of a control value in a simulation step; `None` where they
    jump."""


@pytree
class Muscles:
    """State of the muscles."""

    applied: Float[Array, "3 n_controls"]
    """Control values [1] about d1, d2 and d3."""
    couples: Float[Array, "3 n"]
    """Couples on the elements, material frame [N m]."""


def relaxed(rod: Rod, params: MuscleParams) -> Muscles:
    """Muscles without activation, as at the start of an episode."""
    dtype = rod.rest_lengths.dtype
    return Muscles(
        applied=jnp.zeros((3, params.spline.n_controls), dtype),
        couples=jnp.zeros((3, rod.n_elements), dtype),
    )


def contract(
    muscles: Muscles,
    commanded: Float[Array, "3 n_controls"],
    lengths: Float[Array, " n"],
    renewed: Bool[Array, ""],
    params: MuscleParams,
) -> Muscles:
    """Muscles in the simulation step that follows.

    Args:
        muscles: Their state in the step before.
        commanded: Commanded control values [1].
        lengths: Current lengths of the elements [m].
        renewed: Whether the commanded values are new in this step. Where they
            happen to be the old ones the couples do not change, but they follow the
            new ones' derivatives from now on.
        params: Their numbers.
    """
    missing = commanded - muscles.applied
    bound = params.largest_change
    applied = commanded
    if bound is not None:
        applied = jnp.where(
            jnp.abs(missing) <= bound,
            commanded,
            muscles.applied + jnp.clip(missing, -bound, bound),
        )
    couples = params.torque * params.spline(applied, jnp.cumsum(lengths))
    changing = jnp.any(missing != 0, axis=1, keepdims=True)
    still = lax.stop_gradient(muscles.couples) + (couples - lax.stop_gradient(couples))
    held = jnp.where(renewed, still, muscles.couples)
    return Muscles(applied, jnp.where(changing, couples, held))
