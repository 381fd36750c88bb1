"""The muscles of the published benchmark: rate-limited control values, held couples.

Every direction (bending about d1, about d2, twist) is a muscle of its own. In a
simulation step in which its control values differ from the commanded ones, they move
towards them, at most by a given change if there is one. The couples are then evaluated
on the spline through the control values, at the elements' far ends, in the current arc
length. Once the commanded values are reached the couples stay constant, whatever the
arm does.
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
    """Largest change of a control value in a simulation step; `None` if they jump."""


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
    """Returns the muscles in the next simulation step.

    Args:
        muscles: State in the step before.
        commanded: Commanded control values [1].
        lengths: Current lengths of the elements [m].
        renewed: Whether the commanded values are new in this step. If they happen to
            equal the old ones the couples do not change, but from now on they follow
            the derivatives of the new values.
        params: Parameters of the muscles.
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
