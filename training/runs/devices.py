"""Compilation of many updates into one program, spread over the devices of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from jaxrod.training.algorithm import DEVICE_AXIS, Algorithm, Metrics
from jaxrod.training.leaves import is_key


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
    """Copies to this process's devices their part of a leaf.

    The whole leaf is equal in all processes.
    """
    if is_key(leaf):
        words = _put_share(jax.random.key_data(leaf), sharding)
        return jax.random.wrap_key_data(words, impl=jax.random.key_impl(leaf))
    array = np.asarray(leaf)
    return jax.make_array_from_callback(array.shape, sharding, lambda i: array[i])


def compile_updates(
    algorithm: Algorithm, state: Any, capacity: int, mesh: Mesh
) -> Callable[[Any, int], tuple[Any, Metrics]]:
    """Compiles a program that makes a given number of updates, up to `capacity`.

    Args:
        algorithm: The learner.
        state: A train state on the devices of the mesh; only its form is used.
        capacity: Largest number of updates of one call.
        mesh: Mesh from `device_mesh`.

    Returns:
        `(state, count) -> (state, metrics)`, which makes `count` updates. The given
        state is donated and cannot be used again. The metrics have a leading axis of
        length `capacity`, of which the first `count` entries are valid.
    """
    compiled = lower_updates(algorithm, state, capacity, mesh).compile()

    def run(state: Any, count: int) -> tuple[Any, Metrics]:
        return compiled(state, place(np.int32(count), PartitionSpec(), mesh))

    return run


def lower_updates(
    algorithm: Algorithm, state: Any, capacity: int, mesh: Mesh
) -> jax.stages.Lowered:
    """The lowered program of `compile_updates`, before compilation; same arguments.

    Every device computes its part of the environments and of every minibatch. Only
    gradients and a few averages are exchanged. The number of updates is an argument of
    the program, so a shorter last chunk recompiles nothing.
    """
    specs = partition_of(algorithm, state)
    # Without a partition there is one device, and nothing to average over.
    axis = () if algorithm.partition is None else (DEVICE_AXIS,)
    # Tree prefixes: each stands for all leaves below, though their types differ.
    repeated: Any = PartitionSpec()
    along_devices: Any = PartitionSpec(None, None, DEVICE_AXIS)
    metric_specs = Metrics(scalars=repeated, episodes=along_devices)

    def updates(state: Any, count: Int[Array, ""]) -> tuple[Any, Metrics]:
        shapes = jax.eval_shape(lambda s: algorithm.update(s, *axis)[1], state)
        metrics = jax.tree.map(
            lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), shapes
        )

        def body(i: Int[Array, ""], carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
            state, metrics = carry
            state, new = algorithm.update(state, *axis)
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
    return jax.jit(program, donate_argnums=0).lower(state, count)


def _is_spec(leaf: Any) -> bool:
    return isinstance(leaf, PartitionSpec)
