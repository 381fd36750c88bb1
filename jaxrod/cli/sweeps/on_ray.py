"""Runs of a sweep as tasks of a Ray cluster, which assigns nodes and retries them.

Each task starts the process of its run and waits for it. All data of a run are in its
folder, on a file system that the nodes share. So a task that is retried, on any node,
continues from the last checkpoint.

Only the process of a run writes its folder, whose lock it holds
(`jaxrod.training.runs.owned_folder`). The process ends when its task ends, because the
pipe from the task to it is then closed. If a task is retried while the first process is
still alive, the second waits until the lock is free.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from threading import Event

from jaxrod.cli.sweeps.running import Ended, log_of, open_log, train_here, wait_for
from jaxrod.training import RunFolder
from jaxrod.training.runs.owned_folder import FolderInUseError

RETRIES = 10
"""Number of retries of a run whose node or worker died."""
POLL_SECONDS = 2.0
SEEN_SECONDS = 90.0
"""Longest wait until files that another node wrote are visible here [s]."""

_PASSED_ON = ("PYTHONPATH", "JAX_", "JAXROD_", "XLA_")
"""Prefixes of the names of environment variables that this process passes to runs."""


class RayCluster:
    """A Ray cluster, which trains as many runs at once as its resources allow."""

    def __init__(self, jobs: int, cores: int, gpus: float) -> None:
        """Sets the resources of each run, on a cluster that is connected already.

        Args:
            jobs: Number of runs of the sweep, which are all submitted at once.
            cores: Number of processor cores per run.
            gpus: Number of GPUs per run.
        """
        import ray

        self.jobs = jobs
        self._task = ray.remote(num_cpus=cores, num_gpus=gpus, max_retries=RETRIES)(
            train_on_node
        )
        self._variables = {
            name: value
            for name, value in os.environ.items()
            if name.startswith(_PASSED_ON)
        }
        # XLA starts this many threads, on whichever cores the system assigns.
        self._variables["NPROC"] = str(cores)

    def train(
        self, words: Sequence[str], folder: RunFolder, stop: Event, kill: Event
    ) -> Ended:
        """Trains a run on some node, and waits until its files are visible here.

        Args:
            words: The command, after `jaxrod`.
            folder: Folder of the run.
            stop: Event after which the run is asked to save and stop.
            kill: Event after which the task is cancelled immediately.
        """
        import ray

        place = str(folder.path)
        task = self._task.remote(words, place, os.getcwd(), self._variables)
        told = False
        while not ray.wait([task], timeout=POLL_SECONDS)[0]:
            if kill.is_set():
                ray.cancel(task, force=True)
            elif stop.is_set() and not told:
                told = True  # A second request would interrupt the saving.
                ray.cancel(task)
        try:
            ended: Ended = ray.get(task)
        except ray.exceptions.TaskCancelledError:
            return Ended(130, "stopped")
        except ray.exceptions.RayError as error:
            return Ended(1, " ".join(str(error).split())[:300])
        until = time.monotonic() + SEEN_SECONDS
        while ended.code == 0 and not folder.finished and not stop.is_set():
            if time.monotonic() > until:
                return Ended(
                    2,
                    f"the run finished, but its files in {folder.path} are not visible "
                    "here: with --ray all nodes must share the folder of the sweep",
                )
            time.sleep(POLL_SECONDS)
        return ended


@contextmanager
def cluster(address: str, jobs: int, cores: int, gpus: float) -> Iterator[RayCluster]:
    """Connects to a cluster while the context lasts.

    Args:
        address: Address of the cluster's head, HOST:PORT, or "auto" on one of its
            nodes.
        jobs: Number of runs of the sweep.
        cores: Number of processor cores per run.
        gpus: Number of GPUs per run.

    Raises:
        ConnectionError: There is no cluster.
        ModuleNotFoundError: Ray is not installed.
    """
    import ray

    ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    try:
        yield RayCluster(jobs, cores, gpus)
    finally:
        ray.shutdown()


def train_on_node(
    words: Sequence[str], place: str, cwd: str, variables: Mapping[str, str]
) -> Ended:
    """Trains a run on this node, from its last checkpoint, and waits for its end.

    Args:
        words: The command, after `jaxrod`.
        place: Folder of the run.
        cwd: Working folder of the command; a user's own task is searched there.
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

    def add(line: str) -> None:
        with open_log(log_of(folder)) as said:
            said.write(line + "\n")

    add(f"on {platform.node()}, node {ray.get_runtime_context().get_node_id()}")
    try:
        # A task that was assumed dead may have left a process that is still saving.
        wait_for([folder], add)
    except FolderInUseError as error:
        return Ended(2, str(error))
    environment = {**os.environ, **variables}
    # `ray.cancel` stops it by a KeyboardInterrupt.
    return train_here(words, folder, Event(), Event(), cwd=cwd, environment=environment)
