"""Statics: where all loads on a rod balance, and how that depends on every number.

Newton's method on the same balance of loads as the implicit integrator's, damped by
how far it can be trusted: a trial counts as progress if the correction that follows it
(with the tangent of before) is smaller. This measure does not depend on units or on
how much stiffer stretch is than bending, so that steps stay long for slender rods.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrod._implicit import (
    LARGEST_TURN,
    largest,
    motion_of,
    newton_tolerance,
    state_of,
)
from jaxrod._pytree import pytree
from jaxrod._validation import check_array, check_count
from jaxrod.balance import Balance, Moves, balanced, unblocked
from jaxrod.block_tridiagonal import BlockTridiagonal
from jaxrod.effect_tangents import has_closed_form
from jaxrod.effects import Clamp
from jaxrod.elasticity import elastic_law
from jaxrod.motion import Motion
from jaxrod.rod import RodState
from jaxrod.scene import Scene, hold, hold_rates

SMALLEST_SHARE = 1e-4
"""Less than this of a correction is not worth taking: there is nothing to find."""


@pytree
class Equilibrium:
    """A rod at rest under its loads, if `converged`."""

    state: RodState
    """Where the iteration ended, at rest."""
    converged: Bool[Array, ""]
    """Whether all loads balance there, to the tolerance."""
    stable: Bool[Array, ""]
    """Whether the stored energy is least there: no negative pivot in the tangent.

    For loads with a potential; with loads that turn with the rod (follower couples)
    it says nothing about instability in motion (flutter).
    """
    iterations: Int[Array, ""]
    """Newton's corrections taken."""
    force_residual: Float[Array, ""]
    """The largest component of force out of balance at a node [N]."""
    couple_residual: Float[Array, ""]
    """The largest component of couple out of balance on an element [N m]."""


def equilibrium(
    scene: Scene,
    state: RodState,
    *,
    tolerance: ArrayLike | None = None,
    max_iterations: int = 100,
) -> Equilibrium:
    """Finds where the loads on a rod balance, starting from a state.

    Works inside jit and vmap. The equilibrium is differentiable in both modes with
    respect to every number of the scene, by the implicit function theorem: one
    linear solve, whatever the number of iterations.

    Near a limit point (buckling, snap-through) there may be nothing to find nearby:
    look at `converged`. The method finds equilibria, stable or not: look at `stable`.

    Args:
        scene: The scene; something has to hold the rod.
        state: Where to start from, and where what is held is held. Its velocities
            do not matter.
        tolerance: Iteration ends after a correction below this many element lengths
            and radians; by default 1e-7, or 3e-4 in single precision.
        max_iterations: How many corrections to allow.

    Returns:
        The state at rest, and how well the loads balance there.

    Raises:
        ValueError: If the mode is not "consistent", if nothing holds the rod, or if
            an argument is out of range.
    """
    if scene.mode != "consistent":
        raise ValueError(
            f"equilibrium needs a scene with mode='consistent', got {scene.mode!r}"
        )
    n, dtype = scene.rod.n_elements, scene.rod.rest_lengths.dtype
    if state.orientations.shape[-1] != n:
        raise ValueError(
            f"state must have {n} elements, as the scene's rod has, "
            f"got {state.orientations.shape[-1]}"
        )
    check_count("max_iterations", max_iterations, 1)
    if tolerance is not None:
        bound = check_array("tolerance", tolerance, [()], "", positive=True)
        tolerance = jnp.asarray(bound, dtype)
    if _is_loose(scene, state):
        raise ValueError(
            "scene must hold the rod for an equilibrium: a free rod has none under "
            "loads, and any number without. Add jaxrod.clamp(state) or "
            "jaxrod.fixed_end(state)"
        )
    return _equilibrium(
        scene, state, newton_tolerance(tolerance, dtype), max_iterations
    )


def _is_loose(scene: Scene, state: RodState) -> bool:
    """Whether nothing in the scene could hold the rod, as far as can be told."""
    if not all(has_closed_form(e) and not isinstance(e, Clamp) for e in scene.effects):
        return False
    with jax.ensure_compile_time_eval():
        free = _at_rest(scene, motion_of(state)).free
    return not isinstance(free, jax.core.Tracer) and bool(jnp.all(free[:, :3] == 1))


def _at_rest(scene: Scene, base: Motion) -> Balance:
    """The balance of loads alone."""
    still = jnp.zeros((), scene.rod.rest_lengths.dtype)
    return Balance(scene, elastic_law(scene.rod), base, still, None)


