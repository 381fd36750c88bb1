"""Newton's method for the balance of loads on a rod, damped where necessary.

A full correction is tried and judged by the correction that would follow it. If that is
too large, half of it is tried. This measure of progress depends neither on units nor on
the ratio of stretching to bending stiffness, so steps stay long for slender rods.

At rest the search can get stuck near a configuration where the tangent is singular (a
fold): corrections grow without bound towards it, and no fraction of one makes progress.
Then there are two ways on. If the edges of the start are strained, the search begins
again, once, from the same shape without those strains: the edges of a slender rod whose
nodes are off by a millionth of its length can press harder than what it buckles under.
Otherwise a correction is taken without being judged, which crosses the fold.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.statics.degrees_of_freedom import unstack_dofs
from jaxrod.statics.effect_tangents import Tangent
from jaxrod.statics.residual import Increment, LoadBalance
from jaxrod.structure import pytree

LARGEST_TURN = 1.0
"""Largest rotation of an element in one correction [rad]."""
LARGEST_GROWTH = 4.0
"""Largest ratio of a correction to the one before, with inertia. Some growth is
harmless: the first correction has to remove the stretch of the guess."""
SMALLEST_SHARE = 1e-4
"""Smallest fraction of a correction that is tried; below it the search is stuck."""


@pytree
class Search:
    """State of Newton's method: the increment, and the correction to try next."""

    base: Motion
    increment: Increment
    tangent: Tangent
    """Tangent at the increment."""
    loose: Bool[Array, ""]
    """Whether nothing resists a motion of the rod as a whole there."""
    step: Float[Array, "n+1 6"]
    """Full correction of the increment."""
    share: Float[Array, ""]
    """Fraction of the correction to try [1]."""
    unstrained: Bool[Array, ""]
    """Whether the edges of the start were not strained, or no longer are."""
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
    """Searches for the increment at which loads balance.

    At rest every accepted configuration becomes the new base, so that elements can
    rotate any number of times. Without inertia, which makes any tangent definite,
    progress is judged with more care: the correction that the previous tangent would
    give must shrink. Nor does the search fail there when it is stuck: it goes on until
    `max_iterations`.

    Args:
        balance: The balance of loads.
        guess: The first step from the base, taken in full.
        tolerance: The search ends at a correction of less than this many element
            lengths and radians; it is still added.
        max_iterations: Largest number of trials.
    """
    none = jax.tree.map(jnp.zeros_like, (balance.base.position, balance.base.spin))
    lengths = balance.scene.rod.rest_lengths
    smallest, whole = jnp.min(lengths), jnp.sum(lengths)
    units = jnp.concatenate([jnp.full(3, whole), jnp.ones(3, whole.dtype)])

    def size(step: Array) -> Array:
        """Size of a step, in lengths of the rod and radians."""
        return jnp.sqrt(jnp.sum((step / units[None, :]) ** 2))

    begin_again, unstrained = balance.base, jnp.ones((), bool)
    if balance.at_rest:
        removal = balance.removal_of_strain()
        begin_again = balance.motion(removal)
        unstrained = largest(removal.displacement) <= tolerance * smallest

    def unfinished(search: Search) -> Array:
        # Written so that a step that is not finite ends the search.
        going = balance.at_rest | (search.iterations == 0)
        going |= search.share >= SMALLEST_SHARE
        going &= size(search.step) < jnp.inf
        return going & ~search.converged & (search.trials < max_iterations)

    def improve(search: Search) -> Search:
        base, share = search.base, search.share
        stuck = balance.at_rest & (share < SMALLEST_SHARE)
        if balance.at_rest:
            again = stuck & ~search.unstrained
            base = jax.tree.map(lambda a, b: jnp.where(again, a, b), begin_again, base)
            across = jnp.where(again, 0, _largest_share(search.step))
            share = jnp.where(stuck, across, share)
        here = replace(balance, base=base)
        increment = here.retract_along_edges(search.increment, share * search.step)
        if balance.at_rest:
            here, increment = (
                replace(here, base=here.motion(increment)),
                Increment(*none),
            )
        tangent, loose = here.held_tangent(increment)
        residual = here.residual(increment)
        step = tangent.solve(-residual)
        if balance.at_rest:
            rest = size(search.tangent.solve(-residual))
            better = stuck | (rest <= (1 - 0.25 * share) * size(search.step))
        else:
            better = size(step) <= LARGEST_GROWTH * size(search.step)
        # A guess whose correction is much larger than itself is worse than none.
        first = search.iterations == 0
        unmoved = share * size(search.step) == 0
        better = jnp.where(first, unmoved | (size(step) <= 2 * size(guess)), better)
        displacement, turn = unstack_dofs(step)
        correction = jnp.maximum(largest(displacement) / smallest, largest(turn))
        accepted = Search(
            base=here.base,
            increment=increment,
            tangent=tangent,
            loose=loose,
            step=step,
            share=_largest_share(step),
            unstrained=search.unstrained | stuck,
            trials=search.trials,
            iterations=search.iterations + 1,
            converged=correction <= tolerance,
        )
        rejected = replace(search, share=jnp.where(first, 0, 0.5 * search.share))
        after = jax.tree.map(lambda a, b: jnp.where(better, a, b), accepted, rejected)
        return replace(after, trials=search.trials + 1)

    shapes = jax.eval_shape(lambda: balance.tangent(Increment(*none)))
    begin = Search(
        base=balance.base,
        increment=Increment(*none),
        tangent=jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes),
        loose=jnp.zeros((), bool),
        step=guess,
        share=jnp.ones((), guess.dtype),
        unstrained=unstrained,
        trials=jnp.zeros((), jnp.int32),
        iterations=jnp.zeros((), jnp.int32),
        converged=jnp.zeros((), bool),
    )
    end = lax.while_loop(unfinished, improve, begin)
    here = replace(balance, base=end.base)
    return replace(end, increment=here.retract(end.increment, end.step))


def _largest_share(step: Float[Array, "n+1 6"]) -> Array:
    """Largest fraction of a correction that is tried [1]."""
    turned = largest(unstack_dofs(step)[1])
    return jnp.minimum(1, LARGEST_TURN / jnp.maximum(turned, LARGEST_TURN))


def largest(field: Vec3) -> Array:
    """Largest absolute value of all components."""
    return jnp.max(jnp.stack([jnp.max(jnp.abs(component)) for component in field]))


def default_tolerance(dtype: jnp.dtype) -> float:
    """Tolerance of a correction whose square is near round-off."""
    return 3e-4 if jnp.finfo(dtype).bits <= 32 else 1e-7
