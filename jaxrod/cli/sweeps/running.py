"""Parallel training of runs, each in its own process, and display of their progress.

Only the end of a process frees the programs and the memory that JAX holds, and the next
run has no use for them. A run that exhausts its memory, or is killed, does not end
other runs. The display has a line for every change.
"""

from __future__ import annotations

import os
import queue
import shlex
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple, Protocol, TextIO, TypeVar

from jaxrod.cli.sweeps.plan import Planned
from jaxrod.files import open_to_write
from jaxrod.training import RunFolder
from jaxrod.training.progress import ProgressBar, duration, reached
from jaxrod.training.runs.interruption import Interruption
from jaxrod.training.runs.owned_folder import FolderInUseError

POLL_SECONDS = 0.5
WAIT_SECONDS = 300.0
"""Longest wait for runs of a killed sweep to save and stop [s]."""

LAUNCHER = (sys.executable, "-P", str(Path(__file__).with_name("child.py")))


class Ended(NamedTuple):
    """Outcome of the process of a run."""

    code: int
    """Exit code of the process; -n if signal n killed it."""
    said: str
    """Last line of the output of the process, or the signal that killed it."""


class Place(Protocol):
    """A machine or cluster that trains runs."""

    @property
    def jobs(self) -> int:
        """Number of runs that can be submitted at once."""

    def train(
        self, words: Sequence[str], folder: RunFolder, stop: Event, kill: Event
    ) -> Ended:
        """Trains a run and waits for its end, as `train_here` does."""


PlannedT = TypeVar("PlannedT", bound=Planned)


def train_all(
    runs: Sequence[PlannedT],
    folder_of: Callable[[PlannedT], RunFolder],
    place: Place,
    view: RunsView,
    interruption: Interruption,
    ended: Callable[[PlannedT, Ended], None],
    more: Sequence[str] = (),
) -> None:
    """Trains runs until all have ended, as many at once as `place` accepts.

    If an interruption is requested, the active runs save and stop, and no other run
    starts. After any error the active runs are killed.

    Args:
        runs: The runs, in the order in which they start.
        folder_of: Function that returns a run's folder. A started run continues from
            its last checkpoint.
        place: Machine or cluster that trains the runs.
        view: View that shows the progress of the runs.
        interruption: Request to stop.
        ended: Function that is called with each run that has ended and its outcome.
        more: Words that are added to the commands of all runs.
    """
    stop, kill = Event(), Event()
    # The log of a run grows when its process starts.
    sizes = {run.name: _size(log_of(folder_of(run))) for run in runs}
    begun: set[str] = set()
    # A thread per process, which waits for its end.
    with ThreadPoolExecutor(place.jobs) as pool:
        training = {}
        for run in runs:
            folder = folder_of(run)
            words = [*run.command(folder.path), *more]
            training[pool.submit(place.train, words, folder, stop, kill)] = run
        try:
            while training:
                done, _ = wait(training, POLL_SECONDS, FIRST_COMPLETED)
                if interruption.requested and not stop.is_set():
                    stop.set()
                    training = {f: run for f, run in training.items() if not f.cancel()}
                for future in done & training.keys():
                    ended(training.pop(future), future.result())
                for future, run in training.items():
                    folder = folder_of(run)
                    if run.name in begun:
                        view.running(run, last_row(folder))
                    elif future.running() and _size(log_of(folder)) > sizes[run.name]:
                        begun.add(run.name)
                        view.start(run, last_row(folder))
        except BaseException:
            kill.set()
            pool.shutdown(cancel_futures=True)
            raise


def train_here(
    words: Sequence[str],
    folder: RunFolder,
    stop: Event,
    kill: Event,
    *,
    cwd: str | None = None,
    environment: Mapping[str, str] | None = None,
) -> Ended:
    """Runs `jaxrod train` in a new process and waits for its end.

    Args:
        words: The command, after `jaxrod`.
        folder: Folder of the run; a started run is resumed.
        stop: Event after which the run is asked to save and stop.
        kill: Event after which the process is killed.
        cwd: Working folder of the process, None for the current one.
        environment: Environment variables of the process, None for those of this one.
    """
    log = log_of(folder)
    words = [*words, "--resume"] if folder.exists else words
    with open_log(log) as said:
        said.write(f"$ jaxrod {shlex.join(words)}\n")
        said.flush()
        # The process has its own session: the terminal's Ctrl-C must reach it only
        # once, from here.
        process = subprocess.Popen(
            [*LAUNCHER, *words],
            stdin=subprocess.PIPE,
            stdout=said,
            stderr=said,
            start_new_session=True,
            cwd=cwd,
            env=environment,
        )
    assert process.stdin is not None
    try:
        while process.poll() is None:
            if stop.is_set():
                process.stdin.close()
            if kill.is_set():
                process.kill()
            time.sleep(POLL_SECONDS)
    finally:
        # Ray interrupts the loop to stop a run.
        process.stdin.close()
        process.wait()
    code = process.returncode
    return Ended(code, last_words(log) if code >= 0 else f"killed by signal {-code}")