@jax.jit(static_argnames="max_iterations")
def _equilibrium(
    scene: Scene, state: RodState, tolerance: Array, max_iterations: int
) -> Equilibrium:
    start = motion_of(state)
    start = replace(
        start,
        velocity=jax.tree.map(jnp.zeros_like, start.velocity),
        spin=jax.tree.map(jnp.zeros_like, start.spin),
    )
    start = hold_rates(scene, hold(scene, start))
    end = _search(*lax.stop_gradient((scene, start, tolerance)), max_iterations)
    # What is held is where the state and the scene have it, with their derivatives.
    base = _keep_held(scene, end.motion, start)
    moves = balanced(_at_rest(scene, base), _no_moves(base))
    force, couple = unblocked(end.residual)
    return Equilibrium(
        state=state_of(_at_rest(scene, base).motion(moves)),
        converged=end.converged,
        stable=end.tangent.negative_pivots() == 0,
        iterations=end.iterations,
        force_residual=largest(force),
        couple_residual=largest(couple),
    )


@pytree
class _Search:
    """Where Newton's method is: a configuration, and what to try from it."""

    motion: Motion
    residual: Float[Array, "n+1 6"]
    tangent: BlockTridiagonal
    step: Float[Array, "n+1 6"]
    """The whole correction."""
    share: Float[Array, ""]
    """How much of it to try."""
    iterations: Int[Array, ""]
    trials: Int[Array, ""]
    converged: Bool[Array, ""]


def _search(
    scene: Scene, start: Motion, tolerance: Array, max_iterations: int
) -> _Search:
    """Newton's method, one trial at a time."""
    length = jnp.min(scene.rod.rest_lengths)
    scales = jnp.concatenate([jnp.full(3, scene.rod.length), jnp.ones(3, length.dtype)])

    def size(step: Array) -> Array:
        """Of a step, its displacements in lengths of the rod."""
        return jnp.sqrt(jnp.sum((step / scales[None, :]) ** 2))

    def largest_part(step: Array) -> tuple[Array, Array]:
        displacement, turn = unblocked(step)
        return largest(displacement) / length, largest(turn)

    def unfinished(search: _Search) -> Array:
        # Written so that a step that is not finite ends the search.
        going = (search.share >= SMALLEST_SHARE) & (size(search.step) < jnp.inf)
        return going & ~search.converged & (search.iterations < max_iterations)

    def improve(search: _Search) -> _Search:
        before = _at_rest(scene, search.motion)
        none = _no_moves(search.motion)
        moves = before.followed(none, search.share * search.step)
        motion = before.motion(moves)
        there = _at_rest(scene, motion)
        residual, tangent = there.residual(none), there.tangent(none)
        step = tangent.solve(-residual)
        _, turned = largest_part(step)
        rest = size(search.tangent.solve(-residual))
        better = rest <= (1 - 0.25 * search.share) * size(search.step)
        # The last correction was below the tolerance: nothing can be told from it.
        tiny = jnp.maximum(*largest_part(search.step)) <= tolerance
        first = search.trials == 0
        accepted = _Search(
            motion=motion,
            residual=residual,
            tangent=tangent,
            step=step,
            share=jnp.minimum(1, LARGEST_TURN / jnp.maximum(turned, LARGEST_TURN)),
            iterations=search.iterations + jnp.where(first, 0, 1),
            trials=search.trials,
            converged=tiny & ~first,
        )
        rejected = replace(search, share=0.5 * search.share)
        after = jax.tree.map(
            lambda a, b: jnp.where(first | tiny | better, a, b), accepted, rejected
        )
        return replace(after, trials=search.trials + 1)

    zero = jnp.zeros((len(start.position[0]), 6), length.dtype)
    nothing = jnp.zeros((*zero.shape, 6), length.dtype)
    search = _Search(
        motion=start,
        residual=zero,
        tangent=BlockTridiagonal(
            nothing, nothing + jnp.eye(6, dtype=length.dtype)[None], nothing
        ),
        step=zero,
        share=jnp.ones((), length.dtype),
        iterations=jnp.zeros((), jnp.int32),
        trials=jnp.zeros((), jnp.int32),
        converged=jnp.zeros((), bool),
    )
    return lax.while_loop(unfinished, improve, search)


def _no_moves(motion: Motion) -> Moves:
    return Moves(*jax.tree.map(jnp.zeros_like, (motion.position, motion.spin)))


def _keep_held(scene: Scene, found: Motion, start: Motion) -> Motion:
    """The motion found, with what the scene holds as it was at the start."""
    nodes, elements = unblocked(_at_rest(scene, start).free)
    turning = (elements[0] == 1) | (elements[1] == 1) | (elements[2] == 1)
    x, y, z = (
        jnp.where(free == 1, there, here)
        for free, there, here in zip(nodes, found.position, start.position, strict=True)
    )
    q0, q1, q2, q3 = (
        jnp.where(turning, there, here)
        for there, here in zip(found.orientation, start.orientation, strict=True)
    )
    return replace(found, position=(x, y, z), orientation=(q0, q1, q2, q3))
