r"""Identification: parameters of a simulation from observations, with uncertainty.

It minimises the squared residuals in units of the noise,

$$\min_p \sum_k \Big(\frac{y_k(p) - \hat y_k}{\sigma_k}\Big)^2,$$

over logarithms of positive parameters, by damped Gauss-Newton steps
(`least_squares`, or `windowed_least_squares` for windows with unknown initial states).
The uncertainty follows from the Jacobian at the end (`Fit`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxrod.control.identification.multiple_shooting import windowed_least_squares
from jaxrod.control.identification.parameters import Parameters, make_parameters
from jaxrod.control.identification.result import NEAR, Fit, smallest_ratio, vague_ways
from jaxrod.control.identification.windows import MultipleShooting
from jaxrod.control.least_squares import least_squares
from jaxrod.structure import pytree, static
from jaxrod.validation import is_traced

Simulate = Callable[..., Any]
"""`parameters -> observations`; observations are any pytree of floats."""
CLOSED = 1.0
"""Norm of the change of all residuals by closing the gaps between windows, in standard
deviations, below which gaps count as closed. The error of the fit is then of second
order in the gaps."""


def fit(
    simulate: Simulate,
    observed: Any,
    start: Mapping[str, Any],
    *,
    multiple_shooting: MultipleShooting | None = None,
    noise: Any = None,
    logarithmic: bool | Iterable[str] = True,
    scales: Mapping[str, Any] | None = None,
    lower: Mapping[str, Any] | None = None,
    upper: Mapping[str, Any] | None = None,
    iterations: int = 50,
    initial_damping: Any = None,
    tolerance: Any = None,
    mode: str | None = None,
) -> Fit:
    """Finds the parameters that fit observations best, and their uncertainty.

    The function is pure: under `jax.jit` it is one program for all numbers, and
    `jax.vmap` makes many fits at once, to many recordings or with many draws of the
    noise. The search rejects a point whose simulation blows up. The simulation at the
    initial guess must not blow up.

    Args:
        simulate: Takes parameters by name and returns observations. With
            `multiple_shooting` it runs one window: it takes parameters, the window's
            initial state and its known data, and returns the window's observations; for
            joined windows, also the initial state of the next window. Without windows,
            a second fit with the same function does not trace it again.
        observed: Observations, a pytree like the result of `simulate`. Values that are
            not finite count as not observed and are left out. With `multiple_shooting`
            they are stacked on the leading axis by window, or by trajectory and window
            for joined windows. Each observation must belong to one window only, or it
            counts twice.
        start: Initial guess of the parameters: numbers or arrays by name.
        multiple_shooting: Windows whose initial states are unknown too.
        noise: Standard deviation of the noise, a number or a tree prefix of `observed`
            (one number per kind of observation). If `None`, it is estimated from the
            residuals.
        logarithmic: Positive parameters that are found by their logarithm: all
            (`True`), none (`False`), or names.
        scales: Scales of changes of parameters that are not found by their logarithm.
            A parameter with a larger standard deviation counts as not determined. By
            default the absolute values of `start`, and 1 where that is 0.
        lower: Lower bounds of some or all parameters, by name. The default is a
            thousandth of `start` for parameters found by their logarithm, and none for
            others.
        upper: Upper bounds, given the same way; by default a thousand times `start` for
            parameters found by their logarithm. An explicit time step must be stable up
            to these bounds.
        iterations: Largest number of points tried after the initial guess.
        initial_damping: Damping of the first step, relative to the diagonal of
            $J^T J$, where $J$ is the Jacobian of the residuals [1]; by default 1e-3,
            and 1e-2 for joined windows. More damping makes the first steps shorter.
        tolerance: Relative change of the sum of squares at which the search ends, as in
            `least_squares`.
        mode: `"forward"` or `"reverse"`, as in `least_squares`. Windows are always
            differentiated forward.

    Returns:
        The fit; look at `converged`, `misfit` and `undetermined`, or print it. With
        `multiple_shooting` it has the initial states too, and its standard deviations
        account for their unknowns. For joined windows `converged` also means that
        closing the remaining gaps would change all observations together by less than
        one standard deviation.

    Raises:
        ValueError: Names, shapes or numbers of windows do not match, a number is out of
            range, nothing was observed, or several kinds are observed and `noise` is
            not given.

    Example:
        >>> x = jnp.arange(5.0)
        >>> seen = jnp.array([0.1, 2.9, 6.1, 9.0, 11.9])
        >>> line = lambda p: p["slope"] * x
        >>> print(control.fit(line, seen, {"slope": 1.0}, noise=0.1))
        parameter         value           sd
        slope              2.99        0.018
        residual sd of observations: 0.086
        misfit 0.925 over 4 degrees of freedom; ... iterations
    """
    windows = multiple_shooting
    if windows is None:
        whole = simulate
    else:
        windows.check(simulate, observed, start)
        whole = windows.simulation(simulate)
    problem = make_fit_problem(
        whole, observed, start, noise, logarithmic, lower, upper, scales
    )
    damping = initial_damping
    if damping is None:
        damping = 1e-2 if windows is not None and windows.joined else 1e-3
    if windows is not None:
        if mode == "reverse":
            raise ValueError('mode must be "forward" with multiple_shooting')
        return _fit_windows(simulate, problem, windows, iterations, damping, tolerance)

    try:
        hash(simulate)
    except TypeError:
        # An object that is called, with arrays in it: compiled for this call alone.
        simulate = partial(simulate)
    return _fit_whole(simulate, problem, damping, tolerance, iterations, mode)


@partial(jax.jit, static_argnames=("simulate", "iterations", "mode"))
def _fit_whole(
    simulate: Simulate,
    problem: FitProblem,
    damping: Any,
    tolerance: Any,
    iterations: int,
    mode: str | None,
) -> Fit:
    """Fits parameters alone: the search and its uncertainty, as one program."""

    def residuals(point: Array) -> Any:
        made = simulate(problem.parameters.values(point))
        return _misses(made, problem.target, problem.seen, problem.noise)

    found = least_squares(
        residuals,
        jnp.zeros_like(problem.low),
        lower=problem.low,
        upper=problem.high,
        iterations=iterations,
        initial_damping=damping,
        tolerance=tolerance,
        mode=mode,
    )
    return fit_of(problem, found)


def _fit_windows(
    simulate: Simulate,
    problem: FitProblem,
    windows: MultipleShooting,
    iterations: int,
    damping: Any,
    tolerance: Any,
) -> Fit:
    """Fits parameters together with the unknown initial states of windows.

    `problem` holds the checked arguments of `fit`; `damping` is its `initial_damping`.
    """
    values = problem.parameters.values
    noise = jax.tree.map(
        lambda n, t: jnp.broadcast_to(n, t.shape), problem.noise, problem.target
    )
    given = (windows.known, problem.target, problem.seen, noise)
    states = windows.states
    if not windows.joined:
        # Each window is a separate trajectory without an end state.
        first = jax.vmap(windows.state, (None, 0, 0))(
            problem.parameters.start, windows.unknowns, windows.known
        )
        states, given = jax.tree.map(
            lambda leaf: jnp.asarray(leaf)[:, None], (first, given)
        )

    def residuals(point: Array, state: Any, given: Any) -> tuple[Any, Any]:
        known, *others = given
        made = simulate(values(point), state, known)
        made, end = made if windows.joined else (made, state)
        return _misses(made, *others), end

    found = windowed_least_squares(
        residuals,
        lambda point, own, given: windows.state(values(point), own, given[0]),
        jnp.zeros_like(problem.low),
        windows.unknowns,
        states,
        given,
        lower=problem.low,
        upper=problem.high,
        iterations=iterations,
        initial_damping=damping,
        tolerance=tolerance,
    )
    numbers = sum(np.size(leaf) for leaf in jax.tree.leaves(windows.unknowns))
    result = fit_of(problem, found, numbers)
    spread = jnp.ones_like(found.gap)
    if not problem.noise_is_given:
        squares = jnp.sum(found.residuals**2)
        spread = jnp.sqrt(squares / jnp.maximum(result.degrees_of_freedom, 1))
    # Independent windows have no gaps to close.
    closed = found.gap < CLOSED * spread if windows.joined else True
    return replace(
        result,
        converged=result.converged & closed,
        unknowns=found.own,
        states=found.states
        if windows.joined
        else jax.tree.map(lambda leaf: leaf[:, 0], found.states),
    )


def _misses(made: Any, target: Any, seen: Any, noise: Any) -> Any:
    """Residuals (made - target) / noise; zero where `seen` is False."""
    return jax.tree.map(
        lambda y, t, s, n: jnp.where(s, y - t, 0) / n, made, target, seen, noise
    )


@pytree
class FitProblem:
    """Checked arguments of `fit`, as arrays."""

    parameters: Parameters
    """Names and scales of the parameters."""
    target: Any
    """Observations; zero where they are missing."""
    seen: Any
    """Masks like `target`: True where an observation is finite."""
    noise: Any
    """Standard deviations of the noise of the observations."""
    low: Array
    """Lower bounds of the search variables, see `Parameters`."""
    high: Array
    """Upper bounds of the search variables, see `Parameters`."""
    observations: Array
    """Number of finite observations."""
    noise_is_given: bool = static()
    """Whether `noise` is known, not to be estimated from the residuals."""


def make_fit_problem(
    simulate: Simulate,
    observed: Any,
    start: Mapping[str, Any],
    noise: Any,
    logarithmic: bool | Iterable[str],
    lower: Mapping[str, Any] | None,
    upper: Mapping[str, Any] | None,
    scales: Mapping[str, Any] | None = None,
) -> FitProblem:
    """Validates arguments of `fit` and returns them as a `FitProblem`.

    Raises:
        ValueError: An argument is invalid, as in `fit`.
    """
    parameters = make_parameters(start, logarithmic, scales)
    _check_names("lower", lower, parameters)
    _check_names("upper", upper, parameters)
    seen = _checked(simulate, parameters, observed)
    deviations = _noise(noise, observed)
    low, high = _bounds(parameters, lower, upper)
    if not is_traced(low, high) and not np.all(np.asarray(low) < np.asarray(high)):
        raise ValueError(f"lower must be below upper, got {lower!r} and {upper!r}")
    target, count = _seen_and_counted(observed, seen)
    return FitProblem(
        parameters, target, seen, deviations, low, high, count, noise is not None
    )


@partial(jax.jit, static_argnames="others")
def fit_of(problem: FitProblem, found: Any, others: int = 0) -> Fit:
    """Makes a `Fit`, with covariance and misfit, from the result of a search.

    Args:
        problem: Checked arguments of the identification.
        found: Result with `solution`, `residuals`, `jacobian` and `iterations`.
        others: Number of further unknowns, such as those of initial states.
    """
    parameters, seen, noise = problem.parameters, problem.seen, problem.noise
    given, bounds = problem.noise_is_given, (problem.low, problem.high)
    point = found.solution
    degrees_of_freedom = problem.observations - point.size - others
    squares = jnp.sum(found.residuals**2)
    misfit = squares / jnp.maximum(degrees_of_freedom, 1)
    unit = jnp.ones_like(misfit) if given else jnp.sqrt(misfit)
    safe = jnp.where(unit > 0, unit, 1)
    # If the start is not finite, the Jacobian is not either: the SVD would not end.
    sound = jnp.all(jnp.isfinite(found.jacobian)) & jnp.isfinite(squares)
    jacobian = jnp.where(sound, found.jacobian, 0) / safe
    s, ways = _decomposed(jacobian)
    least = jnp.finfo(s.dtype).tiny ** 0.25
    inverse = 1 / jnp.maximum(s, least)
    covariance = (ways.T * inverse[None] ** 2) @ ways
    hidden = s <= smallest_ratio(s.dtype) * s[:1]
    shared = jnp.any(hidden[:, None] & (ways**2 > 1e-4), axis=0)
    sds = jnp.abs(parameters.slopes(point)) * jnp.sqrt(jnp.diagonal(covariance))
    low, high = bounds
    at_bound = (point <= low) | (point >= high)
    # The remaining Gauss-Newton step in standard deviations, along directions that the
    # data determine, for parameters that are not at a bound.
    pull = (found.residuals / safe) @ jacobian
    pull = jnp.where(sound & ~at_bound, pull, 0)
    left = jnp.where(vague_ways(s), 0, (ways @ pull) * inverse)
    remaining = jnp.where(sound, jnp.sqrt(jnp.sum(left**2)), jnp.inf)
    return Fit(
        parameters=parameters,
        values=parameters.values(point),
        standard_deviations=parameters.named(jnp.where(shared, jnp.inf, sds)),
        covariance=covariance,
        singular_values=s,
        directions=ways,
        residual_sd=_spreads(found.residuals, seen, noise),
        misfit=misfit if given else misfit / safe**2,
        remaining=remaining,
        converged=remaining < NEAR,
        iterations=found.iterations,
        at_bound=at_bound,
        degrees_of_freedom=degrees_of_freedom,
    )


@jax.jit
def _bounds(
    parameters: Parameters,
    lower: Mapping[str, Any] | None,
    upper: Mapping[str, Any] | None,
) -> tuple[Array, Array]:
    """Lower and upper bounds of the search variables."""
    return parameters.bound(lower, -1), parameters.bound(upper, 1)


@jax.jit
def _seen_and_counted(observed: Any, seen: Any) -> tuple[Any, Array]:
    """Observations with zeros for those that are not `seen`, and the number of seen."""
    count = sum((jnp.sum(s) for s in jax.tree.leaves(seen)), jnp.zeros((), jnp.int32))
    return jax.tree.map(lambda o, s: jnp.where(s, o, 0), observed, seen), count


def _decomposed(jacobian: Array) -> tuple[Array, Array]:
    """Returns the singular values of a Jacobian and its right singular vectors (rows).

    There is one of each per unknown; missing singular values are zero.
    """
    rows, columns = jacobian.shape
    if rows < columns:
        # With fewer observations than unknowns, the missing singular values are zero.
        empty = jnp.zeros((columns - rows, columns), jacobian.dtype)
        jacobian = jnp.concatenate([jacobian, empty])
    # The triangular factor of a QR decomposition has the same singular values and is
    # small.
    triangle = jnp.linalg.qr(jacobian, mode="r")
    _, s, ways = jnp.linalg.svd(triangle, full_matrices=False)
    return s, ways


def _spreads(flat: Array, seen: Any, noise: Any) -> Any:
    """Root mean square residual of each kind of observation, in its unit.

    `flat` has all residuals in units of the noise; `seen` and `noise` are trees like
    the observations, of masks and of standard deviations.
    """
    _, unravel = ravel_pytree(jax.tree.map(lambda s: s.astype(flat.dtype), seen))
    return jax.tree.map(
        lambda r, s, n: jnp.sqrt(jnp.sum((r * n) ** 2) / jnp.maximum(jnp.sum(s), 1)),
        unravel(flat),
        seen,
        noise,
    )


def _checked(simulate: Simulate, parameters: Parameters, observed: Any) -> Any:
    """Validates observations, and returns masks that are True where they are finite.

    `observed` must have the structure and shapes that `simulate` returns at the initial
    guess of `parameters`, where it is traced.
    """
    made = jax.eval_shape(simulate, parameters.start)
    wanted: Any = jax.tree.structure(made)
    given: Any = jax.tree.structure(observed)
    if wanted != given:
        raise ValueError(
            f"observed must have the tree structure that simulate returns, {wanted}, "
            f"got {given}"
        )
    for y, o in zip(jax.tree.leaves(made), jax.tree.leaves(observed), strict=True):
        if y.shape != jnp.shape(o):
            raise ValueError(
                f"observed must have the shapes that simulate returns: {y.shape}, got "
                f"{jnp.shape(o)}"
            )
    seen = jax.tree.map(jnp.isfinite, observed)
    if sum(leaf.size for leaf in jax.tree.leaves(made)) == 0:
        raise ValueError("observed must hold at least one number")
    if not is_traced(seen):
        numbers = sum(int(np.sum(np.asarray(s))) for s in jax.tree.leaves(seen))
        if numbers == 0:
            raise ValueError("observed must hold at least one finite number")
    return seen


def _noise(noise: Any, observed: Any) -> Any:
    """Returns standard deviations of all observations; ones if `noise` is `None`.

    `noise` is a number or a tree prefix of `observed`; it must be given if `observed`
    has several leaves.
    """
    leaves, tree = jax.tree.flatten(observed)
    if noise is None:
        if len(leaves) > 1:
            raise ValueError(
                "noise must be given for each kind if there are several kinds of "
                "observations: without it, metres would be weighed against newtons"
            )
        return jax.tree.map(lambda o: jnp.ones((), jnp.asarray(o).dtype), observed)
    for leaf in jax.tree.leaves(noise):
        if not is_traced(leaf) and not np.all(np.asarray(leaf) > 0):
            raise ValueError(f"noise must be positive, got {leaf!r}")
    try:
        full = jax.tree.broadcast(noise, observed)
    except ValueError as error:
        raise ValueError(
            "noise must be a number or a tree prefix of observed, got "
            f"{jax.tree.structure(noise)} for {tree}"
        ) from error
    return jax.tree.map(
        lambda s, o: jnp.broadcast_to(
            jnp.asarray(s, jnp.asarray(o).dtype), jnp.shape(o)
        ),
        full,
        observed,
    )


def _check_names(
    what: str, given: Mapping[str, Any] | None, parameters: Parameters
) -> None:
    strange = [name for name in given or () if name not in parameters.start]
    if strange:
        raise ValueError(
            f"{what} names {', '.join(strange)}, which start does not: it has "
            f"{', '.join(parameters.start)}"
        )
