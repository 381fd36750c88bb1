"""The processes of one run: one, or many on one machine or several.

JAX runs the same program in every process (`jax.distributed.initialize`). The first
process is the writer: it alone has the folder of the run. Whatever only it can know,
what a folder holds, say, or that there is none, it tells the others here, so that all
go on or stop together; with one process nothing is exchanged and nothing is slower.
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
# How JAX's errors begin that are not about an exchange.
_OWN_FAULTS = ("RESOURCE_EXHAUSTED", "INVALID_ARGUMENT", "UNIMPLEMENTED")


class LostProcessError(RuntimeError):
    """Another process of the run has ended, or cannot be reached."""


class Hosts:
    """The processes whose devices a run uses."""

    def __init__(self, devices: Sequence[jax.Device]) -> None:
        """Finds out whose the devices are.

        Raises:
            ValueError: They belong to some of the other processes only.
        """
        owners = {device.process_index for device in devices}
        mine = jax.process_index()
        if owners != {mine} and owners != set(range(jax.process_count())):
            raise ValueError(
                "devices must be those of this process, or of each of the "
                f"{jax.process_count()} there are; got those of {sorted(owners)}"
            )
        self.count = len(owners)
        self.writes = owners == {mine} or mine == 0

    @property
    def several(self) -> bool:
        """Whether there is more than one process."""
        return self.count > 1

    def from_writer(self, make: Callable[[], bytes]) -> bytes:
        """What the writer makes, at every process.

        Raises:
            ValueError: The writer has refused, and why; so do all.
            OSError: At the writer, where it could not read or write.
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
            said = _told(said)
        if refusal:
            raise refusal
        if said.startswith(_REFUSED):
            raise ValueError(said[1:].decode())
        return said[1:]

    def agree(self, stop: bool, due: bool) -> tuple[bool, bool]:
        """Whether any process wants to stop, and whether the writer wants to save."""
        if not self.several:
            return stop, due
        flags = multihost_utils.process_allgather(np.array([stop, due]))
        return bool(flags[:, 0].any()), bool(flags[0, 1])

    def fetched(self, tree: Any, mesh: Mesh, at_all: bool = True) -> Any:
        """A tree in the memory of the host; every process has to ask for it.

        Args:
            tree: Its leaves are spread over the mesh or repeated on it.
            mesh: Of all devices of the run.
            at_all: False: where only the writer needs it, and others get None.
        """
        if not self.several:
            return jax.device_get(tree) if at_all else tree
        repeat = jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, _REPEATED))

        def fetch(leaf: Any) -> Any:
            if not isinstance(leaf, jax.Array):
                return leaf
            if not leaf.is_fully_addressable:
                # One leaf at a time, for a replay may fill much of a device.
                leaf = leaf if leaf.is_fully_replicated else repeat(leaf)
                leaf = leaf.addressable_data(0)
            if not (self.writes or at_all):
                return None
            return leaf if is_key(leaf) else jax.device_get(leaf)

        return jax.tree.map(fetch, tree)

    @contextmanager
    def losing_none(self, steps: int) -> Iterator[None]:
        """Says what it means when JAX cannot exchange what it has to.

        Raises:
            LostProcessError: Instead of JAX's error.
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
    """Arrays and what JSON can hold, as bytes."""
    stream = io.BytesIO()
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez(stream, allow_pickle=False, **{"": text}, **arrays)
    return stream.getvalue()


def unpacked(content: bytes) -> tuple[dict[str, np.ndarray], Any]:
    """What `packed` was given."""
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return arrays, json.loads(arrays.pop("").tobytes())


def _told(content: bytes) -> bytes:
    """The bytes of the first process, at all."""
    tell = multihost_utils.broadcast_one_to_all
    length = int(tell(np.array(len(content), np.int32)))
    buffer = np.zeros(length, np.uint8)
    if jax.process_index() == 0:
        buffer[:] = np.frombuffer(content, np.uint8)
    return np.asarray(tell(buffer), np.uint8).tobytes()
