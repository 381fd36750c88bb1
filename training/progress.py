"""Progress of a run on stderr: percentage, speed, time left, result so far."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping
from typing import Any, TextIO

_WIDTH = 24


class ProgressBar:
    """Shows the progress of a run or an optimisation.

    On a terminal one line is redrawn. Elsewhere (a notebook, a log file) a line is
    printed after every tenth of the total, and whenever the last line is more than 30 s
    old. A run with a name shares the stream with other runs, so it prints a line after
    every tenth only.
    """

    def __init__(
        self,
        total: int,
        unit: str,
        *,
        done: int = 0,
        name: str = "",
        enabled: bool = True,
        stream: TextIO | None = None,
    ) -> None:
        """Starts the clock.

        Args:
            total: Count at which the work is complete.
            unit: Plural noun for what is counted, such as "steps".
            done: Count when the clock starts.
            name: Name of one of several runs, printed before its lines.
            enabled: Whether anything is shown.
            stream: Output stream; stderr by default.
        """
        self._total = total
        self._unit = unit
        self._start = done
        self._name = name
        self._enabled = enabled
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty() and not name
        self._tenths = 10 * done // total
        self._open = False
        self.restart()

    def restart(self) -> None:
        """Restarts the clock that the speed is measured with."""
        self._began = self._printed = time.monotonic()

    def update(self, done: int, reached: str) -> None:
        """Shows the current progress.

        Args:
            done: Current count.
            reached: Result so far as text, such as "return 17.3".
        """
        if not self._enabled:
            return
        now = time.monotonic()
        rate = (done - self._start) / max(now - self._began, 1e-9)
        line = progress_line(done, self._total, self._unit, rate, reached)
        if self._live:
            width = shutil.get_terminal_size().columns - 1
            self._write(f"\r{line[:width]:<{width}}")
            self._open = True
        elif 10 * done // self._total > self._tenths or (
            now - self._printed > 30 and not self._name
        ):
            self._tenths = 10 * done // self._total
            self._printed = now
            self._write(f"{self._name}  {line}\n" if self._name else f"{line}\n")

    def message(self, text: str) -> None:
        """Prints a message on a line of its own."""
        if self._enabled:
            self.close()
            self._write(text + "\n")

    def close(self) -> None:
        """Ends the redrawn line with a line break, so that other output can follow."""
        if self._open:
            self._write("\n")
            self._open = False

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def progress_line(done: int, total: int, unit: str, rate: float, reached: str) -> str:
    """One line of progress: bar, percentage, counts, speed, time left, result so far.

    Args:
        done: Current count.
        total: Count at which the work is complete.
        unit: Plural noun for what is counted, such as "steps".
        rate: Counts per second; 0 if it is not known yet.
        reached: Result so far as text, such as "return 17.3".
    """
    filled = min(_WIDTH, _WIDTH * done // total)
    bar = "#" * filled + "-" * (_WIDTH - filled)
    line = (
        f"[{bar}] {min(100, 100 * done // total):3d}%  "
        f"{_short(done)}/{_short(total)} {unit}"
    )
    if rate > 0:
        speed = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
        line += f"  {speed} {unit}/s  {duration(max(0, total - done) / rate)} left"
    return f"{line}  {reached}"


def _short(count: int) -> str:
    for size, letter in ((1_000_000, "M"), (1_000, "k")):
        if count >= size:
            return f"{count / size:.3g}{letter}"
    return str(count)


def duration(seconds: float) -> str:
    """Duration as text in s, min or h, such as "3.4 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def reached(row: Mapping[str, Any]) -> str:
    """Result so far as text, from a row of the progress table.

    It is the mean return, or the mean reward until the first episode has ended.
    """
    if row["episode_return_mean"] not in (None, ""):
        return f"return {float(row['episode_return_mean']):,.1f}"
    if row.get("reward_mean") not in (None, ""):
        return (
            f"reward {float(row['reward_mean']):.3g} per action, no episode has ended"
        )
    return "no episode has ended"
