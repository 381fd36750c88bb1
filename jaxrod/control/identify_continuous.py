r"""Identification by multiple shooting whose windows end where the next ones begin.

Observations of trajectories, each cut into windows, $w = 1 \dots W$, whose states are
not known. Parameters $p$ and what the first state of each trajectory is made of, $s$,
are found together,

$$\min_{p, s} \sum_w \sum_k
\Big(\frac{y_{wk}(p, x_w) - \hat y_{wk}}{\sigma_{wk}}\Big)^2, \qquad
x_1 = b(p, s), \quad x_{w+1} = e_w(p, x_w).$$

The minimum is that of one long run from $b(p, s)$, and so are its standard deviations:
the states of later windows are no unknowns of the data. On the way there windows need
not fit together, so that data are followed across forks, where one long run is lost.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983; how it is solved: `joined_least_squares`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.fit import Fit
from jaxrod.control.identify import fit_of, make_sought
from jaxrod.control.joined_least_squares import joined_least_squares
from jaxrod.control.shots import check_finite_floats, count_windows

CLOSED = 1.0
"""Norm of what gaps change in all residuals below which they count as closed: what is
not in the fit yet is of second order in them."""


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
    """Parameters that explain whole trajectories best, followed window by window.

    It needs parameters and states near those sought: within a few tens of per cent and
    as near as observations show them (`identify_shots` finds such parameters from
    farther off). One evaluation costs about a run of all windows, one after the other,
    with a tangent for each parameter and each number of a start.

    Args:
        run: Takes parameters, the state at the start of a window, and what is known of
            the window; makes its observations, and the state at which the next begins.
        begin: Takes parameters, what is sought of the first state of a trajectory, and
            what is known of its first window; makes that state.
        observed: What was observed, stacked in front by trajectory and window. What is
            not finite was not seen and is left out.
        start: Where to begin: numbers or arrays by name.
        starts: Where what is sought of first states begins: a pytree of floats, stacked
            in front by trajectory; `jnp.zeros((trajectories, 0))` if nothing is.
        states: Where the states at the starts of windows begin: a pytree of finite
            floats as `begin` makes, stacked in front by trajectory and window. Those of
            first windows are not looked at.
        known: What is known of each window and not sought, stacked alike.
        sd: As in `identify`; a tree as `observed` is or begins, of numbers or arrays
            that broadcast to what was observed, `(trajectories, windows, ...)`.
        log: As in `identify`, and so are `lower`, `upper`, `iterations`.
        lower: Smallest values.
        upper: Largest values.
        iterations: Points tried after the first, at most.
        damping: Of the first step, a share [1]. More of it makes shorter first steps.
        tolerance: Relative change of the sum of squares below which it is done.

    Returns:
        The fit, whose standard deviations count the starts as unknown; what was sought
        of first states; the states at the starts of windows. `converged` says too that
        closing what gaps are left would change the observations by less than a standard
        deviation, all of them together; `remaining` has counted that change.

    Raises:
        ValueError: As `identify`; or trajectories or windows are not equally many
            everywhere; or a start or a state is not of finite floats, or `run` ends in
            another kind of state than `begin` makes.
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
    """Whether trajectories and windows are equally many everywhere.

    Raises:
        ValueError: They are not.
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
    """Whether states are of one kind.

    Raises:
        ValueError: They are not.
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
