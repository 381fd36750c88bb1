"""Checks of accelerators, which differ from CPUs: memory, and bitwise repeatability.

Neither makes a result wrong, so no check here fails a machine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from jaxrod.installation.check import Check

if TYPE_CHECKING:
    import jax

CALLS = 8
"""Number of calls of one program that are compared."""

ALL_BUT_NOTHING = 0.05
"""Fraction of the memory below which next to nothing is free [1]."""


def check_memory(
    platform: str, stats: Mapping[str, int] | None, setting: str
) -> Check | None:
    """Reports how much memory of a device JAX may take, and how much of it is free.

    Args:
        platform: Platform of the device.
        stats: Result of `jax.Device.memory_stats`, in bytes; None if there is none, as
            on CPUs.
        setting: `XLA_PYTHON_CLIENT_MEM_FRACTION`, "" if it is not set.

    Returns:
        The check; None if there is nothing to report.
    """
    limit = (stats or {}).get("bytes_limit", 0)
    if not stats or not limit:
        return None
    used = stats.get("bytes_in_use", 0)
    part = f"{setting} of the device" if setting else "three quarters of the device"
    detail = f"{limit / 1e9:.1f} GB for JAX ({part}), {used / 1e9:.1f} GB in use"
    advice = ""
    if limit - used < ALL_BUT_NOTHING * limit:
        advice = "Nearly nothing is free: end what else computes there."
    return Check(f"memory on {platform}", True, detail, advice)


def check_repeatability(device: jax.Device) -> Check:
    """Calls one program several times and compares the bits of its results.

    It adds many numbers to few places, multiplies matrices and sums, as gradients of
    networks do. On GPUs additions to one place happen in any order by default. A run
    that is repeated or resumed then agrees up to round-off, but not bit by bit.
    """
    import jax
    import jax.numpy as jnp

    draws = np.random.default_rng(0)
    values = draws.standard_normal((1 << 14, 8)).astype(np.float32)
    places = draws.integers(0, 7, 1 << 14)

    def program(values: jax.Array, places: jax.Array) -> tuple[jax.Array, ...]:
        sums = jnp.zeros((7, 8), values.dtype).at[places].add(values)
        return sums, values.T @ values, jnp.sum(jnp.tanh(values))

    put = jax.device_put((values, places), device)
    compiled = jax.jit(program)
    different = calls_that_differ(lambda: [np.asarray(x) for x in compiled(*put)])
    detail = f"{different} of {CALLS} calls of one program gave other bits"
    advice = ""
    if different:
        advice = (
            "Runs repeat up to rounding here, and a resumed run may end otherwise than "
            "one in one go. For equal bits, slower: "
            "XLA_FLAGS=--xla_gpu_deterministic_ops=true."
        )
    return Check(f"equal bits on {device.platform}", True, detail, advice)


def calls_that_differ(call: Callable[[], list[np.ndarray]], calls: int = CALLS) -> int:
    """Number of calls whose results differ in any bit from those of the first.

    Args:
        call: Function that returns arrays, of the same shapes each time.
        calls: Number of calls, without the first.
    """
    first = [array.tobytes() for array in call()]
    return sum([array.tobytes() for array in call()] != first for _ in range(calls))
