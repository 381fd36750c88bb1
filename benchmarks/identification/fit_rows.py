"""Rows of tables of fits, for docs/identification.md: noise, seconds, words."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

from jaxrod.control import Fit


def noisy(clean: Any, sd: Any, key: Any) -> Any:
    """Observations with noise."""
    leaves, tree = jax.tree.flatten(clean)
    keys = jax.random.split(key, len(leaves))
    return jax.tree.unflatten(
        tree,
        [
            leaf + s * jax.random.normal(k, leaf.shape, leaf.dtype)
            for leaf, s, k in zip(leaves, jax.tree.leaves(sd), keys, strict=True)
        ],
    )


def timed(program: Callable[..., Any], *given: Any) -> tuple[Any, float, float]:
    """Result of a program, and processor times of its first and of its second call."""
    taken = []
    for _ in range(2):
        begin = time.process_time()
        made = jax.block_until_ready(program(*given))
        taken.append(time.process_time() - begin)
    return made, taken[0], taken[1]


def scaled(truth: dict[str, float], factors: Iterable[float]) -> dict[str, float]:
    """Parameters multiplied by wrong factors, in the order above."""
    return {k: f * truth[k] for k, f in zip(truth, factors, strict=True)}


def fit_row(
    words: str,
    truth: dict[str, float],
    fit: Fit,
    first: float | None,
    run: float | None,
) -> str:
    """One row of a fit, its printed table above it on the terminal.

    Seconds that were not measured are left out.
    """
    print(fit, file=sys.stderr, flush=True)
    values, sds = fit.values, fit.standard_deviations
    unsure = {
        name
        for name, row in zip(fit.names, np.asarray(fit.covariance), strict=True)
        if row[fit.names.index(name)] > 1
    }
    found = ", ".join(f"{k} {float(values[k]):.5g}" for k in truth)
    errors = ", ".join(
        f"{100 * (float(values[k]) / truth[k] - 1):+.2f} %" for k in truth
    )
    stated = ", ".join(
        "not known" if k in unsure else f"{100 * float(sds[k]) / truth[k]:.2f} %"
        for k in truth
    )
    words += "" if bool(fit.converged) else " (not converged)"
    seconds = (
        "" if first is None else f"{first:.1f}",
        "" if run is None else f"{run:.2f}",
    )
    return (
        f"| {words} | {found} | {errors} | {stated} | {int(fit.iterations)} | "
        f"{' | '.join(seconds)} |"
    )
