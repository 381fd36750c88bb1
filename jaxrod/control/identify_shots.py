r"""Identification by multiple shooting from starts that nobody has seen.

A film shows positions, with noise, and no velocities: where a window starts is an
unknown of its own. Parameters $p$ and starts $s_w$ of all windows are found together,

$$\min_{p,\, s_1 \dots s_W} \sum_w \sum_k
\Big(\frac{y_{wk}(p, s_w) - \hat y_{wk}}{\sigma_{wk}}\Big)^2,$$

so that errors of the starts are no errors of the model, and standard deviations of the
parameters hold what the starts take from the data. Windows are not tied to each other:
what continuity would say is left unused, and `identify_continuous` uses it.

Where each of many unknowns of a start is seen a few times only, a search may end beside
the best minimum, where starts make good for wrong parameters. Neither misfit nor
standard deviations tell of it (docs/identification.md has such a rod). Take what is
found as where `identify_continuous` begins, or try the fit on films that were
simulated.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983, without its conditions of continuity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.control.fit import Fit
from jaxrod.control.identify import fit_of, make_sought
from jaxrod.control.local_least_squares import local_least_squares
from jaxrod.control.shots import check_finite_floats, count_windows


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
    """Parameters that explain windows best, each from the start that is best for it.

    A window must show more than its start takes: with `k` numbers sought in a start it
    needs more than `k` observations, among them the start's own frame where it was
    seen. Each observation belongs into one window only, or it counts twice.

    Args:
        run: Takes parameters, the start of a window, and what is known of it; makes the
            observations of the window.
        observed: What was observed, stacked in front by window (`windows` makes them).
            What is not finite was not seen and is left out.
        start: Where to begin: numbers or arrays by name.
        starts: Where the starts of windows begin: a pytree of floats, stacked in front.
        known: What is known of each window and not sought, stacked in front.
        sd: As in `identify`; a tree as `observed` is or begins.
        log: As in `identify`, and so are `lower`, `upper`, `iterations`, `damping`.
        lower: Smallest values.
        upper: Largest values.
        iterations: Points tried after the first, at most.
        damping: Of the first step, a share [1].
        tolerance: Relative change of the sum of squares below which it is done.

    Returns:
        The fit, whose standard deviations count the starts as unknown, and the starts.

    Raises:
        ValueError: As `identify`; or windows are not equally many everywhere.
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
