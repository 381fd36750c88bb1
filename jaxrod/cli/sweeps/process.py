"""Training of one run in its own process, watched from here.

There is one process per run. The programs and memory that JAX holds for one run are of
no use to the next, and only the end of a process frees them. Also, a run that exhausts
its memory then does not take others with it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from jaxrod.files import open_to_write
from jaxrod.training import RunFolder
from jaxrod.training.runs.lock import FolderInUseError

POLL_SECONDS = 0.5
WAIT_SECONDS = 300.0
"""Longest wait for runs of a killed sweep to save and stop [s]."""

LAUNCHER = (sys.executable, "-P", str(Path(__file__).with_name("child.py")))


@dataclasses.dataclass(frozen=True)
class Ended:
    """Outcome of a process."""

    code: int
    """Its exit code, negative for a signal."""
    said: str
    """Last line of its output, or the signal that killed it."""


def wait_for(folders: Iterable[RunFolder], say: Callable[[str], None]) -> None:
    """Waits until no process trains in any of the folders.

    Raises:
        FolderInUseError: A process still does after `WAIT_SECONDS`.
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


@contextlib.contextmanager
def _on(cores: Collection[int]) -> Iterator[None]:
    """Binds processes that are started in the context to these cores.

    If the binding came after their start, they might already have counted the cores.
    """
    if not cores:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


class Child:
    """`jaxrod train` of one run in its own process, in parallel with others."""

    begun = True
    """Whether it has started."""

    def __init__(
        self,
        words: Sequence[str],
        folder: RunFolder,
        cores: Collection[int] = (),
        *,
        cwd: str | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Starts the process; it continues from the content of the folder.

        Args:
            words: The command, after `jaxrod`.
            folder: Folder of the run.
            cores: Processor cores that it may use; all if empty.
            cwd: Folder in which it runs, None for the current one.
            environment: Its environment variables, None for those of this process.
        """
        self.cores = tuple(cores)
        self._log = log_of(folder)
        words = [*words, "--resume"] if folder.exists else words
        with open_log(self._log) as said:
            said.write(f"$ jaxrod {shlex.join(words)}\n")
            said.flush()
            # Its own session: the terminal's Ctrl-C must reach it only once, from here.
            with _on(cores):
                self._process = subprocess.Popen(
                    [*LAUNCHER, *words],
                    stdin=subprocess.PIPE,
                    stdout=said,
                    stderr=said,
                    start_new_session=True,
                    cwd=cwd,
                    env=environment,
                )

    def ended(self) -> Ended | None:
        """Its outcome; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        said = last_words(self._log) if code >= 0 else f"killed by signal {-code}"
        return Ended(code, said)

    def stop(self) -> None:
        """Asks the run to save and stop."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def end(self) -> None:
        """Ends the process at once, if it has not ended; waits until it has."""
        if self._process.poll() is None:
            self._process.kill()
        self.stop()
        self._process.wait()


class ThisMachine:
    """Trains several runs in parallel, each on its share of the cores."""

    def __init__(self, jobs: int) -> None:
        """Divides the cores.

        Args:
            jobs: Number of runs that are trained in parallel.

        Raises:
            ValueError: `jobs` is below 1.
        """
        if jobs < 1:
            raise ValueError(f"jobs must be at least 1, got {jobs}")
        self.poll_seconds = POLL_SECONDS
        self._idle = _shares(jobs)

    @property
    def room(self) -> bool:
        """Whether another run may start."""
        return bool(self._idle)

    def start(self, words: Sequence[str], folder: RunFolder) -> Child:
        """Starts a run, or continues it."""
        return Child(words, folder, self._idle.pop(0))

    def leave(self, child: Child) -> None:
        """Takes back the cores of a run that has ended."""
        self._idle.append(child.cores)


def _shares(jobs: int) -> list[tuple[int, ...]]:
    """The cores of this process, divided among `jobs` jobs.

    A single job gets all cores without binding. So does every job if the system cannot
    bind processes, or if there are fewer cores than jobs.
    """
    if jobs == 1 or not hasattr(os, "sched_setaffinity"):
        return [()] * jobs
    cores = sorted(os.sched_getaffinity(0))
    each = len(cores) // jobs
    return [tuple(cores[k * each : (k + 1) * each]) for k in range(jobs)]


def log_of(folder: RunFolder) -> Path:
    """Log of a run's process, next to its folder."""
    # Not `with_suffix`: names hold numbers such as 0.001.
    return folder.path.parent / f"{folder.path.name}.log"


def open_log(log: Path) -> TextIO:
    """Opens a log for appending."""
    handle = open_to_write(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    return os.fdopen(handle, "a", encoding="utf-8")


def last_words(log: Path) -> str:
    """Last line of a process's output."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def last_row(folder: RunFolder) -> dict[str, str] | None:
    """Last row of a run's progress.csv, None if there is none."""
    try:
        rows = folder.progress.read()
    except FileNotFoundError:  # Removed by a run that starts over.
        return None
    return rows[-1] if rows else None
