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

from jaxrod.validation import check_count, is_traced


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
    count_windows(starts)

    def simulate(parameters: dict[str, Any]) -> Any:
        return jax.vmap(lambda start: run(parameters, start))(starts)

    return simulate


def count_windows(starts: Any) -> int:
    """How many windows starts are stacked for.

    Raises:
        ValueError: They are not equally many in every leaf.
    """
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(starts)}
    if len(sizes) != 1 or () in sizes:
        raise ValueError(
            "starts must be states stacked in front, equally many in every leaf, got "
            f"{sorted(sizes)}"
        )
    return sizes.pop()[0]


def check_finite_floats(name: str, tree: Any) -> None:
    """Checks what a search begins with.

    Raises:
        ValueError: It is not of floats, which have slopes, or known not to be finite.
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
    """Windows of a film, stacked in front, as `shots` makes them.

    Window `k` holds the frames after its start: those from `k * every + 1`, the start
    being frame `k * every`.

    Args:
        observed: A tree of records with frames in front, the first at the first start.
        frames: Frames of a window.
        every: Frames from one start to the next; `frames` by default.
        with_starts: Whether a window begins with the frame of its start instead, for
            starts that are sought (`identify_shots`).

    Raises:
        ValueError: If a count is out of range or the film is shorter than a window.
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
