"""A progress bar on stderr: how far, how fast, what is reached, time left."""

from __future__ import annotations

import shutil
import sys
import time
from typing import TextIO

_WIDTH = 24


class ProgressBar:
    """Shows how far a run or an optimisation is.

    On a terminal one line is redrawn; elsewhere (a notebook, a log file) a line is
    printed whenever another tenth is done or half a minute has passed.
    """

    def __init__(
        self,
        total: int,
        unit: str,
        *,
        done: int = 0,
        enabled: bool = True,
        stream: TextIO | None = None,
    ) -> None:
        """Starts the clock.

        Args:
            total: The most there will be to do.
            unit: What is counted, in the plural.
            done: How many are done before the clock is started.
            enabled: False shows nothing.
            stream: Where to write; stderr by default.
        """
        self._total = total
        self._unit = unit
        self._start = done
        self._enabled = enabled
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._tenths = 10 * done // total
        self._open = False
        self.restart()

    def restart(self) -> None:
        """Starts the clock anew: what took time so far was not what is counted."""
        self._began = self._printed = time.monotonic()

    def update(self, done: int, reached: str) -> None:
        """Shows the state.

        Args:
            done: How many are done.
            reached: What is reached, in words.
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


def progress_line(done: int, total: int, unit: str, rate: float, reached: str) -> str:
    """The text of the bar.

    Args:
        done: How many are done.
        total: The most there will be.
        unit: What is counted, in the plural.
        rate: How many a second; 0 before it is known.
        reached: What is reached, in words.
    """
    filled = min(_WIDTH, _WIDTH * done // total)
    bar = "#" * filled + "-" * (_WIDTH - filled)
    line = (
        f"[{bar}] {min(100, 100 * done // total):3d}%  "
        f"{_short(done)}/{_short(total)} {unit}"
    )
    if rate > 0:
        speed = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
        line += f"  {speed} {unit}/s  {_clock((total - done) / rate)} left"
    return f"{line}  {reached}"


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
