"""A motion shown in one call: in the notebook, or in a file next to the script."""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np

from jaxrod.viz.page import save_html
from jaxrod.viz.replay import Replay


def show(
    model: Any,
    states: Any,
    times: Any,
    path: str | os.PathLike[str] | None = None,
    **more: Any,
) -> Replay:
    """Shows the states of a rollout with all the bodies of their scene or system.

    In a notebook the replay is returned; as the last value of a cell it shows the
    player. In a script the player is written to `replay.html`, and the name is printed.

    Args:
        model: The scene or the system.
        states: Its states, as `jaxrod.rollout` returns them.
        times: Time of each record [s], as `jaxrod.rollout_times` returns them; or the
            time between records.
        path: File to write, also in a notebook.
        **more: The remaining arguments of `Replay.from_states`.

    Raises:
        ValueError: An argument has the wrong shape or an impossible value.
        TypeError: `model` is neither a scene nor a system.
        OSError: The file cannot be written.
    """
    import jax

    if np.ndim(times) == 0:
        first = jax.tree.leaves(states)[0]
        times = np.arange(np.shape(first)[0]) * float(times)
    replay = Replay.from_states(model, states, times, **more)
    if path is None and not _in_notebook():
        path = "replay.html"
    if path is not None:
        save_html(replay, path)
        print(os.fspath(path))
    return replay


def _in_notebook() -> bool:
    """Whether the last value of a cell is displayed as HTML."""
    interactive = sys.modules.get("IPython")
    shell = interactive.get_ipython() if interactive else None
    return hasattr(shell, "kernel")
