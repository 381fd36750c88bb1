"""A function that JAX has removed but brax 0.14.2, the newest release, still calls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


@contextmanager
def patched_jax() -> Iterator[None]:
    """Restores `jax.device_put_replicated`, which brax's learners call.

    JAX 0.10 removed it. Inside `with patched_jax():` it exists again, and afterwards it
    is gone: call brax's `train` there.
    """
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = _device_put_replicated
    try:
        yield
    finally:
        del jax.device_put_replicated


def _device_put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
    """A copy of every array for every device, along a new first axis.

    The axis has the name that brax's learners give it. Under another name their first
    epoch would be compiled for arrays of its own, and the next epoch once more.
    """
    one_each = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([leaf] * len(devices)), one_each), x
    )
