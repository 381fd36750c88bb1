"""A progress bar on stderr for a trajectory optimiser."""

from __future__ import annotations

import shutil
import sys
import time
from typing import TextIO

_WIDTH = 24


class TrajectoryProgress:
    """Shows how far an optimisation is, and how far the tip from its target.

    On a terminal one line is redrawn; elsewhere (a notebook, a log file) a line is
    printed whenever another tenth of the iterations is done.
    """

    def __init__(
        self, total: int, enabled: bool = True, stream: TextIO | None = None
    ) -> None:
        """Says nothing yet.

        Args:
            total: The most gradient steps there will be.
            enabled: False shows nothing.
            stream: Where to write; stderr by default.
        """
        self._total = total
        self._enabled = enabled
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._tenths = 0
        self._open = False
        self._began = 0.0

    def compiled(self, seconds: float) -> None:
        """Tells what the first evaluation took and starts the clock of the rest."""
        self._began = time.monotonic()
        self.message(f"ready after {seconds:.1f} s (the first call compiles)")

    def update(self, done: int, loss: float, tip_distance: float) -> None:
        """Shows the state after `done` evaluations.

        The time left is what the remaining iterations would take; converging ends
        the optimisation earlier.
        """
        if not self._enabled:
            return
        # The first evaluation happened before the clock was started.
        each = (time.monotonic() - self._began) / (done - 1) if done > 1 else None
        line = progress_line(done, self._total, loss, tip_distance, each)
        if self._live:
            width = shutil.get_terminal_size().columns - 1
            self._write(f"\r{line[:width]:<{width}}")
            self._open = True
        elif 10 * done // self._total > self._tenths:
            self._tenths = 10 * done // self._total
            self._write(line + "\n")

    def message(self, text: str) -> None:
        """Says something on a line of its own."""
        if self._enabled:
            if self._open:
                self._write("\n")
                self._open = False
            self._write(text + "\n")

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def progress_line(
    done: int, total: int, loss: float, tip_distance: float, each: float | None
) -> str:
    """The text of the bar.

    Args:
        done: Gradient steps done.
        total: The most there will be.
        loss: Loss, which is minimised [m^2].
        tip_distance: Of the tip from the target [m].
        each: Time per gradient step [s], None before it is known.
    """
    filled = _WIDTH * done // total
    bar = "#" * filled + "-" * (_WIDTH - filled)
    left = "" if each is None else f"  at most {(total - done) * each:.0f} s left"
    return (
        f"[{bar}] step {done}/{total}  loss {loss:.2e}  "
        f"tip {1000 * tip_distance:.1f} mm from target{left}"
    )
