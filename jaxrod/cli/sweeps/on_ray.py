"""Runs as tasks of a Ray cluster, which finds room for them and retries them elsewhere.

Each task starts the process of its run and waits for it. All data of a run are in its
folder, on a file system that the nodes share. So a task that is retried, on any node,
continues from the last checkpoint.

A run has one writer. Its process holds the lock of the folder
(`jaxrod.training.runs.lock`). It ends when its task does, because it watches the task's
end of a pipe. If a task is retried while the first process is still alive, it waits
until the lock is free.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxrod.cli.sweeps import process
from jaxrod.cli.sweeps.process import Child, Ended, log_of, open_log, wait_for
from jaxrod.training import RunFolder
from jaxrod.training.runs.lock import FolderInUseError

RETRIES = 10
"""Number of retries of a run whose node or worker died."""
POLL_SECONDS = 2.0
SEEN_SECONDS = 90.0
"""Longest delay until a network file system shows a node's files here [s]."""

_PASSED_ON = ("PYTHONPATH", "JAX_", "JAXROD_", "XLA_")
"""Prefixes of environment variables that every run gets from this process."""


class RayTask:
    """A run that is trained on some node of the Ray cluster."""

    def __init__(self, reference: Any, folder: RunFolder) -> None:
        """Keeps the reference to the task's future result."""
        self._reference, self._folder = reference, folder
        self._said_before = _size(log_of(folder))
        self._returned = 0.0

    @property
    def begun(self) -> bool:
        """Whether a process trains it already: its log has grown."""
        return _size(log_of(self._folder)) > self._said_before

    def ended(self) -> Ended | None:
        """Outcome of the run; None while it runs or its files may still appear."""
        import ray

        if not ray.wait([self._reference], timeout=0)[0]:
            return None
        self._returned = self._returned or time.monotonic()
        try:
            ended: Ended = ray.get(self._reference)
        except ray.exceptions.TaskCancelledError:
            return Ended(130, "stopped")
        except ray.exceptions.RayError as error:
            return Ended(1, " ".join(str(error).split())[:300])
        if ended.code == 0 and not self._folder.finished:
            if time.monotonic() - self._returned < SEEN_SECONDS:
                return None
            return Ended(
                2,
                f"it ended well, but {self._folder.path} does not show it here: with "
                "--ray all nodes must share the folder of the sweep",
            )
        return ended

    def stop(self) -> None:
        """Asks the run to save and stop."""
        import ray

        ray.cancel(self._reference)

    def end(self) -> None:
        """Ends the task at once, if it has not ended."""
        import ray

        ray.cancel(self._reference, force=True)


class RayCluster:
    """Passes all runs to Ray, which trains as many at once as it has room for."""

    poll_seconds = POLL_SECONDS
    room = True

    def __init__(self, cores: int, gpus: float) -> None:
        """Sets the resources of the tasks on a connected cluster.

        Args:
            cores: Number of processor cores per run.
            gpus: Number of GPUs per run.
        """
        import ray

        self._train = ray.remote(num_cpus=cores, num_gpus=gpus, max_retries=RETRIES)(
            train_here
        )
        self._variables = {
            name: value
            for name, value in os.environ.items()
            if name.startswith(_PASSED_ON)
        }
        # XLA starts this many threads, on whichever cores the system assigns.
        self._variables["NPROC"] = str(cores)

    def start(self, words: Sequence[str], folder: RunFolder) -> RayTask:
        """Submits a run."""
        place = str(folder.path)
        reference = self._train.remote(words, place, os.getcwd(), self._variables)
        return RayTask(reference, folder)

    def leave(self, work: RayTask) -> None:
        """Does nothing: Ray frees the resources itself."""


@contextmanager
def cluster(address: str, cores: int, gpus: float) -> Iterator[RayCluster]:
    """Connects to a cluster while the context lasts.

    Args:
        address: Address of its head, HOST:PORT, or "auto" on one of its nodes.
        cores: Number of processor cores per run.
        gpus: Number of GPUs per run.

    Raises:
        ConnectionError: There is no cluster.
        ModuleNotFoundError: Ray is not installed.
    """
    import ray

    ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    try:
        yield RayCluster(cores, gpus)
    finally:
        ray.shutdown()


def train_here(
    words: Sequence[str], place: str, cwd: str, variables: Mapping[str, str]
) -> Ended:
    """Trains a run on this node, from its last checkpoint, and waits for its end.

    Args:
        words: The command, after `jaxrod`.
        place: Folder of the run.
        cwd: Folder in which to run it; a user's own task is searched there.
        variables: Environment variables, in addition to those of this node.
    """
    import ray

    folder = RunFolder(place)
    for needed in (str(folder.path.parent), cwd):
        if not os.path.isdir(needed):
            return Ended(
                2,
                f"there is no folder {needed} on {platform.node()}: with --ray all "
                "nodes must share the folder of the sweep and the current one",
            )
    log = log_of(folder)
    _add(log, f"on {platform.node()}, node {ray.get_runtime_context().get_node_id()}")
    try:
        # A task that was assumed dead may have left a process that is still saving.
        wait_for([folder], lambda text: _add(log, text))
    except FolderInUseError as error:
        return Ended(2, str(error))
    child = Child(words, folder, cwd=cwd, environment={**os.environ, **variables})
    try:
        return _waited_for(child)
    except KeyboardInterrupt:  # By `ray.cancel`.
        child.stop()
        _waited_for(child)
        raise
    finally:
        child.end()


def _waited_for(child: Child) -> Ended:
    while (ended := child.ended()) is None:
        time.sleep(process.POLL_SECONDS)
    return ended


def _add(log: Path, line: str) -> None:
    with open_log(log) as said:
        said.write(line + "\n")


def _size(file: Path) -> int:
    return file.stat().st_size if file.exists() else 0
