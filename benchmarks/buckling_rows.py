"""Measures the identification of a rod that buckles, for docs/identification.md."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from benchmarks.buckling import SD, TRUTH, Buckling
from benchmarks.fit_rows import fit_row, noisy, scaled, timed

FILMS = 8
REDRAWS, FILMS_OF_A_REDRAW = 20, 2
STAGES = ((3, 1.0), (6, 1.0))
"""Frames of the windows of searches one after the other, damping of a first step."""
STIFF = (3.5, 1 / 3, 3.0, 0.25)
SOFT = (1 / 3.5, 3.5, 1 / 3, 4.0)


def found(buckling: Buckling, seen: Any, start: Any) -> Any:
    """The fit of longer windows, from where that of shorter ones has ended."""
    fit = None
    for every, damping in STAGES:
        fit = buckling.fit(seen, start, every, damping)
        start = fit.values
    return fit


def buckling_rows() -> Iterable[str]:
    """Four parameters at once, and what a single run makes of the same films."""
    buckling = Buckling()
    clean = jax.jit(buckling.films)(jax.random.split(jax.random.key(5), FILMS))
    seen = noisy(clean, SD, jax.random.key(6))
    search = jax.jit(lambda seen, start: found(buckling, seen, start))
    for words, factors in (
        ("bending 3.5 times, axial a third, density 3 times, damping a fourth", STIFF),
        ("the other way round", SOFT),
    ):
        start = scaled(TRUTH, factors)
        yield fit_row(f"windows; from {words}", TRUTH, *timed(search, seen, start))
    few = jax.tree.map(lambda leaf: leaf[:FILMS_OF_A_REDRAW], clean)
    start = scaled(TRUTH, STIFF)

    def redraw(key: Any) -> Any:
        return found(buckling, noisy(few, SD, key), start)

    many = jax.jit(lambda keys: jax.lax.map(redraw, keys))
    keys = jax.random.split(jax.random.key(7), REDRAWS)
    fits, first, run = timed(many, keys)
    z = {k: np.asarray(v) for k, v in fits.z(TRUTH).items()}
    shown = "; ".join(f"{k} {v.mean():+.2f} ± {v.std():.2f}" for k, v in z.items())
    yield (
        f"| {REDRAWS} draws of the noise, {FILMS_OF_A_REDRAW} films each | "
        f"{int(np.sum(fits.converged))} converged, misfit "
        f"{float(np.mean(fits.misfit)):.3f} | z-scores: {shown} | | "
        f"{int(np.max(fits.iterations))} | {first:.1f} | {run:.2f} |"
    )

    def single(seen: Any, start: Any) -> Any:
        return buckling.fit(seen, start, buckling.frames, 1.0)

    fit, first, run = timed(jax.jit(single), seen, start)
    yield fit_row(
        f"a single run of each film, its start sought too: misfit "
        f"{float(fit.misfit):.3g}",
        TRUTH,
        fit,
        first,
        run,
    )
