"""Newton's method for an implicit step of a rod, damped where necessary.

A full correction is tried and judged by the correction that would follow it. If the
latter is too large, half of the correction is tried. This measure of progress depends
neither on units nor on the ratio of stretching to bending stiffness, so steps stay long
for slender rods.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxrod.geometry.vectors import Vec3
from jaxrod.lanes.steps import by_kernel
from jaxrod.statics.degrees_of_freedom import unstack_dofs
from jaxrod.statics.residual import Increment, LoadBalance
from jaxrod.structure import pytree

LARGEST_TURN = 1.0
"""Largest rotation of an element in one correction [rad]."""
LARGEST_GROWTH = 4.0
"""Largest ratio of a correction to the one before. Some growth is harmless: the first
correction has to remove the stretch of the guess."""
SMALLEST_SHARE = 1e-4
"""Smallest fraction of a correction that is tried; below it the search has failed."""


@pytree
class Search:
    """State of Newton's method: the increment, and the correction to try next."""

    increment: Increment
    step: Float[Array, "n+1 6"]
    """Full correction, to be added to the increment."""
    share: Float[Array, ""]
    """Fraction of the correction to try [1]."""
    trials: Int[Array, ""]
    iterations: Int[Array, ""]
    """Number of corrections taken."""
    converged: Bool[Array, ""]
    """Whether the correction is below the tolerance."""


def newton(
    balance: LoadBalance,
    guess: Float[Array, "n+1 6"],
    tolerance: Array,
    max_iterations: int | Array,
) -> Search:
    """Searches for the increment at which loads and inertia balance.

    Args:
        balance: The balance of loads and inertia.
        guess: Initial guess, a step from the base. It is taken in full, or discarded if
            it needs a correction more than twice as large as itself.
        tolerance: The search ends at a correction of less than this many element
            lengths and radians; it is still added.
        max_iterations: Largest number of trials.
    """
    lengths = balance.scene.rod.rest_lengths
    smallest, whole = jnp.min(lengths), jnp.sum(lengths)
    units = jnp.concatenate([jnp.full(3, whole), jnp.ones(3, whole.dtype)])

    def size(step: Array) -> Array:
        """Size of a step, in lengths of the rod and radians."""
        return jnp.sqrt(jnp.sum((step / units[None, :]) ** 2))

    def unfinished(search: Search) -> Array:
        # Written so that a non-finite step ends the search.
        going = (search.iterations == 0) | (search.share >= SMALLEST_SHARE)
        going &= size(search.step) < jnp.inf
        return going & ~search.converged & (search.trials < max_iterations)

    def improve(search: Search) -> Search:
        share = search.share
        tried = search.increment, share * search.step
        increment = by_kernel(balance, "increment_along_edges", tried)
        residual, tangent, _ = by_kernel(balance, "about", increment)
        step = tangent.solve(-residual)
        better = size(step) <= LARGEST_GROWTH * size(search.step)
        # A guess that needs a correction much larger than itself is worse than none.
        first = search.iterations == 0
        unmoved = share * size(search.step) == 0
        better = jnp.where(first, unmoved | (size(step) <= 2 * size(guess)), better)
        displacement, turn = unstack_dofs(step)
        correction = jnp.maximum(largest(displacement) / smallest, largest(turn))
        accepted = Search(
            increment=increment,
            step=step,
            share=_largest_share(step),
            trials=search.trials,
            iterations=search.iterations + 1,
            converged=correction <= tolerance,
        )
        rejected = replace(search, share=jnp.where(first, 0, 0.5 * search.share))
        after = jax.tree.map(lambda a, b: jnp.where(better, a, b), accepted, rejected)
        return replace(after, trials=search.trials + 1)

    none = jax.tree.map(jnp.zeros_like, (balance.base.position, balance.base.spin))
    begin = Search(
        increment=Increment(*none),
        step=guess,
        share=jnp.ones((), guess.dtype),
        trials=jnp.zeros((), jnp.int32),
        iterations=jnp.zeros((), jnp.int32),
        converged=jnp.zeros((), bool),
    )
    end = lax.while_loop(unfinished, improve, begin)
    last = by_kernel(balance, "retracted", (end.increment, end.step))
    return replace(end, increment=last)


def _largest_share(step: Float[Array, "n+1 6"]) -> Array:
    """Fraction of a correction, at most 1, that rotates elements by 1 rad at most."""
    turned = largest(unstack_dofs(step)[1])
    return jnp.minimum(1, LARGEST_TURN / jnp.maximum(turned, LARGEST_TURN))


def largest(field: Vec3) -> Array:
    """Largest absolute value of all components."""
    return jnp.max(jnp.stack([jnp.max(jnp.abs(component)) for component in field]))


def default_tolerance(dtype: jnp.dtype) -> float:
    """Tolerance of corrections, in element lengths and radians, by precision."""
    return 3e-4 if jnp.finfo(dtype).bits <= 32 else 1e-7
