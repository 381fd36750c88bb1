"""Measures the identification of a rod that buckles, for docs/identification.md."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from benchmarks.buckling import SD, TRUTH, Buckling
from benchmarks.fit_rows import fit_row, noisy, scaled, timed

FILMS, REDRAWS = 6, 4
FRAMES = 6
"""Of a window."""
STIFF = (3.5, 1 / 3, 3.0, 0.25)
SOFT = (1 / 3.5, 3.0, 1 / 3, 4.0)


def buckling_rows() -> Iterable[str]:
    """Four parameters at once, and what a single run makes of the same films."""
    buckling = Buckling()
    clean = jax.jit(buckling.films)(jax.random.split(jax.random.key(5), FILMS))
    seen = noisy(clean, SD, jax.random.key(6))
    search = jax.jit(lambda seen, start: buckling.fit(seen, start, FRAMES))
    start = scaled(TRUTH, STIFF)
    fit, first, run = timed(search, seen, start)
    words = "from bending 3.5 times, axial a third, density 3 times, damping a fourth"
    yield _row(f"windows; {words}", fit, first, run)
    alone, seconds = _once(jax.jit(lambda s, p: buckling.fit(s, p, buckling.frames)))(
        seen, start
    )
    yield _row("a single run of each film, its start sought too", alone, seconds)
    draws = [fit]
    for key in jax.random.split(jax.random.key(7), REDRAWS):
        draws.append(search(noisy(clean, SD, key), start))
    z = {k: np.array([float(fit.z(TRUTH)[k]) for fit in draws]) for k in TRUTH}
    worst = {
        k: max(abs(float(fit.values[k]) / TRUTH[k] - 1) for fit in draws) for k in TRUTH
    }
    every = np.concatenate(list(z.values()))
    yield (
        f"| windows; this and {REDRAWS} more draws of the noise | "
        f"{sum(bool(fit.converged) for fit in draws)} converged | at most "
        + ", ".join(f"{100 * worst[k]:.2f} %" for k in TRUTH)
        + f" | all {every.size} z-scores: root mean square "
        f"{np.sqrt(np.mean(every**2)):.2f}, largest {np.max(np.abs(every)):.2f} | "
        f"{max(int(fit.iterations) for fit in draws)} | | |"
    )
    fit, seconds = _once(search)(seen, scaled(TRUTH, SOFT))
    words = "from bending 0.29 times, axial 3 times, density a third, damping 4 times"
    yield _row(f"windows; {words}", fit, None, seconds)


def _once(program: Any) -> Any:
    """The program with the processor time it took."""

    def taken(*given: Any) -> tuple[Any, float]:
        begin = time.process_time()
        made = jax.block_until_ready(program(*given))
        return made, time.process_time() - begin

    return taken


def _row(words: str, fit: Any, first: float | None, run: float | None = None) -> str:
    words += f": misfit {float(fit.misfit):.3g}"
    return fit_row(words, TRUTH, fit, first, run)
