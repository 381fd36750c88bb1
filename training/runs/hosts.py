"""The processes of one run: a single one, or several on one or more machines.

JAX runs the same program in every process (`jax.distributed.initialize`). The first
process is the writer: it alone reads and writes the folder of the run. Facts that only
the writer knows, such as the content of the folder, are broadcast to the other
processes here, so that all of them continue or stop together. With one process nothing
is exchanged.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxrod.installation.processes import GO_ON
from jaxrod.training.leaves import is_key

_DONE, _REFUSED = b"+", b"-"
# Prefixes of JAX errors that are not caused by the communication of processes.
_OWN_FAULTS = ("RESOURCE_EXHAUSTED", "INVALID_ARGUMENT", "UNIMPLEMENTED")


class LostProcessError(RuntimeError):
    """Another process of the run has ended or is unreachable."""


class Hosts:
    """The processes that own the devices of a run."""

    def __init__(self, devices: Sequence[jax.Device]) -> None:
        """Determines which processes own the devices.

        Raises:
            ValueError: The devices belong neither to this process alone nor to each
                of the processes.
        """
        owners = {device.process_index for device in devices}
        mine = jax.process_index()
        if owners != {mine} and owners != set(range(jax.process_count())):
            raise ValueError(
                "devices must be those of this process, or of each of the "
                f"{jax.process_count()} processes; got those of {sorted(owners)}"
            )
        self.count = len(owners)
        self.writes = owners == {mine} or mine == 0

    @property
    def several(self) -> bool:
        """Whether there is more than one process."""
        return self.count > 1

    def from_writer(self, make: Callable[[], bytes]) -> bytes:
        """Calls a function in the writer and returns its result in every process.

        Raises:
            ValueError: The function raised ValueError or OSError in the writer. Every
                other process raises ValueError with the same message.
            OSError: The function raised it, in the writer.
        """
        if not self.several:
            return make()
        said, refusal = b"", None
        if self.writes:
            try:
                said = _DONE + make()
            except (ValueError, OSError) as error:
                said, refusal = _REFUSED + str(error).encode(), error
        with self.losing_none(0):
            said = _broadcast(said)
        if refusal:
            raise refusal
        if said.startswith(_REFUSED):
            raise ValueError(said[1:].decode())
        return said[1:]

    def agree(self, stop: bool, due: bool) -> tuple[bool, bool]:
        """Combines the decisions of all processes, so that all decide the same.

        Args:
            stop: Whether this process was asked to stop.
            due: Whether a checkpoint is due by the clock of this process.

        Returns:
            Whether any process was asked to stop, and whether a checkpoint is due by
            the clock of the writer.
        """
        if not self.several:
            return stop, due
        flags = multihost_utils.process_allgather(np.array([stop, due]))
        return bool(flags[:, 0].any()), bool(flags[0, 1])

    def fetched(self, tree: Any, mesh: Mesh, at_all: bool = True) -> Any:
        """Copies a pytree to host memory; every process has to call this.

        Args:
            tree: Pytree of arrays that are split over the mesh or replicated on it.
            mesh: Mesh of all devices of the run.
            at_all: Whether every process needs the arrays. If False, the processes
                other than the writer get None for each of them, and a single process
                gets `tree` itself.
        """
        if not self.several:
            return jax.device_get(tree) if at_all else tree
        repeat = jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, _REPEATED))

        def fetch(leaf: Any) -> Any:
            if not isinstance(leaf, jax.Array):
                return leaf
            if not leaf.is_fully_addressable:
                # One leaf at a time, because a replay may fill much of a device.
                leaf = leaf if leaf.is_fully_replicated else repeat(leaf)
                leaf = leaf.addressable_data(0)
            if not (self.writes or at_all):
                return None
            return leaf if is_key(leaf) else jax.device_get(leaf)

        return jax.tree.map(fetch, tree)

    @contextmanager
    def losing_none(self, steps: int) -> Iterator[None]:
        """Turns errors of the communication between processes into LostProcessError.

        Args:
            steps: Control steps of the run so far, for the message.

        Raises:
            LostProcessError: Raised instead of JAX's error.
        """
        try:
            yield
        except (ValueError, jax.errors.JaxRuntimeError) as error:
            reason = (str(error).splitlines() or [""])[0]
            if not self.several or reason.startswith(_OWN_FAULTS):
                raise
            raise LostProcessError(
                f"another of the {self.count} processes was lost after {steps:,} "
                f"steps ({reason}); {GO_ON}"
            ) from error


_REPEATED = PartitionSpec()


def packed(arrays: Mapping[str, np.ndarray], about: Any) -> bytes:
    """Packs arrays and data that JSON can hold into bytes."""
    stream = io.BytesIO()
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez(stream, allow_pickle=False, **{"": text}, **arrays)
    return stream.getvalue()


def unpacked(content: bytes) -> tuple[dict[str, np.ndarray], Any]:
    """Arrays and JSON data from the bytes of `packed`."""
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return arrays, json.loads(arrays.pop("").tobytes())


def _broadcast(content: bytes) -> bytes:
    """Returns the bytes of the first process in every process."""
    broadcast = multihost_utils.broadcast_one_to_all
    length = int(broadcast(np.array(len(content), np.int32)))
    buffer = np.zeros(length, np.uint8)
    if jax.process_index() == 0:
        buffer[:] = np.frombuffer(content, np.uint8)
    return np.asarray(broadcast(buffer), np.uint8).tobytes()
