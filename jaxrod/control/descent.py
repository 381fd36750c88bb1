"""The loop of gradient-descent solvers, which runs step by step on the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

Ending = Literal["converged", "max iterations", "not finite", "interrupted"]


def follow_gradient(
    evaluated: Callable[[Array], tuple[Any, Any, Array]],
    seen: Callable[[int, float, float, Any], bool],
    start: Array,
    optimiser: Any,
    iterations: int,
    lower: Any = -1.0,
    upper: Any = 1.0,
) -> tuple[Array, Ending]:
    """Follows a gradient with an optax optimiser, projecting onto the bounds.

    Ctrl-C stops the loop and returns the best point so far.

    Args:
        evaluated: Takes a point and returns its cost, a report and the gradient.
        seen: Takes the iteration, the cost, the norm of the gradient and the report,
            and returns whether the point is good enough.
        start: First point.
        optimiser: An `optax.GradientTransformation`.
        iterations: Largest number of points to evaluate.
        lower: Lower bounds.
        upper: Upper bounds.

    Returns:
        The best point, or the point that was good enough, and why the loop ended.

    Raises:
        KeyboardInterrupt: It was interrupted before the first evaluation was done.
    """

    @jax.jit
    def stepped(point: Array, memory: Any, gradient: Array) -> tuple[Array, Any]:
        change, memory = optimiser.update(gradient, memory, point)
        # Projection keeps every control value within the actuators' range.
        moved = jnp.clip(point + change.astype(point.dtype), lower, upper)
        return moved, memory

    memory = optimiser.init(start)
    point = best = start
    least = np.inf
    looked_at = 0
    try:
        for iteration in range(iterations):
            made, report, gradient = evaluated(point)
            cost = float(made)
            norm = float(np.linalg.norm(np.asarray(gradient, float)))
            arrived = seen(iteration, cost, norm, report)
            looked_at += 1
            if not np.isfinite([cost, norm]).all():
                return best, "not finite"
            if arrived or cost < least:
                best, least = point, cost
            if arrived:
                return best, "converged"
            if iteration + 1 < iterations:
                point, memory = stepped(point, memory, gradient)
    except KeyboardInterrupt:
        if not looked_at:
            raise
        return best, "interrupted"
    return best, "max iterations"


def clipped_adam(
    learning_rate: float, max_gradient_norm: float, iterations: int
) -> Any:
    """Adam on clipped gradients, whose learning rate decays along a cosine to 1/10."""
    import optax

    schedule = optax.cosine_decay_schedule(learning_rate, iterations, alpha=0.1)
    return optax.chain(
        optax.clip_by_global_norm(max_gradient_norm), optax.adam(schedule)
    )
