"""Training one cell in a process of its own, watched from here.

A process per cell, because what JAX compiled and holds for one cell is of no use to
the next and is given back only by the end of a process; and because a cell that runs
out of memory then takes nothing else with it.
"""

from __future__ import annotations

import csv
import fcntl
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

POLL_SECONDS = 0.5
LOCK_SECONDS = 300.0
"""How long to wait for a cell whose grid was killed to save and stop [s]."""

LAUNCHER = (sys.executable, "-m", "jaxrod.cli.child")


@contextmanager
def only_one(folder: Path, say: Callable[[str], None]) -> Iterator[int]:
    """Holds the lock of a folder of runs; yields it, for children to hold it too.

    Raises:
        ValueError: another grid, or a cell it left behind, holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        began, waiting = time.monotonic(), False
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() - began > LOCK_SECONDS:
                    raise ValueError(
                        f"another `jaxrod reproduce` runs in {folder.parent}"
                    ) from None
                if not waiting:
                    say(f"waiting for another `jaxrod reproduce` in {folder.parent}")
                    waiting = True
                time.sleep(POLL_SECONDS)
        yield lock
    finally:
        os.close(lock)


class Child:
    """`jaxrod WORDS` in a process of its own, beside others."""

    def __init__(
        self, words: Sequence[str], log: Path, *, lock: int, cores: Collection[int]
    ) -> None:
        """Starts it.

        Args:
            words: the command.
            log: file that what it says is added to.
            lock: as `only_one` yields it.
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
                pass_fds=(lock,),
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


def last_row(progress: Path) -> dict[str, str] | None:
    """The last complete row of a progress.csv, None before any."""
    try:
        with progress.open("rb") as file:
            head = file.readline().decode()
            file.seek(max(file.tell(), file.seek(0, os.SEEK_END) - 8192))
            lines = file.read().decode(errors="replace").split("\n")
    except FileNotFoundError:
        return None
    if len(lines) < 2 or not lines[-2]:
        return None
    names, values = next(csv.reader([head])), next(csv.reader([lines[-2]]))
    return dict(zip(names, values, strict=True)) if len(names) == len(values) else None
