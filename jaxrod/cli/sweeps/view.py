"""The progress of many runs: a table with one line per run."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

from jaxrod.cli.sweeps.planned import Planned

_HEADS = ("run", "state", "steps", "", "score", "steps/s", "")
_STATES = ("done", "running", "stopped", "waiting", "failed")


@dataclasses.dataclass
class _Line:
    """Displayed values of a run."""

    state: str = "waiting"
    done: int = 0
    score: str = ""
    rate: str = ""
    text: str = ""
    tenth: int = -1
    """Tenths of the run that a log has already reported."""
    began: tuple[float, int] = (0.0, 0)
    """Time at which it started, and its control steps then."""


class RunsView:
    """Shows every run: its state, control steps, score, and control steps per second.

    On a terminal the lines are redrawn in place. If there are more runs than lines,
    those around the last changed one are shown. Elsewhere (a log file) a line is
    printed for every change, and for every tenth of a run.
    """

    def __init__(self, runs: Sequence[Planned], stream: TextIO) -> None:
        """Starts with all runs waiting, and shows nothing yet."""
        self._stream = stream
        self._live = stream.isatty()
        self._runs = list(runs)
        self._places = {run.name: k for k, run in enumerate(runs)}
        self._width = max(map(len, self._places))
        self._lines = [_Line() for _ in runs]
        self._drawn = self._at = 0

    def start(self, run: Planned, done: int) -> None:
        """Shows that a run starts, or continues at `done` control steps."""
        line = self._line(run)
        line.began = time.monotonic(), done
        line.done, line.tenth = done, 10 * done // run.steps
        self._set(run, "running", f"from {done:,} steps" if done else "")

    def running(self, run: Planned, done: int, score: str) -> None:
        """Shows a run's number of control steps and its score."""
        line = self._line(run)
        line.done, line.score, text = done, score, ""
        began, before = line.began
        if done > before:
            rate = (done - before) / (time.monotonic() - began)
            line.rate = f"{rate:,.0f}"
            text = f"{duration(max(run.steps - done, 0) / rate)} left"
        tenth = 10 * done // run.steps
        quiet = not self._live and tenth <= line.tenth
        line.tenth = max(tenth, line.tenth)
        self._set(run, "running", text, quiet)

    def done(self, run: Planned, result: Mapping[str, Any], quiet: bool) -> None:
        """Shows that a run has finished; `quiet` if it had before this call."""
        line = self._line(run)
        line.done = result["env_steps"]
        line.score = score_in_words(result["final_score"])
        line.rate = f"{line.done / result['wall_s']:,.0f}"
        self._set(run, "done", duration(result["wall_s"]), quiet)

    def failed(self, run: Planned, reason: str, quiet: bool = False) -> None:
        """Shows that a run has failed."""
        self._set(run, "failed", reason, quiet)

    def stopped(self, run: Planned, done: int) -> None:
        """Shows that a run was interrupted."""
        self._line(run).done = done
        self._set(run, "stopped", f"after {done:,} steps")

    def say(self, text: str) -> None:
        """Prints a message on a line of its own, above the table."""
        if self._live and self._drawn:
            self._stream.write(f"\x1b[{self._drawn}A\x1b[J")
            self._drawn = 0
        self._stream.write(text + "\n")
        self._draw()

    def _line(self, run: Planned) -> _Line:
        return self._lines[self._places[run.name]]

    def _set(self, run: Planned, state: str, text: str, quiet: bool = False) -> None:
        self._at = self._places[run.name]
        line = self._lines[self._at]
        line.state, line.text = state, text
        if self._live:
            self._draw()
        elif not quiet:
            self._stream.write(f"{self._row(self._at)}  ({self._totals()})\n")
            self._stream.flush()

    def _draw(self) -> None:
        if self._live:
            size = shutil.get_terminal_size()
            room = max(1, min(len(self._lines), size.lines - 3))
            first = max(0, min(self._at - room // 2, len(self._lines) - room))
            lines = [self._columns(_HEADS)]
            lines += [self._row(k) for k in range(first, first + room)]
            lines.append(self._totals())
            if self._drawn:
                self._stream.write(f"\x1b[{self._drawn}A")
            text = "".join(f"\x1b[2K{line[: size.columns - 1]}\n" for line in lines)
            self._stream.write(text)
            self._drawn = len(lines)
        self._stream.flush()

    def _row(self, k: int) -> str:
        run, line = self._runs[k], self._lines[k]
        share = f"{min(1.0, line.done / run.steps):.0%}"
        score = line.score + (run.beside if line.score else "")
        done = f"{line.done:,}"
        return self._columns(
            (run.name, line.state, done, share, score, line.rate, line.text)
        )

    def _columns(self, words: Sequence[str]) -> str:
        name, state, done, share, score, rate, text = words
        return (
            f"{name:<{self._width}}  {state:<7}  {done:>11}  {share:>4}  {score:>9}  "
            f"{rate:>9}  {text}"
        ).rstrip()

    def _totals(self) -> str:
        counts = Counter(line.state for line in self._lines)
        return ", ".join(f"{counts[s]} {s}" for s in _STATES if counts[s])


def reached(row: Mapping[str, str]) -> str:
    """Result so far from a row of progress: rewards until the first episode ends."""
    if row["episode_return_mean"]:
        return score_in_words(float(row["episode_return_mean"]))
    if row.get("reward_mean"):
        return f"{float(row['reward_mean']):.3g} an action"
    return "-"


def score_in_words(score: float | None) -> str:
    """A score as a whole number if it is large, otherwise with three digits."""
    if score is None:
        return "-"
    return f"{score:,.0f}" if abs(score) >= 100 else f"{score:.3g}"


def duration(seconds: float) -> str:
    """A time in words, such as "3.4 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
