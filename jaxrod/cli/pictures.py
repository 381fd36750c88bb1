"""The pictures of a run: its learning curve and a replay of its policy."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrod.cli import runs
from jaxrod.cli.text import printable
from jaxrod.files import DamagedFileError

if TYPE_CHECKING:
    from jaxrod.training import Policy


def draw_learning_curve(path: Path, config: Mapping[str, Any]) -> Path | None:
    """Draws `learning_curve.png` into a run folder, or prints why there is none."""
    from jaxrod import viz
    from jaxrod.training.runs.folder import LEARNING_CURVE

    out = path / LEARNING_CURVE
    try:
        viz.learning_curve(
            path / "progress.csv",
            out,
            title=runs.describe(config),
        )
    except ModuleNotFoundError as missing:
        if missing.name != "matplotlib":
            raise
        _note('the learning curve needs matplotlib: pip install "jaxrod[viz]"')
    except FileNotFoundError:
        _note("no learning curve: the run has not logged anything yet")
    except DamagedFileError:
        raise
    except ValueError as error:
        _note(f"no learning curve: {error}")
    else:
        return out
    return None


def write_replay(
    run: runs.StoredRun,
    policy: Policy,
    out: Path | None = None,
    *,
    seconds: float | None = None,
    seed: int = 0,
) -> Path | None:
    """Plays the policy and writes a page that shows it, if the task can be drawn.

    The page is `out`; if that is None, `replay.html` in the run folder.
    """
    from jaxrod import viz
    from jaxrod.cli import recording
    from jaxrod.envs.drawing import missing
    from jaxrod.training.runs.folder import REPLAY

    if lacks := missing(run.env):
        _note(f"no replay: {lacks}")
        return None
    replay = recording.record(
        run.env, policy, seconds=seconds, seed=seed, title=run.title
    )
    out = out or run.path / REPLAY
    out.parent.mkdir(parents=True, exist_ok=True)
    viz.save_html(replay, out, frames_per_second=recording.FRAMES_PER_SECOND)
    return out


def print_paths(*paths: Path | None) -> None:
    """Prints the paths of the written files, one per line."""
    for path in paths:
        if path is not None:
            print(os.fspath(path))


def _note(text: str) -> None:
    print(printable(text), file=sys.stderr)
