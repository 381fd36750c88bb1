"""Joins the processes of one JAX program, on one or several machines."""

from __future__ import annotations

import errno
import faulthandler
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import IO

JOINED_WITHIN = 30
"""Default time within which all processes of a program must join [s]."""

LARGEST_PORT = 65_535
"""Largest number of a TCP port."""

LONGEST_WAIT = 604_800
"""Largest time that processes may be given to join, a week [s]."""

LOST_AFTER = 20
"""Time without contact after which a process counts as lost [s]."""

PATIENCE = 60
"""Time for which processes wait for each other at the end of the program [s]."""

GO_ON = "resume continues a run from its last checkpoint, with any number of processes"
"""Advice that ends the messages about a lost process."""

# Program of the listening process. The last line before a fault is the message, printed
# if the fault is an abort. The output of other faults is printed unchanged.
_LISTENER = """
import signal, sys
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    if hasattr(signal, name):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
sentence = fault = ""
for line in sys.stdin:
    if fault or line.startswith("Fatal Python error"):
        fault += line
        if fault.rstrip() == "Fatal Python error: Aborted":
            break
    else:
        sentence = line
if fault:
    sys.stderr.write(sentence if "Aborted" in fault.partition("\\n")[0] else fault)
"""

_last_words: list[Callable[[str], None]] = []


class LastWords:
    """Prints a message when JAX's runtime aborts this process.

    If another process of a program is lost, the runtime writes many lines and aborts,
    and no handler in Python runs any more. But `faulthandler` still writes to a pipe. A
    small process that was started before reads the pipe and prints the message. Nothing
    is printed if this process ends in another way.
    """

    def __init__(self) -> None:
        """Starts the process that prints, unless `faulthandler` is in use already."""
        self._to: IO[str] | None = None
        if faulthandler.is_enabled():
            return
        listener = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _LISTENER],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        # The listener outlives this process, and nobody waits for it.
        listener.returncode = 0
        self._to = listener.stdin
        assert self._to
        faulthandler.enable(self._to, all_threads=False)

    def __call__(self, sentence: str) -> None:
        """Sets the message, one line, that is printed if this process is aborted."""
        if self._to:
            try:
                self._to.write(sentence.replace("\n", " ") + "\n")
                self._to.flush()
            except OSError:  # The listener was ended, so only JAX's lines appear.
                faulthandler.disable()
                self._to = None


def join_processes(
    coordinator: str | None = None,
    count: int | None = None,
    index: int | None = None,
    within: int = JOINED_WITHIN,
) -> None:
    """Joins the processes of one program; call it before JAX computes anything.

    It calls `jax.distributed.initialize` with timeouts after which a lost process is
    noticed. Without arguments the values come from SLURM, Open MPI or Kubernetes. If
    another process is lost, JAX writes its own lines and aborts this process. A message
    on the standard error then explains the reason.

    Args:
        coordinator: Address and port of the first process, such as "10.0.0.1:1234".
        count: Number of processes.
        index: Index of this process, from 0.
        within: Time in which all processes must join, a whole number [s]; after it this
            process is aborted.

    Raises:
        ValueError: If an argument is invalid, no launcher describes the processes, or
            another program has the coordinator's port.
        RuntimeError: If the processes cannot be reached.
    """
    import jax

    given = (coordinator, count, index)
    if any(one is None for one in given) and any(one is not None for one in given):
        raise ValueError(
            "coordinator, count and index must be given together or not at all, got "
            f"{coordinator!r}, {count!r} and {index!r}"
        )
    detection = None
    if coordinator is not None and count is not None and index is not None:
        host, _, port = coordinator.rpartition(":")
        if not host or not port.isdecimal():
            raise ValueError(
                f"coordinator must be an address and a port, got {coordinator!r}"
            )
        if not (port.isascii() and len(port) < 9 and 1 <= int(port) <= LARGEST_PORT):
            raise ValueError(
                f"the port of the coordinator must be 1 to {LARGEST_PORT}, got "
                f"{port:.20}"
            )
        if count < 1:
            raise ValueError(f"count of processes must be at least 1, got {count}")
        if not 0 <= index < count:
            raise ValueError(
                f"index must be 0 to {count - 1} of {count} processes, got {index}"
            )
        if "KUBERNETES_SERVICE_HOST" in os.environ:
            # Detection would add nothing, and would need a package and permissions.
            detection = "deactivate"
    whole = isinstance(within, int) and not isinstance(within, bool)
    if not whole or not 1 <= within <= LONGEST_WAIT:
        raise ValueError(
            f"within must be a whole number of 1 to {LONGEST_WAIT} s, got {within} s"
        )
    if coordinator is not None and index == 0:
        _check_port(int(coordinator.rpartition(":")[2]))
    if not _last_words:
        _last_words.append(LastWords())
    _last_words[0](
        f"jaxrod: not all processes of the program joined within {within} s, or the "
        f"first was lost; start all of them again: {GO_ON}"
    )
    # This service would take the SIGTERM signal away from programs that want to save
    # first.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            coordinator,
            count,
            index,
            cluster_detection_method=detection,
            initialization_timeout=within,
            heartbeat_timeout_seconds=LOST_AFTER,
            shutdown_timeout_seconds=PATIENCE,
        )
    except jax.errors.JaxRuntimeError as error:
        reason = (str(error).splitlines() or [""])[0]
        if "RPC server" not in reason:
            raise
        raise ValueError(
            "the first process cannot listen on the coordinator's port, which another "
            f"program may have taken: choose another port ({reason})"
        ) from error
    except ValueError as error:
        raise ValueError(
            "JAX found no SLURM, Open MPI or Kubernetes that describes the processes: "
            f"give coordinator, count and index ({error})"
        ) from error
    _last_words[0](
        "jaxrod: JAX ended this process, as it does when another of the program is "
        f"lost or cannot be reached: {GO_ON}"
    )


def _check_port(port: int) -> None:
    """Raises ValueError if this process cannot listen on a port: JAX would hang."""
    both = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if both else socket.AF_INET
    try:
        # Opened as a server would: a connection that has just ended does not prevent
        # it.
        socket.create_server(("", port), family=family, dualstack_ipv6=both).close()
    except OSError as error:
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            return  # For example no network: JAX gives a better error.
        raise ValueError(
            f"the first process cannot listen on the coordinator's port {port} "
            f"({os.strerror(error.errno)}): choose another port"
        ) from error
