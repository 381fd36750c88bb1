"""Multiple shooting: many short runs from known initial states replace a long run.

A long run that leaves the data at a bifurcation (buckling, contact) never returns to
them, and its sum of squares has many local minima. Windows that begin on the data
cannot move far away.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983; here the initial states are given instead of sought.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.validation import check_count, is_traced


def shots(
    run: Callable[[dict[str, Any], Any], Any], starts: Any
) -> Callable[[dict[str, Any]], Any]:
    """Makes a simulation of all windows as one batch, for `identify`.

    Args:
        run: Takes parameters and the initial state of a window; returns the window's
            observations.
        starts: Initial states of the windows, stacked on the leading axis.

    Returns:
        `parameters -> observations`, stacked by window on the leading axis.

    Raises:
        ValueError: The leaves of `starts` do not all have the same number of windows.
    """
    count_windows(starts)

    def simulate(parameters: dict[str, Any]) -> Any:
        return jax.vmap(lambda start: run(parameters, start))(starts)

    return simulate


def count_windows(starts: Any) -> int:
    """Counts the windows for which initial states are stacked.

    Raises:
        ValueError: The leaves do not all have the same number.
    """
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(starts)}
    if len(sizes) != 1 or () in sizes:
        raise ValueError(
            "starts must be states stacked in front, equally many in every leaf, got "
            f"{sorted(sizes)}"
        )
    return sizes.pop()[0]


def check_finite_floats(name: str, tree: Any) -> None:
    """Checks the first values of a search.

    Raises:
        ValueError: A leaf is not of floats, which have derivatives, or its value is
            known and not finite.
    """
    for leaf in map(jnp.asarray, jax.tree.leaves(tree)):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(f"{name} must be of floats, got {leaf.dtype}")
        if not is_traced(leaf) and not np.all(np.isfinite(np.asarray(leaf))):
            raise ValueError(
                f"{name} must be finite: what was not seen needs a guess here"
            )


def windows(
    observed: Any,
    frames: int,
    every: int | None = None,
    *,
    with_starts: bool = False,
) -> Any:
    """Cuts a film into windows, stacked in front as in the result of `shots`.

    The start of window `k` is frame `k * every`. The window holds the frames after it,
    from frame `k * every + 1` on.

    Args:
        observed: A tree of records with the frames on the leading axis; the first frame
            is the start of the first window.
        frames: Number of frames in a window.
        every: Frames from one start to the next; `frames` by default.
        with_starts: Whether a window includes the frame of its start, as needed if
            starts are sought (`identify_shots`).

    Raises:
        ValueError: A count is out of range, or the film is shorter than a window.
    """
    frames = check_count("frames", frames, 1)
    every = check_count("every", frames if every is None else every, 1)
    lengths = {len(leaf) for leaf in jax.tree.leaves(observed)}
    skipped = 0 if with_starts else 1
    if len(lengths) != 1 or min(lengths) < frames + skipped:
        raise ValueError(
            f"observed must have at least {frames + skipped} frames, equally many in "
            f"every leaf, got {sorted(lengths)}"
        )
    first = range(skipped, min(lengths) - frames + 1, every)
    return jax.tree.map(
        lambda leaf: jnp.stack([leaf[k : k + frames] for k in first]), observed
    )
