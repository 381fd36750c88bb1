"""Display of the progress of many runs: a line for every change."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

from jaxrod.cli.sweeps.plan import Planned
from jaxrod.training.progress import ProgressBar, duration, reached

_STATES = ("done", "running", "stopped", "waiting", "failed")


class RunsView:
    """Prints a line when the state of a run changes and after every tenth of a run."""

    def __init__(self, runs: Sequence[Planned], stream: TextIO) -> None:
        """Marks all runs as waiting; prints nothing."""
        self._stream = stream
        self._states = dict.fromkeys((run.name for run in runs), "waiting")
        self._width = max(map(len, self._states))
        self._bars: dict[str, ProgressBar] = {}

    def start(self, run: Planned, row: Mapping[str, str] | None) -> None:
        """Shows that a run starts, or resumes after `row`, its last row of progress."""
        done = int(row["env_steps"]) if row else 0
        name = f"{run.name:<{self._width}}"
        self._bars[run.name] = ProgressBar(
            run.steps, "steps", done=done, name=name, stream=self._stream
        )
        self._change(run, "running", f"from {done:,} steps" if done else "")

    def running(self, run: Planned, row: Mapping[str, str] | None) -> None:
        """Shows the last row of progress of a run, if there is one."""
        if row:
            self._bars[run.name].update(int(row["env_steps"]), reached(row))

    def done(self, run: Planned, result: Mapping[str, Any], quiet: bool) -> None:
        """Shows the summary of a finished run; only counts the run if `quiet`."""
        steps, wall, score = (
            result[name] for name in ("env_steps", "wall_s", "final_score")
        )
        text = (
            f"score {score_in_words(score)}{run.beside}  {steps:,} steps  "
            f"{steps / wall:,.0f} steps/s  {duration(wall)}"
        )
        self._change(run, "done", text, quiet)

    def failed(self, run: Planned, reason: str, quiet: bool = False) -> None:
        """Shows that a run has failed; only counts the run if `quiet`."""
        self._change(run, "failed", reason, quiet)

    def stopped(self, run: Planned, row: Mapping[str, str] | None) -> None:
        """Shows that a run was interrupted after `row`, its last row of progress."""
        done = int(row["env_steps"]) if row else 0
        self._change(run, "stopped", f"after {done:,} steps")

    def say(self, text: str) -> None:
        """Prints a message on a line of its own."""
        self._stream.write(text + "\n")
        self._stream.flush()

    def _change(self, run: Planned, state: str, text: str, quiet: bool = False) -> None:
        self._states[run.name] = state
        if not quiet:
            counts = Counter(self._states.values())
            totals = ", ".join(f"{counts[s]} {s}" for s in _STATES if counts[s])
            words = (f"{run.name:<{self._width}}", f"{state:<7}", text, f"({totals})")
            self.say("  ".join(filter(None, words)))


def score_in_words(score: float | None) -> str:
    """Score as text: an integer from 100 on, otherwise three digits; "-" for None."""
    if score is None:
        return "-"
    return f"{score:,.0f}" if abs(score) >= 100 else f"{score:.3g}"
