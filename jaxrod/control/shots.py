"""Multiple shooting: many short runs from known starts in place of a long one.

A run that leaves the data at a fork (buckling, contact) never finds back, and the sum
of squares has minima everywhere. Windows that begin where the data are cannot leave
far.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983; with starts that are given instead of sought.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.validation import check_count


def shots(
    run: Callable[[dict[str, Any], Any], Any], starts: Any
) -> Callable[[dict[str, Any]], Any]:
    """A simulation of windows, side by side, for `identify`.

    Args:
        run: Takes parameters and the state at the start of a window, makes its
            observations.
        starts: States at the starts of the windows, stacked in front.

    Returns:
        `parameters -> observations`, stacked in front by window.

    Raises:
        ValueError: If the leaves of `starts` are not of equally many windows.
    """
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(starts)}
    if len(sizes) != 1 or () in sizes:
        raise ValueError(
            "starts must be states stacked in front, equally many in every leaf, got "
            f"{sorted(sizes)}"
        )

    def simulate(parameters: dict[str, Any]) -> Any:
        return jax.vmap(lambda start: run(parameters, start))(starts)

    return simulate


def windows(observed: Any, frames: int, every: int | None = None) -> Any:
    """Windows of a film, stacked in front, as `shots` makes them.

    Window `k` holds the frames after its start: those from `k * every + 1`, the start
    being frame `k * every`.

    Args:
        observed: A tree of records with frames in front, the first at the first start.
        frames: Frames of a window.
        every: Frames from one start to the next; `frames` by default.

    Raises:
        ValueError: If a count is out of range or the film is shorter than a window.
    """
    frames = check_count("frames", frames, 1)
    every = check_count("every", frames if every is None else every, 1)
    lengths = {len(leaf) for leaf in jax.tree.leaves(observed)}
    if len(lengths) != 1 or min(lengths) <= frames:
        raise ValueError(
            f"observed must have more than {frames} frames, equally many in every "
            f"leaf, got {sorted(lengths)}"
        )
    first = range(0, min(lengths) - frames, every)
    return jax.tree.map(
        lambda leaf: jnp.stack([leaf[k + 1 : k + 1 + frames] for k in first]), observed
    )
