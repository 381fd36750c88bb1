"""The progress of a whole grid: a line per cell."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from typing import TextIO

from benchmarks.paper.plan import Cell

_BAR = 20


class GridView:
    """Shows every cell: waiting, running, done or failed.

    On a terminal the lines are redrawn in place; where there are more cells than
    lines, those around the one that changed last are shown. Elsewhere (a log file) a
    line is printed for every change, and for every tenth of a running cell.
    """

    def __init__(self, cells: list[Cell], stream: TextIO) -> None:
        """Shows nothing yet; all cells wait."""
        self._stream = stream
        self._live = stream.isatty()
        self._names = {cell.name: k for k, cell in enumerate(cells)}
        self._width = max(map(len, self._names))
        self._states = ["waiting"] * len(cells)
        self._texts = [""] * len(cells)
        self._tenths: dict[str, int] = {}
        self._began: dict[str, tuple[float, int]] = {}
        self._drawn = self._at = 0

    def start(self, cell: Cell, done: int) -> None:
        """A cell starts, or goes on where it has `done` control steps."""
        self._began[cell.name] = time.monotonic(), done
        self._tenths[cell.name] = 10 * done // cell.steps
        self._set(cell, "running", f"from {done:,} steps" if done else "")

    def running(self, cell: Cell, done: int, score: float | None) -> None:
        """A cell has done so many control steps."""
        share = min(1.0, done / cell.steps)
        filled = int(share * _BAR)
        text = f"[{'#' * filled}{'-' * (_BAR - filled)}] {share:4.0%}"
        text += f"  score {_score(score)}{against(cell)}"
        began, before = self._began[cell.name]
        if done > before:
            left = (time.monotonic() - began) / (done - before) * (cell.steps - done)
            text += f"  {duration(left)} left"
        tenth = 10 * done // cell.steps
        quiet = not self._live and tenth <= self._tenths[cell.name]
        self._tenths[cell.name] = max(tenth, self._tenths[cell.name])
        self._set(cell, "running", text, quiet)

    def done(self, cell: Cell, score: float | None, wall: float, quiet: bool) -> None:
        """A cell has ended; `quiet` where it had before this call."""
        text = f"score {_score(score)}{against(cell)}  {duration(wall)}"
        self._set(cell, "done", text, quiet)

    def failed(self, cell: Cell, reason: str, quiet: bool = False) -> None:
        """A cell has failed."""
        self._set(cell, "failed", reason, quiet)

    def stopped(self, cell: Cell, done: int) -> None:
        """A cell was interrupted."""
        self._set(cell, "stopped", f"after {done:,} of {cell.steps:,} steps")

    def say(self, text: str) -> None:
        """Says something on a line of its own, above the grid."""
        if self._live and self._drawn:
            self._stream.write(f"\x1b[{self._drawn}A\x1b[J")
            self._drawn = 0
        self._stream.write(text + "\n")
        self._draw()

    def _set(self, cell: Cell, state: str, text: str, quiet: bool = False) -> None:
        self._at = self._names[cell.name]
        self._states[self._at], self._texts[self._at] = state, text
        if self._live:
            self._draw()
        elif not quiet:
            self._stream.write(self._line(self._at) + f"  ({self._totals()})\n")
            self._stream.flush()

    def _draw(self) -> None:
        if self._live:
            size = shutil.get_terminal_size()
            room = max(1, min(len(self._states), size.lines - 2))
            first = max(0, min(self._at - room // 2, len(self._states) - room))
            lines = [self._line(k) for k in range(first, first + room)]
            lines.append(self._totals())
            if self._drawn:
                self._stream.write(f"\x1b[{self._drawn}A")
            text = "".join(f"\x1b[2K{line[: size.columns - 1]}\n" for line in lines)
            self._stream.write(text)
            self._drawn = len(lines)
        self._stream.flush()

    def _line(self, k: int) -> str:
        name = list(self._names)[k]
        return f"{name:<{self._width}}  {self._states[k]:<7}  {self._texts[k]}".rstrip()

    def _totals(self) -> str:
        counts = Counter(self._states)
        order = ("done", "running", "stopped", "waiting", "failed")
        return ", ".join(f"{counts[s]} {s}" for s in order if counts[s])


def against(cell: Cell) -> str:
    """The paper's score in words; empty where there is none."""
    return f"  paper {cell.paper.final_mean:,.0f}" if cell.paper else ""


def duration(seconds: float) -> str:
    """A time in words, such as "3.4 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _score(score: float | None) -> str:
    return "-" if score is None else f"{score:,.0f}"
