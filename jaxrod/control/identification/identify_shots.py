r"""Identification by multiple shooting with unknown initial states of windows.

A film shows positions, with noise, and no velocities, so that the initial state of each
window is unknown. The parameters $p$ and the unknowns $s_w$ of all initial states
(starts) are found together,

$$\min_{p,\, s_1 \dots s_W} \sum_w \sum_k
\Big(\frac{y_{wk}(p, s_w) - \hat y_{wk}}{\sigma_{wk}}\Big)^2,$$

so that errors of the starts do not count as errors of the model, and the standard
deviations of the parameters account for the unknown starts. There is no continuity
between windows: `identify_continuous` adds that information.

If a start has many unknowns, each observed only a few times, a search may end in a
local minimum next to the best, where starts compensate for wrong parameters. Neither
the misfit nor the standard deviations show it (docs/identification.md has such a rod).
Use the result as a start for `identify_continuous`, or test the fit on simulated films.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983, without its continuity conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.identification.fit import Fit
from jaxrod.control.identification.identify import fit_of, make_sought
from jaxrod.control.identification.local_least_squares import local_least_squares
from jaxrod.control.identification.shots import check_finite_floats, count_windows


def identify_shots(
    run: Callable[[dict[str, Any], Any, Any], Any],
    observed: Any,
    start: Mapping[str, Any],
    starts: Any,
    *,
    known: Any = (),
    sd: Any = None,
    log: bool | Iterable[str] = True,
    lower: Mapping[str, Any] | None = None,
    upper: Mapping[str, Any] | None = None,
    iterations: int = 50,
    damping: Any = 1e-3,
    tolerance: Any = None,
) -> tuple[Fit, Any]:
    """Finds the parameters that fit windows best, each from its own best start.

    A window needs more observations than its start has unknowns: more than `k` for a
    start of `k` numbers. They include the frame of the start itself, if it was
    observed. Each observation must belong to one window only, or it counts twice.

    Args:
        run: Takes parameters, the start of a window, and the known data of the window;
            returns the observations of the window.
        observed: Observations, stacked by window on the leading axis (`windows` makes
            them). Values that are not finite count as not observed and are left out.
        start: First values of the parameters: numbers or arrays by name.
        starts: First values of the windows' starts: a pytree of floats, stacked by
            window on the leading axis.
        known: Known data of each window, stacked by window on the leading axis.
        sd: Standard deviation of the noise, as in `identify`; a tree prefix of
            `observed`.
        log: Parameters sought by their logarithm, as in `identify`.
        lower: Lower bounds of the parameters, as in `identify`.
        upper: Upper bounds of the parameters, as in `identify`.
        iterations: Largest number of points tried after the first.
        damping: Damping of the first step, as a fraction of the diagonal [1].
        tolerance: Relative change of the sum of squares at which the search ends.

    Returns:
        The fit, whose standard deviations account for the unknown starts; and the
        starts that were found.

    Raises:
        ValueError: An argument is invalid, as in `identify`; or windows are not equally
            many everywhere.
    """
    count = count_windows(starts)
    check_finite_floats("starts", starts)
    others = [np.shape(leaf)[:1] for leaf in jax.tree.leaves((known, observed))]
    if any(shape != (count,) for shape in others):
        raise ValueError(
            "observed and known must be stacked in front as starts are, for "
            f"{count} windows, got {sorted(set(others))}"
        )

    def simulate(values: dict[str, Any]) -> Any:
        return jax.vmap(run, in_axes=(None, 0, 0))(values, starts, known)

    sought = make_sought(simulate, observed, start, sd, log, lower, upper)

    def residuals(point: Array, own: Any, given: Any) -> Any:
        knowing, target, seen, noise = given
        made = run(sought.parameters.values(point), own, knowing)
        return jax.tree.map(
            lambda y, t, s, n: jnp.where(s, y - t, 0) / n, made, target, seen, noise
        )

    noise = jax.tree.map(
        lambda n, t: jnp.broadcast_to(n, t.shape), sought.noise, sought.target
    )
    found = local_least_squares(
        residuals,
        jnp.zeros_like(sought.low),
        starts,
        (known, sought.target, sought.seen, noise),
        lower=sought.low,
        upper=sought.high,
        iterations=iterations,
        damping=damping,
        tolerance=tolerance,
    )
    numbers = sum(np.size(leaf) for leaf in jax.tree.leaves(starts))
    return fit_of(sought, found, numbers), found.own
