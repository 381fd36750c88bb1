r"""The extended Kalman filter on the states of a model, in square-root form.

A prediction takes the estimate through a period and its covariance with the linear
model about it; a measurement corrects both:

$$P^- = A P A^T + B\,\mathrm{diag}(s^2) B^T + Q, \qquad S = C P^- C^T +
\mathrm{diag}(r^2), \qquad K = P^- C^T S^{-1},$$

$$x = x^- \oplus K (y - h(x^-)), \qquad P = (1 - K C) P^-.$$

Both are orthogonal transformations of roots of covariances, so that $P = L L^T$ stays
positive semidefinite whatever the rounding, also in float32.

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
from jaxrod.control.linear.linearisation import measured, period
from jaxrod.structure import pytree


@pytree
class Update:
    """An estimate corrected by a measurement, and how well the two agreed.

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
    """The corrected estimate."""
    innovations: Float[Array, "..."]
    """Measured minus expected, in the shape of the measurement; zero where missing."""
    whitened: Float[Array, " numbers"]
    """Innovations as independent numbers of variance one, if the filter is right."""
    square: Float[Array, ""]
    """Sum of their squares, whose mean is `count`, if the filter is right."""
    count: Int[Array, ""]
    """Number of numbers that were measured."""


def predict(process: Process, estimate: Estimate, control: Any = None) -> Estimate:
    """Estimate one period later. Pure; works inside jit and vmap.

    Args:
        process: The process.
        estimate: The estimate at the beginning of the period.
        control: The known control that is held; zeros by default.

    Raises:
        ValueError: If the control or the estimate has another shape.
        TypeError: If `process` or `estimate` is of another type.

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
    """Estimate corrected by a measurement. Pure; works inside jit and vmap.

    Args:
        process: The process.
        estimate: The estimate at the time of the measurement.
        observed: The measurement. Numbers that are not finite, or not expected to be,
            count as missing.

    Returns:
        The corrected estimate, and the innovations.

    Raises:
        ValueError: If the measurement or the estimate has another shape.
        TypeError: If `process` or `estimate` is of another type.

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
    """Measurements as an array.

    Raises:
        ValueError: If they have another shape.
    """
    seen = jnp.asarray(observed, process.dt.dtype)
    if seen.shape != shape:
        raise ValueError(
            f"observed must have shape {shape}, as measure makes it, got {seen.shape}"
        )
    return seen


def lower_root(*blocks: Array) -> Array:
    """Lower triangular root of the sum of the covariances whose roots are given."""
    return jnp.linalg.qr(jnp.concatenate(blocks, axis=1).T, mode="r").T


@jax.jit
def _spread(process: Process, root: Array, by_state: Array, by_control: Array) -> Array:
    """Root of the covariance after a period."""
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
    # A marker that is expected behind the camera has no expectation to compare with.
    there = jnp.isfinite(observed_here) & jnp.isfinite(expected_here)
    innovations = jnp.where(there, observed_here - expected_here, 0)
    # A number that is missing is one that does not depend on the state.
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
