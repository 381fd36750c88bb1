"""Training one cell in a process of its own, watched from here.

A process per cell, because what JAX compiled and holds for one cell is of no use to
the next and is given back only by the end of a process; and because a cell that runs
out of memory then takes nothing else with it.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

from jaxrod.training import RunFolder
from jaxrod.training.runs.lock import FolderInUseError

POLL_SECONDS = 0.5
WAIT_SECONDS = 300.0
"""How long to wait for runs whose grid was killed to save and stop [s]."""

LAUNCHER = (sys.executable, "-P", str(Path(__file__).with_name("child.py")))


def wait_for(folders: Iterable[RunFolder], say: Callable[[str], None]) -> None:
    """Waits until nobody trains in any of the folders.

    Raises:
        FolderInUseError: somebody still does after `WAIT_SECONDS`.
    """
    until = time.monotonic() + WAIT_SECONDS
    for folder in folders:
        told = False
        while folder.path.exists():
            try:
                with folder.only_process():
                    break
            except FolderInUseError:
                if time.monotonic() > until:
                    raise
                if not told:
                    say(f"waiting for the process that trains in {folder.path}")
                    told = True
                time.sleep(POLL_SECONDS)


class Child:
    """`jaxrod WORDS` in a process of its own, beside others."""

    def __init__(self, words: Sequence[str], log: Path, cores: Collection[int]) -> None:
        """Starts it.

        Args:
            words: the command.
            log: file that what it says is added to.
            cores: the processor's cores it may use; all if empty.
        """
        with log.open("a", encoding="utf-8") as said:
            said.write(f"$ jaxrod {shlex.join(words)}\n")
            said.flush()
            # A session of its own: the terminal's Ctrl-C must come from here, once.
            self._process = subprocess.Popen(
                [*LAUNCHER, *words],
                stdin=subprocess.PIPE,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        if cores:
            # Python takes longer to start than this: JAX will see these cores only.
            os.sched_setaffinity(self._process.pid, cores)

    def code(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    def stop(self) -> None:
        """Lets it save and stop."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def end(self) -> None:
        """Ends it at once, if it has not ended; waits until it has."""
        if self._process.poll() is None:
            self._process.kill()
        self.stop()
        self._process.wait()


def shares(jobs: int) -> list[tuple[int, ...]]:
    """The cores of this process, dealt out to so many jobs.

    One job has them all without being told; so has every job where the system
    does not let processes be bound, or where there are fewer cores than jobs.
    """
    if jobs == 1 or not hasattr(os, "sched_setaffinity"):
        return [()] * jobs
    cores = sorted(os.sched_getaffinity(0))
    each = len(cores) // jobs
    return [tuple(cores[k * each : (k + 1) * each]) for k in range(jobs)]


def last_words(log: Path) -> str:
    """The last line that a process said."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def last_row(folder: RunFolder) -> dict[str, str] | None:
    """The last row of a run's progress.csv, None before any."""
    try:
        rows = folder.progress.read()
    except FileNotFoundError:  # Taken away by a run that begins anew.
        return None
    return rows[-1] if rows else None