class ThisMachine:
    """This machine as a place for runs, each bound to an equal share of the cores.

    Runs are not bound if there is one job, if there are fewer cores than jobs, or if
    the system cannot bind processes.
    """

    def __init__(self, jobs: int) -> None:
        """Divides the available cores among the jobs.

        Args:
            jobs: Number of runs that are trained in parallel.

        Raises:
            ValueError: `jobs` is below 1.
        """
        if jobs < 1:
            raise ValueError(f"jobs must be at least 1, got {jobs}")
        self.jobs = jobs
        self._shares: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
        cores: list[int] = []
        # A single run gets all cores without binding. So does every run if the system
        # cannot bind threads, or if there are fewer cores than jobs.
        if jobs > 1 and hasattr(os, "sched_setaffinity"):
            cores = sorted(os.sched_getaffinity(0))
        each = len(cores) // jobs
        for k in range(jobs):
            self._shares.put(cores[k * each : (k + 1) * each])

    def train(
        self, words: Sequence[str], folder: RunFolder, stop: Event, kill: Event
    ) -> Ended:
        """Trains or resumes a run on a free share of the cores, see `train_here`."""
        share = self._shares.get()
        try:
            if share:
                # Binds this thread, and with it the processes that it starts.
                os.sched_setaffinity(0, share)
            return train_here(words, folder, stop, kill)
        finally:
            self._shares.put(share)


def wait_for(folders: Iterable[RunFolder], say: Callable[[str], None]) -> None:
    """Waits until no process trains in any of the folders.

    Args:
        folders: Folders of runs.
        say: Function called with a message for each folder that is in use.

    Raises:
        FolderInUseError: A process still trains in one after `WAIT_SECONDS`.
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


def log_of(folder: RunFolder) -> Path:
    """File with the output of a run's process: FOLDER.log, next to the run folder."""
    # Not `with_suffix`: names hold numbers such as 0.001.
    return folder.path.parent / f"{folder.path.name}.log"


def open_log(log: Path) -> TextIO:
    """Opens a log for appending."""
    handle = open_to_write(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    return os.fdopen(handle, "a", encoding="utf-8")


def last_words(log: Path) -> str:
    """Last line of a log that is not blank; empty if there is none."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def last_row(folder: RunFolder) -> dict[str, str] | None:
    """Last row of a run's progress.csv, None if there is none."""
    try:
        rows = folder.progress.read()
    except FileNotFoundError:  # Removed by a run that starts over.
        return None
    return rows[-1] if rows else None


def _size(file: Path) -> int:
    return file.stat().st_size if file.exists() else 0


_STATES = ("done", "running", "stopped", "waiting", "failed")


class RunsView:
    """Prints a line when the state of a run changes and after every tenth of a run.

    The states are waiting, running, done, failed and stopped.
    """

    def __init__(self, runs: Sequence[Planned], stream: TextIO) -> None:
        """Marks all runs as waiting; prints nothing."""
        self._stream = stream
        self._states = dict.fromkeys((run.name for run in runs), "waiting")
        self._width = max(map(len, self._states))
        self._bars: dict[str, ProgressBar] = {}

    def start(self, run: Planned, row: Mapping[str, str] | None) -> None:
        """Shows that a run starts, or resumes after `row`, its last row of progress."""
        done = int(row["env_steps"]) if row else 0
        name = f"{run.name:<{self._width}}"
        self._bars[run.name] = ProgressBar(
            run.steps, "steps", done=done, name=name, stream=self._stream
        )
        self._change(run, "running", f"from {done:,} steps" if done else "")

    def running(self, run: Planned, row: Mapping[str, str] | None) -> None:
        """Shows the last row of progress of a run, if there is one."""
        if row:
            self._bars[run.name].update(int(row["env_steps"]), reached(row))

    def done(self, run: Planned, result: Mapping[str, Any], quiet: bool) -> None:
        """Shows the summary of a finished run; only counts the run if `quiet`."""
        steps, wall, score = (
            result[name] for name in ("env_steps", "wall_s", "final_score")
        )
        text = (
            f"score {score_in_words(score)}{run.beside}  {steps:,} steps  "
            f"{steps / wall:,.0f} steps/s  {duration(wall)}"
        )
        self._change(run, "done", text, quiet)

    def failed(self, run: Planned, reason: str, quiet: bool = False) -> None:
        """Shows that a run has failed; only counts the run if `quiet`."""
        self._change(run, "failed", reason, quiet)

    def stopped(self, run: Planned, row: Mapping[str, str] | None) -> None:
        """Shows that a run was interrupted after `row`, its last row of progress."""
        done = int(row["env_steps"]) if row else 0
        self._change(run, "stopped", f"after {done:,} steps")

    def say(self, text: str) -> None:
        """Prints a message on a line of its own."""
        self._stream.write(text + "\n")
        self._stream.flush()

    def _change(self, run: Planned, state: str, text: str, quiet: bool = False) -> None:
        self._states[run.name] = state
        if not quiet:
            counts = Counter(self._states.values())
            totals = ", ".join(f"{counts[s]} {s}" for s in _STATES if counts[s])
            words = (f"{run.name:<{self._width}}", f"{state:<7}", text, f"({totals})")
            self.say("  ".join(filter(None, words)))


def score_in_words(score: float | None) -> str:
    """Score as text: an integer if at least 100, else three digits; "-" for None."""
    if score is None:
        return "-"
    return f"{score:,.0f}" if abs(score) >= 100 else f"{score:.3g}"
