"""Measures the identification of a rod that buckles, for docs/identification.md."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from benchmarks.identification.buckling import SD, TRUTH, Buckling
from benchmarks.identification.fit_rows import fit_row, noisy, scaled

FILMS, FRAMES = 4, 6
"""Numbers of films in a draw, and of frames in a window."""
DRAWS = ((205, 206), (207, 208), (209, 210), (211, 212), (213, 214))
"""Seeds of films and of their noise. Those up to 208 were seen before the search's
tolerance and the gaps that count as closed were set, the others were not."""
STIFF = (3.5, 1 / 3, 3.0, 0.25)


def buckling_rows() -> Iterable[str]:
    """Four parameters at once, in windows that are joined.

    Also the first draw fitted in windows that are not joined, from a distant start and
    from the truth, and in a single run of its first film.
    """
    with jax.enable_x64(True):
        yield from _rows()


def _rows() -> Iterable[str]:
    buckling = Buckling()
    films = jax.jit(buckling.films)
    search = _once(jax.jit(lambda seen, start: buckling.fit(seen, start, FRAMES)))
    start = jax.tree.map(float, scaled(TRUTH, STIFF))
    z, first = [], None
    for film, noise in DRAWS:
        clean = films(jax.random.split(jax.random.key(film), FILMS))
        seen = noisy(clean, SD, jax.random.key(noise))
        fit, seconds = search(seen, start)
        words = f"joined windows, seeds {film} and {noise}"
        # The first call compiles.
        times = (None, seconds) if first else (seconds, None)
        yield _row(words, fit, *times)
        if first is None:
            first = seen
        z += [float(fit.z(TRUTH)[name]) for name in TRUTH]
    yield (
        f"| these {len(DRAWS)} draws | | | all {len(z)} z-scores: root mean square "
        f"{np.sqrt(np.mean(np.square(z))):.2f}, largest {max(map(abs, z)):.2f} | | | |"
    )

    def apart(seen: Any, start: Any, every: int) -> Any:
        return buckling.apart(seen, start, buckling.shown(seen, every), every)

    windows = _once(jax.jit(lambda seen, start: apart(seen, start, FRAMES)))
    yield _row("the first draw, independent windows", *windows(first, start))
    fit, seconds = windows(first, dict(TRUTH))
    yield _row("the same, starting from the truth", fit, None, seconds)
    one = jax.tree.map(lambda leaf: leaf[:1], first)
    whole = _once(jax.jit(lambda seen, start: apart(seen, start, buckling.frames)))
    alone, seconds = whole(one, start)
    yield _row("a single run of the first film, with an unknown start", alone, seconds)


def _once(program: Any) -> Any:
    """The program with the processor time it took."""

    def taken(*given: Any) -> tuple[Any, float]:
        begin = time.process_time()
        made = jax.block_until_ready(program(*given))
        return made, time.process_time() - begin

    return taken


def _row(words: str, fit: Any, first: float | None, run: float | None = None) -> str:
    scores = ", ".join(f"{float(fit.z(TRUTH)[name]):+.2f}" for name in TRUTH)
    words += f": misfit {float(fit.misfit):.3g}, z {scores}, "
    words += f"remaining step {float(fit.remaining):.2f} sd"
    return fit_row(words, TRUTH, fit, first, run)
