r"""Identification by multiple shooting with continuity between windows.

The observations are of trajectories, each cut into windows, $w = 1 \dots W$, whose
states are not known. The parameters $p$, and the unknowns $s$ of the first state of
each trajectory, are found together,

$$\min_{p, s} \sum_w \sum_k
\Big(\frac{y_{wk}(p, x_w) - \hat y_{wk}}{\sigma_{wk}}\Big)^2, \qquad
x_1 = b(p, s), \quad x_{w+1} = e_w(p, x_w).$$

The minimum, and its standard deviations, are those of one long run from $b(p, s)$: the
initial states of later windows are not free unknowns. During the search windows may
leave gaps, so that they follow the data across bifurcations, where a single long run
would lose them.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983; for the solution method see `joined_least_squares`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.identification.fit import Fit
from jaxrod.control.identification.identify import fit_of, make_sought
from jaxrod.control.identification.joined_least_squares import joined_least_squares
from jaxrod.control.identification.shots import check_finite_floats, count_windows

CLOSED = 1.0
"""Bound on the change of all residuals by closing the gaps (norm), below which the gaps
count as closed. What the fit does not contain is of second order in the gaps."""


def identify_continuous(
    run: Callable[[dict[str, Any], Any, Any], tuple[Any, Any]],
    begin: Callable[[dict[str, Any], Any, Any], Any],
    observed: Any,
    start: Mapping[str, Any],
    starts: Any,
    states: Any,
    *,
    known: Any = (),
    sd: Any = None,
    log: bool | Iterable[str] = True,
    lower: Mapping[str, Any] | None = None,
    upper: Mapping[str, Any] | None = None,
    iterations: int = 50,
    damping: Any = 1e-2,
    tolerance: Any = None,
) -> tuple[Fit, Any, Any]:
    """Finds the parameters that fit whole trajectories best, window by window.

    It needs first parameters within a few tens of per cent of those sought, and first
    states as near as the observations show them (`identify_shots` finds such parameters
    from farther away). One evaluation costs about one run of all windows, one after the
    other, with a tangent for each parameter and for each unknown of a first state.

    Args:
        run: Takes parameters, the initial state of a window, and the known data of the
            window; returns its observations, and the initial state of the next window.
        begin: Takes parameters, the unknowns of a trajectory's first state, and the
            known data of its first window; returns that state.
        observed: Observations, stacked by trajectory and window on the leading axes.
            Values that are not finite count as not observed and are left out.
        start: First values of the parameters: numbers or arrays by name.
        starts: First values of the unknowns of first states: a pytree of floats,
            stacked by trajectory on the leading axis; `jnp.zeros((trajectories, 0))` if
            there are none.
        states: First values of the initial states of windows: a pytree of finite floats
            like the result of `begin`, stacked by trajectory and window on the leading
            axes. Those of first windows are ignored.
        known: Known data of each window, stacked the same way.
        sd: Standard deviation of the noise, as in `identify`; a tree prefix of
            `observed`, of numbers or arrays that broadcast to the observations,
            `(trajectories, windows, ...)`.
        log: Parameters sought by their logarithm, as in `identify`.
        lower: Lower bounds of the parameters, as in `identify`.
        upper: Upper bounds of the parameters, as in `identify`.
        iterations: Largest number of points tried after the first.
        damping: Damping of the first step, as a fraction of the diagonal [1]. More
            damping makes shorter first steps.
        tolerance: Relative change of the sum of squares at which the search ends.

    Returns:
        The fit, whose standard deviations account for the unknown first states; the
        unknowns of first states; and the initial states of windows. `converged` also
        means that closing the remaining gaps would change all observations together by
        less than one standard deviation. `remaining` includes that change.

    Raises:
        ValueError: An argument is invalid, as in `identify`; or trajectories or windows
            are not equally many everywhere; or a start or a state is not of finite
            floats; or `run` ends in another kind of state than `begin` returns.
    """
    _check_counts(starts, states, known, observed)
    check_finite_floats("starts", starts)
    later = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, 1:], states)
    check_finite_floats("states", later)

    def simulate(values: dict[str, Any]) -> Any:
        return jax.vmap(jax.vmap(run, in_axes=(None, 0, 0)), in_axes=(None, 0, 0))(
            values, states, known
        )[0]

    values = {name: jnp.asarray(value) for name, value in start.items()}
    _check_states(run, begin, values, starts, states, known)
    sought = make_sought(simulate, observed, start, sd, log, lower, upper)

    def residuals(point: Array, state: Any, given: Any) -> tuple[Any, Any]:
        knowing, target, seen, noise = given
        made, end = run(sought.parameters.values(point), state, knowing)
        apart = jax.tree.map(
            lambda y, t, s, n: jnp.where(s, y - t, 0) / n, made, target, seen, noise
        )
        return apart, end

    def opening(point: Array, own: Any, given: Any) -> Any:
        return begin(sought.parameters.values(point), own, given[0])

    noise = jax.tree.map(
        lambda n, t: jnp.broadcast_to(n, t.shape), sought.noise, sought.target
    )
    found = joined_least_squares(
        residuals,
        opening,
        jnp.zeros_like(sought.low),
        starts,
        states,
        (known, sought.target, sought.seen, noise),
        lower=sought.low,
        upper=sought.high,
        iterations=iterations,
        damping=damping,
        tolerance=tolerance,
    )
    numbers = sum(np.size(leaf) for leaf in jax.tree.leaves(starts))
    fit = fit_of(sought, found, numbers)
    spread = jnp.ones_like(found.gap)
    if not sought.noise_is_given:
        squares = jnp.sum(found.residuals**2)
        spread = jnp.sqrt(squares / jnp.maximum(fit.freedoms, 1))
    closed = found.gap < CLOSED * spread
    return replace(fit, converged=fit.converged & closed), found.own, found.states


def _check_counts(starts: Any, states: Any, known: Any, observed: Any) -> None:
    """Checks that the numbers of trajectories and windows agree everywhere.

    Raises:
        ValueError: They do not.
    """
    trajectories = count_windows(starts)
    leaves = jax.tree.leaves((states, known, observed))
    counts = {np.shape(leaf)[:2] for leaf in leaves}
    if len(counts) != 1 or {(len(c), *c[:1]) for c in counts} != {(2, trajectories)}:
        raise ValueError(
            "states, known and observed must be stacked in front by trajectory and "
            f"window, for {trajectories} trajectories, got {sorted(counts)}"
        )


def _check_states(
    run: Any, begin: Any, values: Any, starts: Any, states: Any, known: Any
) -> None:
    """Checks that all states have the same tree structure and shapes.

    Raises:
        ValueError: They do not.
    """
    own = jax.tree.map(lambda leaf: leaf[0], starts)
    state, knowing = jax.tree.map(lambda leaf: leaf[0, 0], (states, known))
    wanted = jax.eval_shape(lambda: state)
    made = jax.eval_shape(begin, values, own, knowing)
    end = jax.eval_shape(lambda *given: run(*given)[1], values, state, knowing)
    tree: Any = jax.tree.structure(wanted)
    for what, kind in (("begin must make", made), ("run must end in", end)):
        if jax.tree.structure(kind) != tree or _shapes(kind) != _shapes(wanted):
            raise ValueError(
                f"{what} a state as states are, {_shapes(wanted)}, got {_shapes(kind)}"
            )


def _shapes(state: Any) -> list[tuple[int, ...]]:
    return [leaf.shape for leaf in jax.tree.leaves(state)]
