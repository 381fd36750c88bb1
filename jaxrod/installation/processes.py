"""Joins this process to the others of one program, on this machine or on many."""

from __future__ import annotations

import jax

LOST_AFTER = 20
"""A process that was not heard of for so long is taken for lost [s]."""

PATIENCE = 60
"""Processes wait for each other for so long when they end [s]."""


def join_processes(
    coordinator: str | None = None, count: int | None = None, index: int | None = None
) -> None:
    """Joins the processes of one program; call it before JAX computes anything.

    `jax.distributed.initialize`, which knows SLURM, Open MPI and Kubernetes, with times
    after which a lost process shows. Without arguments it asks these.

    Args:
        coordinator: address and port of the first process, such as "10.0.0.1:1234".
        count: number of processes.
        index: number of this one, from 0.

    Raises:
        ValueError: an argument makes no sense, or nothing says what the others are.
        RuntimeError: they cannot be reached.
    """
    given = (coordinator, count, index)
    if any(one is None for one in given) and any(one is not None for one in given):
        raise ValueError(
            "coordinator, count and index must be given together or not at all, got "
            f"{coordinator!r}, {count!r} and {index!r}"
        )
    if coordinator is not None and count is not None and index is not None:
        host, _, port = coordinator.rpartition(":")
        if not host or not port.isdecimal():
            raise ValueError(
                f"coordinator must be an address and a port, got {coordinator!r}"
            )
        if not 0 <= index < count:
            raise ValueError(
                f"index must be 0 to {count - 1} of {count} processes, got {index}"
            )
    # Its handler takes SIGTERM away from whoever wants to save first.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            coordinator,
            count,
            index,
            heartbeat_timeout_seconds=LOST_AFTER,
            shutdown_timeout_seconds=PATIENCE,
        )
    except ValueError as error:
        raise ValueError(
            "nothing that JAX knows (SLURM, Open MPI, Kubernetes) says which processes "
            f"there are: give coordinator, count and index ({error})"
        ) from error
