"""A progress bar on stderr: steps, steps/s, return, time left."""

from __future__ import annotations

import shutil
import sys
import time
from typing import TextIO

_WIDTH = 24


class ProgressBar:
    """Shows how far a run is.

    On a terminal one line is redrawn; elsewhere (a log file) a line is printed
    whenever another tenth is done or half a minute has passed.
    """

    def __init__(
        self,
        total: int,
        done: int = 0,
        enabled: bool = True,
        stream: TextIO | None = None,
    ) -> None:
        """Starts the clock.

        Args:
            total: control steps of the whole run.
            done: control steps done already, when a run is continued.
            enabled: False shows nothing.
            stream: where to write; stderr by default.
        """
        self._total = total
        self._start = done
        self._enabled = enabled
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._began = self._printed = time.monotonic()
        self._tenths = 10 * done // total
        self._open = False

    def update(self, done: int, episode_return: float | None) -> None:
        """Shows the state of the run.

        Args:
            done: control steps done.
            episode_return: mean return of the last episodes, None before any.
        """
        if not self._enabled:
            return
        now = time.monotonic()
        elapsed = max(now - self._began, 1e-9)
        rate = (done - self._start) / elapsed
        line = progress_line(done, self._total, rate, episode_return)
        if self._live:
            width = shutil.get_terminal_size().columns - 1
            self._write(f"\r{line[:width]:<{width}}")
            self._open = True
        elif 10 * done // self._total > self._tenths or now - self._printed > 30:
            self._tenths = 10 * done // self._total
            self._printed = now
            self._write(line + "\n")

    def message(self, text: str) -> None:
        """Says something on a line of its own."""
        if self._enabled:
            self.close()
            self._write(text + "\n")

    def close(self) -> None:
        """Ends the line that is being redrawn."""
        if self._open:
            self._write("\n")
            self._open = False

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def progress_line(
    done: int, total: int, rate: float, episode_return: float | None
) -> str:
    """The text of the bar, for `done` of `total` steps at `rate` steps/s."""
    filled = min(_WIDTH, _WIDTH * done // total)
    bar = "#" * filled + "-" * (_WIDTH - filled)
    earned = "-" if episode_return is None else f"{episode_return:,.1f}"
    left = f"{_clock((total - done) / rate)} left" if rate > 0 else ""
    return (
        f"[{bar}] {min(100, 100 * done // total):3d}%  {_short(done)}/{_short(total)} "
        f"steps  {rate:,.0f} steps/s  return {earned}  {left}"
    )


def _short(count: int) -> str:
    for size, letter in ((1_000_000, "M"), (1_000, "k")):
        if count >= size:
            return f"{count / size:.3g}{letter}"
    return str(count)


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return (
        f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
    )
