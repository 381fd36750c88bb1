"""Training one run in a process of its own, watched from here.

A process per run, because what JAX compiled and holds for one run is of no use to
the next and is given back only by the end of a process; and because a run that runs
out of memory then takes nothing else with it.
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
"""How long to wait for runs whose sweep was killed to save and stop [s]."""

LAUNCHER = (sys.executable, "-P", str(Path(__file__).with_name("child.py")))


@dataclasses.dataclass(frozen=True)
class Ended:
    """How a process ended."""

    code: int
    """Its exit code, negative for a signal."""
    said: str
    """The last line that it said, or what killed it."""


def wait_for(folders: Iterable[RunFolder], say: Callable[[str], None]) -> None:
    """Waits until nobody trains in any of the folders.

    Raises:
        FolderInUseError: Somebody still does after `WAIT_SECONDS`.
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
    """Processes that are started here have these cores from their first moment on.

    Set after their start, they might have counted their cores before.
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
    """`jaxrod train` of one run in a process of its own, beside others."""

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
        """Starts it; it goes on with what there is in the folder.

        Args:
            words: The command, after `jaxrod`.
            folder: Of the run.
            cores: The processor's cores it may use; all if empty.
            cwd: Folder in which it runs, None for this one.
            environment: Its variables, None for those of this process.
        """
        self.cores = tuple(cores)
        self._log = log_of(folder)
        words = [*words, "--resume"] if folder.exists else words
        with open_log(self._log) as said:
            said.write(f"$ jaxrod {shlex.join(words)}\n")
            said.flush()
            # A session of its own: the terminal's Ctrl-C must come from here, once.
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
        """How it ended; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        said = last_words(self._log) if code >= 0 else f"killed by signal {-code}"
        return Ended(code, said)

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


class ThisMachine:
    """Trains a few runs side by side, each on its share of the cores."""

    def __init__(self, jobs: int) -> None:
        """Deals out the cores.

        Args:
            jobs: How many runs are trained side by side.

        Raises:
            ValueError: There is no room for any.
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
        """Starts a run, or goes on with it from wherever it is."""
        return Child(words, folder, self._idle.pop(0))

    def leave(self, child: Child) -> None:
        """Takes back the cores of a run that has ended."""
        self._idle.append(child.cores)


def _shares(jobs: int) -> list[tuple[int, ...]]:
    """The cores of this process, dealt out to so many jobs.

    One job has them all without being told; so has every job where the system
    does not let processes be bound, or where there are fewer cores than jobs.
    """
    if jobs == 1 or not hasattr(os, "sched_setaffinity"):
        return [()] * jobs
    cores = sorted(os.sched_getaffinity(0))
    each = len(cores) // jobs
    return [tuple(cores[k * each : (k + 1) * each]) for k in range(jobs)]


def log_of(folder: RunFolder) -> Path:
    """What the process of a run said, beside its folder."""
    # Not `with_suffix`: names hold numbers such as 0.001.
    return folder.path.parent / f"{folder.path.name}.log"


def open_log(log: Path) -> TextIO:
    """Opens a log to be added to."""
    handle = open_to_write(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    return os.fdopen(handle, "a", encoding="utf-8")


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
