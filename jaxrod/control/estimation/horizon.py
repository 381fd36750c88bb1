r"""Moving-horizon estimation: the most likely motion over a window of measurements.

The unknowns are the error $\xi$ of the state at the beginning of the window and, in
each period, the disturbances $w_k$ of the control and $v_k$ of the state. They solve
the least-squares problem

$$\min_{\xi, w, v}\ |\xi|^2 + \sum_k |w_k|^2 + |v_k|^2 + \Big|\frac{y_k - h(x_k)}{r}
\Big|^2, \quad x_0 = \bar x \oplus L \xi, \quad x_{k+1} = f(x_k, u_k + s\,w_k) \oplus
R\,v_k,$$

where $f$ simulates a period, $h$ is the measurement and $\oplus$ adds local
coordinates. All unknowns are in units of their standard deviations: $s$ for the
control, $R$ with $R R^T = Q$ for the state, and $r$ for the measurement. Covariances
may therefore be singular. The first term is the arrival cost: the estimate
$(\bar x, L L^T)$ from all measurements before the window. For a linear model the result
is that of the Kalman filter.

Source: C. V. Rao, J. B. Rawlings, D. Q. Mayne, Constrained state estimation for
nonlinear discrete-time systems, IEEE Trans. Automatic Control 48, 2003.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from jaxrod.control.estimation.kalman import check_observed, lower_root
from jaxrod.control.estimation.process import Estimate, Process, check_estimate
from jaxrod.control.least_squares import least_squares
from jaxrod.stepping.runs import advance
from jaxrod.structure import pytree
from jaxrod.validation import as_array, check_count


@pytree
class Horizon:
    """Most likely motion over a window of measurements, found by `moving_horizon`.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> loose = process.coordinates.filled(velocity=0.1)
        >>> arrival = estimation.first_estimate(process, state, loose**2)
        >>> seen = jnp.stack([state.tip, state.tip])
        >>> found = estimation.moving_horizon(process, arrival, seen, iterations=2)
        >>> int(found.estimate.steps), found.disturbances is None
        (20, True)
    """

    estimate: Estimate
    """Estimate at the end of the window."""
    states: Any
    """States at the beginning of the window and after each period, stacked on the
    leading axis."""
    disturbances: Float[Array, "periods ..."] | None
    """Estimated disturbance of the control in each period, in the control's unit; it
    adds to the known control. `None` for a process without control."""
    square: Float[Array, ""]
    """Minimum of the sum of squares. If the model is right, its expected value is the
    number of measured values."""
    converged: Bool[Array, ""]
    """Whether the search ended because a step changed too little."""


def moving_horizon(
    process: Process,
    arrival: Estimate,
    observed: Any,
    controls: Any = None,
    *,
    iterations: int = 20,
) -> Horizon:
    """Finds the most likely motion over a window of measurements. Pure.

    Every iteration simulates the window once per unknown, as one batch, so keep the
    window short. A filter on the earlier measurements can give `arrival`.

    Args:
        process: The process.
        arrival: Estimate at the beginning of the window, from all earlier measurements.
        observed: Measurements at the ends of all periods, stacked on the leading axis.
            Values that are not finite count as missing.
        controls: Known controls of all periods, stacked on the leading axis; zeros by
            default.
        iterations: Largest number of iterations.

    Raises:
        ValueError: If shapes do not match.
        TypeError: If `process` or `arrival` has the wrong type.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> loose = process.coordinates.filled(velocity=0.1)
        >>> arrival = estimation.first_estimate(process, state, loose**2)
        >>> seen = jnp.stack([state.tip, state.tip])  # at the ends of two periods
        >>> found = estimation.moving_horizon(process, arrival, seen, iterations=2)
        >>> found.states.positions.shape  # three moments
        (3, 3, 11)
    """
    check_estimate(process, arrival, "arrival")
    iterations = check_count("iterations", iterations, 1)
    count = check_count("number of periods", jnp.shape(observed)[0], 1)
    shape = (count, *process.noise.shape)
    seen = check_observed(process, observed, shape)
    # Without controls, `control` raises if any are given, and returns None.
    nothing = process.control(None if process.control_noise is not None else controls)
    known = None
    if nothing is not None:
        known = jnp.stack([nothing] * count)
    if nothing is not None and controls is not None:
        wanted = (count, *nothing.shape)
        known = as_array("controls", controls, "", [wanted], dtype=process.dt.dtype)
    return _solved(process, arrival, seen, known, iterations=iterations)


@jax.jit(static_argnames="iterations")
def _solved(
    process: Process,
    arrival: Estimate,
    observed: Array,
    controls: Array | None,
    *,
    iterations: int,
) -> Horizon:
    coordinates, dtype = process.coordinates, process.dt.dtype
    count = len(observed)
    there = jnp.isfinite(observed)
    target = jnp.where(there, observed, 0)
    unknowns = {"start": jnp.zeros(arrival.root.shape[1], dtype)}
    if controls is not None:
        unknowns["control"] = jnp.zeros_like(controls)
    if process.state_root is not None:
        unknowns["state"] = jnp.zeros((count, coordinates.size), dtype)
    numbers = arrival.steps + process.n_steps * jnp.arange(count, dtype=jnp.int32)

    def moved(state: Any, root: Array, own: Array, steps: Array) -> Any:
        ways = coordinates.directions(state, first=steps)
        return coordinates.moved(state, ways, root @ own)

    def disturbance(unknown: Any) -> Any:
        if process.control_noise is None:
            return None
        return process.control_noise[None] * unknown["control"]

    def motion(unknown: Any) -> tuple[Any, Any]:
        """Simulates the window with the unknowns xi, w and v of the module's formula.

        Returns the states at the beginning of the window and after each period, and the
        residuals (y - h(x)) / r of the measurements, zero for missing values.
        """

        def one(state: Any, given: Any) -> tuple[Any, Any]:
            begin, control, push, target, there = given
            model = process.model
            if control is not None and process.with_control is not None:
                model = process.with_control(model, control)
            after = advance(model, state, process.dt, process.n_steps, first=begin)
            end = begin + process.n_steps
            if process.state_root is not None:
                after = moved(after, process.state_root, push, end)
            made = process.measure(process.at(end).recalling(after), after)
            seen = there & jnp.isfinite(made)
            miss = jnp.where(seen, target - made, 0) / process.noise
            return after, (after, miss)

        start = moved(arrival.state, arrival.root, unknown["start"], arrival.steps)
        driven = disturbance(unknown)
        total = None if driven is None else controls + driven
        given = numbers, total, unknown.get("state"), target, there
        _, (states, misses) = lax.scan(one, start, given)
        whole = jax.tree.map(
            lambda first, rest: jnp.concatenate([first[None], rest]), start, states
        )
        return whole, misses

    def residuals(unknown: Any) -> Any:
        return unknown, motion(unknown)[1]

    found = least_squares(residuals, unknowns, iterations=iterations, mode="forward")
    states, _ = motion(found.solution)
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    point, unravel = ravel_pytree(found.solution)

    def ends(point: Array) -> Array:
        whole, _ = motion(unravel(point))
        return coordinates.difference(last, jax.tree.map(lambda leaf: leaf[-1], whole))

    # The covariance of the unknowns is (J'J)^-1 = (U'U)^-1, with J = Q U.
    triangle = jnp.linalg.qr(found.jacobian, mode="r")
    by_unknowns = jax.vmap(lambda way: jax.jvp(ends, (point,), (way,))[1], out_axes=1)(
        jnp.eye(point.size, dtype=dtype)
    )
    wide = solve_triangular(triangle, by_unknowns.T, trans="T").T
    return Horizon(
        estimate=Estimate(
            last, lower_root(wide), arrival.steps + count * process.n_steps
        ),
        states=states,
        disturbances=disturbance(found.solution),
        square=found.cost,
        converged=found.converged,
    )
