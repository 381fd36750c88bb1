"""The largest step within a quadratic bound, from matrix-vector products alone."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrod.structure import pytree
from jaxrod.training.settings import Scalar

Vector = Float[Array, " parameters"]


def fisher_product(
    outputs: Callable[[Vector], tuple[Array, Array]],
    parameters: Vector,
) -> Callable[[Vector], Vector]:
    """Function v -> F v for the Fisher matrix F of a normal distribution over actions.

    F is the Hessian of the mean KL divergence from the distribution at `parameters`,
    evaluated there. With J the Jacobian of (mean, log std), F = J^T M J. The diagonal
    matrix M is 1 / (samples std^2) for a mean and 2 for a log std. The outputs are
    linearised once: every product takes one forward and one backward pass.

    Args:
        outputs: Function from the parameters to the mean, shape (samples, actions), and
            the log std, shape (actions,).
        parameters: Point at which the matrix is evaluated.

    Source: Schulman et al., "Trust region policy optimization", 2015, appendix C.
    """
    (mean, log_std), forwards = jax.linearize(outputs, parameters)
    backwards = jax.linear_transpose(forwards, parameters)
    precision = jnp.exp(-2 * log_std)[None] / mean.shape[0]

    def product(vector: Vector) -> Vector:
        of_mean, of_log_std = forwards(vector)
        return backwards((precision * of_mean, 2 * of_log_std))[0]

    return product


def conjugate_gradient(
    product: Callable[[Vector], Vector],
    right_side: Vector,
    iterations: int,
    tolerance: float = 1e-10,
) -> Vector:
    """Conjugate gradients: solves A x = b for a positive definite A, given A x alone.

    It stops early when the squared residual is below `tolerance` times its initial
    value: further iterations would only produce round-off.

    Args:
        product: Function that returns A x for a vector x.
        right_side: Right-hand side b.
        iterations: Largest number of products.
        tolerance: Relative tolerance of the squared residual.
    """
    enough = tolerance * jnp.vdot(right_side, right_side)

    def improve(_: Int[Array, ""], carry: tuple[Vector, ...]) -> tuple[Vector, ...]:
        solution, residual, direction, square = carry
        image = product(direction)
        curvature = jnp.vdot(direction, image)
        go_on = (square > enough) & (curvature > 0)
        length = jnp.where(go_on, square / jnp.where(go_on, curvature, 1), 0)
        solution = solution + length * direction
        residual = residual - length * image
        following = jnp.where(go_on, jnp.vdot(residual, residual), square)
        ratio = jnp.where(go_on, following / jnp.where(go_on, square, 1), 0)
        direction = jnp.where(go_on, residual + ratio * direction, direction)
        return solution, residual, direction, following

    start = (
        jnp.zeros_like(right_side),
        right_side,
        right_side,
        jnp.vdot(right_side, right_side),
    )
    return jax.lax.fori_loop(0, iterations, improve, start)[0]


def longest_step(
    product: Callable[[Vector], Vector], direction: Vector, bound: Scalar
) -> Vector:
    """Scales a direction s so that s^T A s / 2 = bound; `product` returns A s.

    A direction with s^T A s <= 0 becomes zero.
    """
    quadratic = 0.5 * jnp.vdot(direction, product(direction))
    sound = quadratic > 0
    scale = jnp.sqrt(bound / jnp.where(sound, quadratic, 1))
    return jnp.where(sound, scale, 0) * direction


@pytree
class LineSearch:
    """Result of a backtracking line search."""

    point: Vector
    """Accepted point; the start if no point was accepted."""
    accepted: Bool[Array, ""]
    """Whether a point was accepted."""
    backtracks: Int[Array, ""]
    """Number k of times that the step was shortened."""


def backtrack(
    acceptable: Callable[[Vector], Bool[Array, ""]],
    start: Vector,
    step: Vector,
    shrink: Scalar,
    tries: int,
) -> LineSearch:
    """Line search: the first acceptable point start + shrink^k step, k = 0, 1, ...

    Args:
        acceptable: Function that returns whether a point is acceptable.
        start: Start of the step.
        step: The step of the first try.
        shrink: Factor from one try to the next.
        tries: Largest number of tries; if all fail, the result is the start.
    """

    def unfinished(carry: tuple[Array, Array]) -> Bool[Array, ""]:
        tried, accepted = carry
        return ~accepted & (tried < tries)

    def attempt(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        tried, _ = carry
        return tried + 1, acceptable(start + _shortened(step, shrink, tried))

    tried, accepted = jax.lax.while_loop(
        unfinished, attempt, (jnp.int32(0), jnp.array(False))
    )
    backtracks = tried - 1
    found = start + _shortened(step, shrink, backtracks)
    return LineSearch(jnp.where(accepted, found, start), accepted, backtracks)


def _shortened(step: Vector, shrink: Scalar, times: Int[Array, ""]) -> Vector:
    return jnp.asarray(shrink, step.dtype) ** times * step
