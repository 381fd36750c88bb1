"""XLA options and CPU devices that make the simulation of rods fast.

By default XLA's CPU compiler computes shared subexpressions of a step once per
output and calls many small kernels per step. Two of its options change that. A second
CPU device lets a batch use a second core, because a small compiled loop runs on one
thread.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

import jax

from jaxrod.installation.machine import available_cores
from jaxrod.installation.program_cache import asked_for, keep_programs
from jaxrod.validation import check_count, warn

MOST_DEVICES = 1024
"""Largest number of CPU devices. A larger number is taken for a mistake, because XLA
sets up every device."""

_BACKEND_OPTIONS = {
    # One kernel computes all outputs that share work.
    "xla_cpu_use_multi_output_fusion": "",
    # A loop up to this size in bytes becomes one compiled function.
    "xla_cpu_small_while_loop_byte_threshold": "100000000",
}
_LIBRARY_FUSIONS = "--xla_cpu_experimental_ynn_fusion_type"
"""Option that chooses which operations XLA leaves to the library YNNPACK; set to none.
Since JAX 0.12 YNNPACK gets all reductions and the operations that lead to them. The
smallest distances between rods in a batch of 256 nests then take ten times as long as
in XLA's own code. XLA ends the process at an unknown option, so it is set only for
releases that are known to have it."""
_LAST_WITH_LIBRARY_FUSIONS = (0, 12)


def configure_cpu(
    devices: int | None = None,
    *,
    cache: bool | str | os.PathLike[str] | None = None,
) -> None:
    """Applies the CPU settings that make rods fast. Call it before using JAX.

    Sets `XLA_FLAGS` for this process (options that you set yourself are kept), and the
    number of CPU devices a batch can be spread over. Compiled programs are kept on disk
    for the next process, in at most 1 GB. Settings take effect only if no JAX
    computation has run yet; otherwise a warning is given.

    Args:
        devices: Number of CPU devices; by default the number of cores this process
            may use.
        cache: Whether compiled programs are kept, or the folder to keep them in; by
            default the value of the environment variable `JAXROD_CACHE` (0, 1 or a
            folder). If that is not set they are kept wherever it is safe.

    Raises:
        ValueError: If `devices` is not a positive integer, `cache` is not a folder that
            can be made, or `XLA_FLAGS` has words that are not options.

    Example:
        >>> jaxrod.configure_cpu(devices=2)
        >>> len(jax.devices("cpu"))
        2
    """
    if devices is None:
        devices = available_cores()
    devices = check_count("devices", devices, 1, MOST_DEVICES)
    kept = asked_for() if cache is None else cache
    if not isinstance(kept, bool | str | os.PathLike | None) or kept == "":
        raise ValueError(f"cache must be True, False or a folder, got {cache!r}")
    if _backend_is_running():
        warn(
            "jaxrod.configure_cpu() came after the first JAX computation and has no "
            "effect: call it right after importing jaxrod",
        )
        return
    os.environ["XLA_FLAGS"] = with_backend_options(given_options())
    jax.config.update("jax_num_cpu_devices", devices)
    if kept is None:
        keep_programs(asked=False)
    elif kept is not False:
        keep_programs(None if kept is True else kept)


def compile_for_rods() -> None:
    """Sets XLA's options as `configure_cpu` does, if `XLA_FLAGS` is not set.

    Adapters for other libraries call it, because their users may not know
    `configure_cpu`. The number of devices is not changed. Once JAX has computed
    anything, it has no effect.
    """
    if not _backend_is_running() and not os.environ.get("XLA_FLAGS", "").strip():
        os.environ["XLA_FLAGS"] = with_backend_options("")


def first_of_each(devices: Sequence[jax.Device], asked: int | None) -> list[jax.Device]:
    """Returns the first devices of each process, in the order of `devices`.

    Args:
        devices: Devices of all processes.
        asked: Number of devices from each process (`--devices`); None for all.

    Raises:
        ValueError: A process has fewer than `asked` devices.
    """
    if asked is None:
        return list(devices)
    owned: dict[int, list[jax.Device]] = {}
    for device in devices:
        owned.setdefault(device.process_index, []).append(device)
    fewest = min(len(own) for own in owned.values())
    if not 1 <= asked <= fewest:
        raise ValueError(
            f"devices must be 1 to {fewest}, the devices of each process, got {asked}"
        )
    return [device for own in owned.values() for device in own[:asked]]


def devices_that_fit(num_envs: int, asked: int | None, available: int | None) -> int:
    """Returns `asked`, else the largest number of devices that divides the batch.

    Args:
        num_envs: Number of environments in the batch.
        asked: Requested number (`--devices`); None if there is none.
        available: Number of existing devices. None before JAX has started; the result
            is then at most the number of cores.
    """
    if available is None:
        available = available_cores()
        # More devices would only split the same cores without any notice to the user.
        asked = asked if asked is None else min(asked, available)
    if asked is not None:
        return asked
    return max(k for k in range(1, available + 1) if k == 1 or num_envs % k == 0)


def given_options() -> str:
    """Returns the options in `XLA_FLAGS`, or in the file that it names, as one line.

    XLA ends the process at the first mistake. Only XLA knows its options, so words that
    look like options are not checked further.

    Raises:
        ValueError: If the text is neither options, each of which begins with two
            dashes, nor the name of a file of them.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    wanted = "must be options such as --xla_NAME=VALUE, or the name of a file of them"
    if flags and not flags.startswith("-"):
        try:
            flags = " ".join(Path(flags).read_text().split())
        except (OSError, ValueError) as error:
            raise ValueError(
                f"XLA_FLAGS {wanted}, got {flags!r:.80}, which is not a readable file; "
                "unset XLA_FLAGS if it was set by mistake"
            ) from error
    try:
        words = shlex.split(flags)
    except ValueError as error:
        raise ValueError(f"XLA_FLAGS {wanted}, got {flags!r:.80}: {error}") from error
    for word in words:
        if not word.startswith("--"):
            raise ValueError(f"XLA_FLAGS {wanted}, got {word!r:.80} among them")
    return flags


def with_backend_options(flags: str) -> str:
    """Returns `flags` with jaxrod's options added, unless the user has set them."""
    prefix = "--xla_backend_extra_options="
    words = flags.split()
    given = [w.removeprefix(prefix) for w in words if w.startswith(prefix)]
    rest = [w for w in words if not w.startswith(prefix)]
    options = [option for group in given for option in group.split(",") if option]
    names = {option.split("=")[0] for option in options}
    for name, value in _BACKEND_OPTIONS.items():
        if name not in names:
            options.append(f"{name}={value}" if value else name)
    known = jax.__version_info__[:2] <= _LAST_WITH_LIBRARY_FUSIONS
    if known and not any(word.startswith(_LIBRARY_FUSIONS) for word in rest):
        rest.append(f"{_LIBRARY_FUSIONS}=")
    return " ".join([*rest, prefix + ",".join(options)])


def _backend_is_running() -> bool:
    from jax._src import xla_bridge

    return bool(getattr(xla_bridge, "_backends", {}))
