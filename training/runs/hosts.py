"""Processes and devices of one run, on one or more machines.

JAX runs the same program in every process (`jax.distributed.initialize`). The first
process is the writer: it alone reads and writes the folder of the run. Facts that only
the writer knows, such as the contents of the folder, are broadcast to the other
processes here, so that all of them continue or stop together. With one process nothing
is exchanged.

Many updates are compiled into one program, spread over the devices of the run.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from jaxrod.installation.processes import GO_ON
from jaxrod.training.algorithm import DEVICE_AXIS, Algorithm, Metrics
from jaxrod.training.leaves import is_key
from jaxrod.training.runs.contract import check_update

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


def device_mesh(devices: Sequence[jax.Device]) -> Mesh:
    """One-dimensional mesh of devices; the environments of a run are split along it."""
    return jax.make_mesh(
        (len(devices),),
        (DEVICE_AXIS,),
        axis_types=(AxisType.Auto,),
        devices=devices,
    )


def partition_of(algorithm: Algorithm, state: Any) -> Any:
    """Partition specs of a train state, a tree prefix, from `Algorithm.partition`.

    Without a `partition` all leaves are replicated.
    """
    if algorithm.partition is None:
        return PartitionSpec()
    return algorithm.partition(state)


def place(tree: Any, specs: Any, mesh: Mesh) -> Any:
    """Copies a pytree to the devices of a mesh.

    Args:
        tree: Pytree of arrays, equal in all processes.
        specs: Tree prefix of partition specs, each for all leaves below it.
        mesh: Mesh from `device_mesh`.
    """

    def put(spec: PartitionSpec, subtree: Any) -> Any:
        sharding = NamedSharding(mesh, spec)
        if sharding.is_fully_addressable:
            return jax.device_put(subtree, sharding)
        return jax.tree.map(lambda leaf: _put_share(leaf, sharding), subtree)

    return jax.tree.map(put, specs, tree, is_leaf=_is_spec)


def _put_share(leaf: Any, sharding: NamedSharding) -> Any:
    """Copies to each device of this process its part of a leaf.

    The whole leaf is equal in all processes.
    """
    if is_key(leaf):
        words = _put_share(jax.random.key_data(leaf), sharding)
        return jax.random.wrap_key_data(words, impl=jax.random.key_impl(leaf))
    array = np.asarray(leaf)
    return jax.make_array_from_callback(array.shape, sharding, lambda i: array[i])


def trace_updates(
    algorithm: Algorithm, state: Any, capacity: int, mesh: Mesh
) -> jax.stages.Traced:
    """Traces a program that makes a given number of updates, up to `capacity`.

    Every device computes its part of the environments and of every minibatch. Only
    gradients and a few averages are exchanged. The number of updates is an argument of
    the program, so a shorter last chunk recompiles nothing.

    Args:
        algorithm: The learner.
        state: A train state; only its form is used.
        capacity: Largest number of updates of one call.
        mesh: Mesh from `device_mesh`.

    Returns:
        The program `(state, count) -> (state, metrics)`, which donates the state.

    Raises:
        ValueError: `update` breaks the contract of `Algorithm`.
    """
    specs = partition_of(algorithm, state)
    # Without a partition there is one device, and nothing to average over.
    axis = () if algorithm.partition is None else (DEVICE_AXIS,)
    # Tree prefixes: each stands for all leaves below, though their types differ.
    repeated: Any = PartitionSpec()
    along_devices: Any = PartitionSpec(None, None, DEVICE_AXIS)
    metric_specs = Metrics(scalars=repeated, episodes=along_devices)

    # Compiled, so that it is traced once for its types and for the loop.
    update = jax.jit(lambda state: algorithm.update(state, *axis))

    def updates(state: Any, count: Int[Array, ""]) -> tuple[Any, Metrics]:
        after = jax.eval_shape(update, state)
        check_update(algorithm, state, after)
        metrics = jax.tree.map(
            lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), after[1]
        )

        def body(i: Int[Array, ""], carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
            state, metrics = carry
            state, new = update(state)
            return state, jax.tree.map(lambda a, b: a.at[i].set(b), metrics, new)

        return jax.lax.fori_loop(0, count, body, (state, metrics))

    program = jax.shard_map(
        updates,
        mesh=mesh,
        in_specs=(specs, PartitionSpec()),
        out_specs=(specs, metric_specs),
        # Replicated leaves stay equal on all devices because only averages over the
        # devices change them; the checker cannot see that through the scans.
        check_vma=False,
    )
    count = jax.ShapeDtypeStruct((), jnp.int32)
    forms = _forms(state, specs, mesh)
    return jax.jit(program, donate_argnums=0).trace(forms, count)


def compile_updates(
    traced: jax.stages.Traced, mesh: Mesh
) -> Callable[[Any, int], tuple[Any, Metrics]]:
    """Compiles the program of `trace_updates`.

    Returns:
        `(state, count) -> (state, metrics)`, which makes `count` updates. The given
        state is donated and cannot be used again. The metrics have a leading axis of
        length `capacity`, of which the first `count` entries are valid.
    """
    compiled = traced.lower().compile()

    def run(state: Any, count: int) -> tuple[Any, Metrics]:
        return compiled(state, place(np.int32(count), PartitionSpec(), mesh))

    return run


def _forms(tree: Any, specs: Any, mesh: Mesh) -> Any:
    """Types of the leaves of a pytree that `place` has copied to a mesh."""

    def forms(spec: PartitionSpec, subtree: Any) -> Any:
        sharding = NamedSharding(mesh, spec)

        def form(leaf: Any) -> jax.ShapeDtypeStruct:
            kind = jax.typeof(leaf)
            return jax.ShapeDtypeStruct(
                kind.shape, kind.dtype, sharding=sharding, weak_type=kind.weak_type
            )

        return jax.tree.map(form, subtree)

    return jax.tree.map(forms, specs, tree, is_leaf=_is_spec)


def _is_spec(leaf: Any) -> bool:
    return isinstance(leaf, PartitionSpec)
