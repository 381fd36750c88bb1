"""Choice of the devices for a run of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jax


def first_of_each(devices: Sequence[jax.Device], asked: int | None) -> list[jax.Device]:
    """The first devices of each process, in their order.

    Args:
        devices: Devices of all processes.
        asked: Value of --devices for each process; None for all.

    Raises:
        ValueError: A process has fewer devices.
    """
    if asked is None:
        return list(devices)
    owned: dict[int, list[jax.Device]] = {}
    for device in devices:
        owned.setdefault(device.process_index, []).append(device)
    fewest = min(len(own) for own in owned.values())
    if not 1 <= asked <= fewest:
        raise ValueError(
            f"devices must be 1 to {fewest}, which each process has, got {asked}"
        )
    return [device for own in owned.values() for device in own[:asked]]


def devices_that_fit(num_envs: int, asked: int | None, available: int | None) -> int:
    """Number of devices to use: the requested one, or as many as divide the batch.

    Args:
        num_envs: Number of environments to spread.
        asked: Value of --devices.
        available: Number of existing devices; None before JAX has started, for the
            number of cores.
    """
    if available is None:
        from jaxrod.installation.backend import available_cores

        available = available_cores()
        # More devices would only split the same cores, without the user being told.
        asked = asked if asked is None else min(asked, available)
    if asked is not None:
        return asked
    return max(k for k in range(1, available + 1) if k == 1 or num_envs % k == 0)
