r"""Identification: parameters of a simulation from observations, with uncertainty.

Least squares in units of the noise,

$$\min_p \sum_k \Big(\frac{y_k(p) - \hat y_k}{\sigma_k}\Big)^2,$$

over logarithms of positive parameters, by damped Gauss-Newton steps
(`least_squares`). The uncertainty follows from the Jacobian at the end (`Fit`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.identification.fit import NEAR, Fit, smallest_ratio, vague_ways
from jaxrod.control.identification.parameters import Parameters, make_parameters
from jaxrod.control.least_squares import least_squares
from jaxrod.validation import is_traced

Simulate = Callable[[dict[str, Any]], Any]
"""`parameters -> observations`; observations are any pytree of floats."""


def identify(
    simulate: Simulate,
    observed: Any,
    start: Mapping[str, Any],
    *,
    sd: Any = None,
    log: bool | Iterable[str] = True,
    lower: Mapping[str, Any] | None = None,
    upper: Mapping[str, Any] | None = None,
    iterations: int = 50,
    damping: float = 1e-3,
    tolerance: float | None = None,
    mode: str | None = None,
) -> Fit:
    """Finds the parameters that fit observations best, and their uncertainty.

    Pure: under `jax.jit` it is one program for all numbers, and `jax.vmap` makes many
    fits at once, of many films or of many draws of the noise. A point whose simulation
    blows up is rejected; the simulation at the start must not blow up.

    Args:
        simulate: Takes parameters by name and returns observations.
        observed: Observations, a pytree like the result of `simulate`. Values that are
            not finite count as not observed and are left out.
        start: First values: numbers or arrays by name.
        sd: Standard deviation of the noise, a number or a tree prefix of `observed`
            (one for each kind). If `None`, it is estimated from the residuals.
        log: Parameters that are positive and sought by their logarithm: all, none, or
            names.
        lower: Lower bounds, of all or some parameters. Those sought by their logarithm
            are bounded by a thousandth of the start by default.
        upper: Upper bounds; by default a thousand times the start for those sought by
            their logarithm. An explicit time step must be stable up to them.
        iterations: Largest number of iterations.
        damping: Damping of the first step, as a fraction of the diagonal [1]. More
            damping makes shorter first steps.
        tolerance: Tolerance, as in `least_squares`.
        mode: `"forward"` or `"reverse"`, as in `least_squares`.

    Returns:
        The fit; look at `converged`, `misfit` and `undetermined`, or print it.

    Raises:
        ValueError: Names or shapes do not fit, a number is out of range, nothing was
            observed, or several kinds are observed and `sd` is not given.
    """
    sought = make_sought(simulate, observed, start, sd, log, lower, upper)

    def residuals(point: Array) -> Any:
        made = simulate(sought.parameters.values(point))
        return jax.tree.map(
            lambda y, t, s, n: jnp.where(s, y - t, 0) / n,
            made,
            sought.target,
            sought.seen,
            sought.noise,
        )

    found = least_squares(
        residuals,
        jnp.zeros_like(sought.low),
        lower=sought.low,
        upper=sought.high,
        iterations=iterations,
        damping=damping,
        tolerance=tolerance,
        mode=mode,
    )
    return fit_of(sought, found)


class Sought(NamedTuple):
    """Checked arguments of an identification, as arrays."""

    parameters: Parameters
    """Names and scales of the parameters."""
    target: Any
    """Observations; zero where there is none."""
    seen: Any
    """Masks: whether each observation was made."""
    noise: Any
    """Standard deviations of the observations."""
    low: Array
    """Lower bounds of the search variables."""
    high: Array
    """Upper bounds of the search variables."""
    observations: Array
    """Number of observations."""
    noise_is_given: bool


def make_sought(
    simulate: Simulate,
    observed: Any,
    start: Mapping[str, Any],
    sd: Any,
    log: bool | Iterable[str],
    lower: Mapping[str, Any] | None,
    upper: Mapping[str, Any] | None,
) -> Sought:
    """Checks the arguments of `identify`.

    Raises:
        ValueError: An argument is invalid, as in `identify`.
    """
    parameters = make_parameters(start, log)
    _check_names("lower", lower, parameters)
    _check_names("upper", upper, parameters)
    seen = _checked(simulate, parameters, observed)
    noise = _noise(sd, observed)
    low, high = parameters.bound(lower, -1), parameters.bound(upper, 1)
    if not is_traced(low, high) and not np.all(np.asarray(low) < np.asarray(high)):
        raise ValueError(f"lower must be below upper, got {lower!r} and {upper!r}")
    count = sum((jnp.sum(s) for s in jax.tree.leaves(seen)), jnp.zeros((), jnp.int32))
    target = jax.tree.map(lambda o, s: jnp.where(s, o, 0), observed, seen)
    return Sought(parameters, target, seen, noise, low, high, count, sd is not None)


def fit_of(sought: Sought, found: Any, others: int = 0) -> Fit:
    """Makes a fit from the result of a search.

    Args:
        sought: Checked arguments of the identification.
        found: Result with `solution`, `residuals`, `jacobian` and `iterations`.
        others: Number of further unknowns, such as those of initial states.
    """
    parameters, seen, noise = sought.parameters, sought.seen, sought.noise
    given, bounds = sought.noise_is_given, (sought.low, sought.high)
    point = found.solution
    freedoms = sought.observations - point.size - others
    squares = jnp.sum(found.residuals**2)
    misfit = squares / jnp.maximum(freedoms, 1)
    unit = jnp.ones_like(misfit) if given else jnp.sqrt(misfit)
    safe = jnp.where(unit > 0, unit, 1)
    # If the start was not finite, the Jacobian is not, and the SVD would not end.
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
    # data determine, of parameters that no bound holds.
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
        freedoms=freedoms,
    )


def _decomposed(jacobian: Array) -> tuple[Array, Array]:
    """Returns singular values and right singular vectors (rows), one per unknown."""
    rows, columns = jacobian.shape
    if rows < columns:
        # With fewer observations than unknowns, the missing singular values are zero.
        empty = jnp.zeros((columns - rows, columns), jacobian.dtype)
        jacobian = jnp.concatenate([jacobian, empty])
    # The triangular factor of a QR decomposition has the same ones, and is small.
    triangle = jnp.linalg.qr(jacobian, mode="r")
    _, s, ways = jnp.linalg.svd(triangle, full_matrices=False)
    return s, ways


def _spreads(flat: Array, seen: Any, noise: Any) -> Any:
    """Returns the root mean square residual of each kind, in its units."""
    leaves, tree = jax.tree.flatten(seen)
    made, at = [], 0
    for mask, unit in zip(leaves, jax.tree.leaves(noise), strict=True):
        part = jnp.reshape(flat[at : at + mask.size], mask.shape) * unit
        made.append(jnp.sqrt(jnp.sum(part**2) / jnp.maximum(jnp.sum(mask), 1)))
        at += mask.size
    return jax.tree.unflatten(tree, made)


def _checked(simulate: Simulate, parameters: Parameters, observed: Any) -> Any:
    """Checks the observations, and returns masks of those that were made."""
    made = jax.eval_shape(simulate, parameters.start)
    wanted: Any = jax.tree.structure(made)
    given: Any = jax.tree.structure(observed)
    if wanted != given:
        raise ValueError(
            f"observed must be a tree as simulate makes, {wanted}, got {given}"
        )
    for y, o in zip(jax.tree.leaves(made), jax.tree.leaves(observed), strict=True):
        if y.shape != jnp.shape(o):
            raise ValueError(
                f"observed must have the shapes that simulate makes: {y.shape}, got "
                f"{jnp.shape(o)}"
            )
    seen = jax.tree.map(jnp.isfinite, observed)
    sizes = [math.prod(leaf.shape) for leaf in jax.tree.leaves(made)]
    if sum(sizes) == 0:
        raise ValueError("observed must hold at least one number")
    if not is_traced(seen):
        numbers = sum(int(np.sum(np.asarray(s))) for s in jax.tree.leaves(seen))
        if numbers == 0:
            raise ValueError("observed must hold at least one finite number")
    return seen


def _noise(sd: Any, observed: Any) -> Any:
    """Returns the standard deviations of all observations, as arrays or numbers."""
    leaves, tree = jax.tree.flatten(observed)
    if sd is None:
        if len(leaves) > 1:
            raise ValueError(
                "sd must be given for several kinds of observations, one for each: "
                "without it, metres would be weighed against newtons"
            )
        return jax.tree.map(lambda o: jnp.ones((), jnp.asarray(o).dtype), observed)
    for leaf in jax.tree.leaves(sd):
        if not is_traced(leaf) and not np.all(np.asarray(leaf) > 0):
            raise ValueError(f"sd must be positive, got {leaf!r}")
    try:
        full = jax.tree.broadcast(sd, observed)
    except ValueError as error:
        raise ValueError(
            "sd must be a number, or a tree as observed is or begins, got "
            f"{jax.tree.structure(sd)} for {tree}"
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
