r"""The extended Kalman filter on the states of a model, in square-root form.

A prediction simulates the estimated state over a period, and propagates its covariance
with the linear model about that state. A measurement corrects both:

$$P^- = A P A^T + B\,\mathrm{diag}(s^2) B^T + Q, \qquad S = C P^- C^T +
\mathrm{diag}(r^2), \qquad K = P^- C^T S^{-1},$$

$$x = x^- \oplus K (y - h(x^-)), \qquad P = (1 - K C) P^-.$$

where $A$, $B$ and $C$ are the matrices of `linearise`, $s$, $Q$ and $r$ describe the
noise of a `Process`, and $\oplus$ adds local coordinates. Prediction and correction are
computed by orthogonal transformations of the square root $L$ of the covariance
$P = L L^T$, which therefore stays positive semidefinite, also in float32.

Source: G. J. Bierman, Factorization methods for discrete sequential estimation, 1977;
on manifolds, C. Hertzberg et al., Integrating generic sensor fusion algorithms with
sound state representations, Information Fusion 14, 2013.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from jaxrod.control.estimation.process import Estimate, Process, check_estimate
from jaxrod.control.linearisation import measured, period
from jaxrod.structure import pytree


@pytree
class Update:
    """An estimate corrected by a measurement, and the innovations of the correction.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> loose = process.coordinates.filled(displacement=0.01)
        >>> estimate = estimation.first_estimate(process, state, loose**2)
        >>> seen = state.tip.at[2].set(jnp.nan)  # its height was not measured
        >>> found = estimation.update(process, estimate, seen)
        >>> int(found.count), found.whitened.shape
        (2, (3,))
    """

    estimate: Estimate
    """Estimate after the correction."""
    innovations: Float[Array, "..."]
    """Measured minus predicted values, in the measurement's shape; zero if missing."""
    whitened: Float[Array, " numbers"]
    """Innovations multiplied by the inverse square root of their covariance [1]:
    independent, with variance one, if the model and its noise are right."""
    square: Float[Array, ""]
    """Sum of the squares of `whitened`; if the model and its noise are right, its
    expected value is `count`."""
    count: Int[Array, ""]
    """Number of values that were not missing from the measurement."""


def predict(process: Process, estimate: Estimate, control: Any = None) -> Estimate:
    """Predicts the estimate one period later. Pure; works inside jit and vmap.

    Args:
        process: The process.
        estimate: The estimate at the beginning of the period.
        control: Known control during the period; zeros by default.

    Raises:
        ValueError: If the control or the estimate has the wrong shape.
        TypeError: If `process` or `estimate` has the wrong type.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> loose = process.coordinates.filled(velocity=0.1)
        >>> estimate = estimation.first_estimate(process, state, loose**2)
        >>> later = estimation.predict(process, estimate)
        >>> int(later.steps), bool(later.deviations[0] > estimate.deviations[0])
        (10, True)
    """
    check_estimate(process, estimate)
    given = process.control(control)
    ways = process.coordinates.directions(
        estimate.state,
        first=estimate.steps,
        control=given,
        with_control=process.with_control,
    )
    after, by_state, by_control = period(
        process.coordinates,
        process.model,
        estimate.state,
        ways,
        process.dt,
        process.n_steps,
        estimate.steps,
        given,
        process.with_control,
    )
    root = _spread(process, estimate.root, by_state, by_control)
    return Estimate(after, root, estimate.steps + process.n_steps)


def update(process: Process, estimate: Estimate, observed: Any) -> Update:
    """Corrects an estimate by a measurement. Pure; works inside jit and vmap.

    Args:
        process: The process.
        estimate: The estimate at the time of the measurement.
        observed: The measurement. Values that are not finite, or whose prediction is
            not finite, count as missing.

    Returns:
        The corrected estimate, and the innovations.

    Raises:
        ValueError: If the measurement or the estimate has the wrong shape.
        TypeError: If `process` or `estimate` has the wrong type.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> loose = process.coordinates.filled(displacement=0.01)
        >>> estimate = estimation.first_estimate(process, state, loose**2)
        >>> seen = state.tip.at[2].add(0.01)  # the tip is 1 cm higher than expected
        >>> found = estimation.update(process, estimate, seen)
        >>> round(float(found.estimate.state.tip[2]), 3)
        0.01
    """
    check_estimate(process, estimate)
    seen = check_observed(process, observed, process.noise.shape)
    ways = process.coordinates.directions(estimate.state, first=estimate.steps)
    return _updated(process, estimate, seen, ways)


def check_observed(process: Process, observed: Any, shape: tuple[int, ...]) -> Array:
    """Converts measurements to an array of the process's dtype.

    Raises:
        ValueError: If their shape is not `shape`.
    """
    seen = jnp.asarray(observed, process.dt.dtype)
    if seen.shape != shape:
        raise ValueError(
            f"observed must have shape {shape}, as measure returns it, got {seen.shape}"
        )
    return seen


def lower_root(*blocks: Array) -> Array:
    """Lower triangular L with L L^T = sum of B B^T over the blocks B (by QR)."""
    return jnp.linalg.qr(jnp.concatenate(blocks, axis=1).T, mode="r").T


@jax.jit
def _spread(process: Process, root: Array, by_state: Array, by_control: Array) -> Array:
    """Square root of the covariance after a period, A P A^T + B diag(s^2) B^T + Q.

    `root` is the square root of P, `by_state` is A and `by_control` is B.
    """
    blocks = [by_state @ root]
    if process.control_noise is not None:
        blocks.append(by_control * jnp.ravel(process.control_noise)[None])
    if process.state_root is not None:
        blocks.append(process.state_root)
    return lower_root(*blocks)


@jax.jit
def _updated(
    process: Process, estimate: Estimate, observed: Array, ways: Array
) -> Update:
    coordinates, state, root = process.coordinates, estimate.state, estimate.root
    now = process.at(estimate.steps)
    expected, by_state = measured(coordinates, now, state, ways, process.measure)
    observed_here, expected_here = jnp.ravel(observed), jnp.ravel(expected)
    # A marker that is predicted behind the camera has no predicted image.
    there = jnp.isfinite(observed_here) & jnp.isfinite(expected_here)
    innovations = jnp.where(there, observed_here - expected_here, 0)
    # A missing value gets a zero row in C, so that it corrects nothing.
    seen = jnp.where(there[:, None], by_state, 0) @ root
    count, size = seen.shape
    upper = jnp.concatenate([jnp.diag(jnp.ravel(process.noise)), seen], axis=1)
    lower = jnp.concatenate([jnp.zeros((size, count), root.dtype), root], axis=1)
    both = lower_root(jnp.concatenate([upper, lower]))
    spread, gain = both[:count, :count], both[count:, :count]
    whitened = solve_triangular(spread, innovations, lower=True)
    corrected = Estimate(
        state=coordinates.moved(state, ways, gain @ whitened),
        root=both[count:, count:],
        steps=estimate.steps,
    )
    return Update(
        estimate=corrected,
        innovations=innovations.reshape(observed.shape),
        whitened=whitened,
        square=jnp.sum(whitened**2),
        count=jnp.sum(there),
    )
