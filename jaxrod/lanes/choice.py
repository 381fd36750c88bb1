"""The choice between lanes and XLA, and a record of the choices with their reasons."""

from __future__ import annotations

import logging
import os
from collections import deque
from dataclasses import dataclass
from functools import cache

import jax

from jaxrod.lanes.llvm.machine_code import llvm_is_installed, not_here

AUTO, ALWAYS, ROWS, NEVER = "auto", "always", "rows", "never"
MODES = (AUTO, ALWAYS, ROWS, NEVER)

_log = logging.getLogger("jaxrod.lanes")
_mode = [os.environ.get("JAXROD_LANES", AUTO)]


@dataclass(frozen=True)
class LaneChoice:
    """The choice between lanes and XLA for one compiled run.

    Example:
        >>> final = jaxrod.advance(scene, state, 1e-4, 10)
        >>> jaxrod.lane_choices()[-1]
        LaneChoice(taken=..., why='...', rods=1, ...)
    """

    taken: bool
    """Whether lanes were chosen; otherwise XLA was."""
    why: str
    """Reason as text."""
    rods: int
    """Number of rods in the batch; 1 without a batch."""
    operations: int = 0
    """Operations in a step of one rod; for a whole run, the beginning and the end are
    included."""
    seconds: float = 0.0
    """Time to write and compile the kernel [s]."""


_choices: deque[LaneChoice] = deque(maxlen=100)


def use_lanes(mode: str) -> None:
    """Sets when programs that are compiled from now on use lanes.

    Lanes are for CPUs. NVIDIA GPUs have warps instead: wherever they are faster in mode
    `"auto"`, and wherever they are possible in modes `"always"` and `"rows"`. Other
    devices use XLA.

    Args:
        mode: `"auto"` (whichever is faster), `"always"` (lanes wherever they are
            possible), `"rows"` (rows wherever they are possible), or `"never"`. The
            environment variable `JAXROD_LANES` sets the initial mode.

    Raises:
        ValueError: The mode is unknown.

    Example:
        >>> jaxrod.use_lanes("never")  # XLA alone, from now on
        >>> after = jaxrod.step(scene, state, 1e-4)
        >>> jaxrod.use_lanes("auto")  # whichever is faster
        >>> jaxrod.use_lanes("sometimes")
        Traceback (most recent call last):
            ...
        ValueError: mode must be one of auto, always, rows, never; got 'sometimes'
    """
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}; got {mode!r}")
    _mode[0] = mode


def lane_choices() -> list[LaneChoice]:
    """Returns the latest choices between lanes and XLA, one for each compiled run.

    Example:
        >>> final = jaxrod.advance(scene, state, 1e-4, 10)
        >>> jaxrod.lane_choices()[-1].rods
        1
    """
    return list(_choices)


def lane_mode() -> str:
    """Returns the mode of lanes. Programs compiled in one mode serve no other mode."""
    if _mode[0] not in MODES:
        raise ValueError(
            f"JAXROD_LANES must be one of {', '.join(MODES)}; got {_mode[0]!r}"
        )
    return _mode[0]


def lanes_wanted() -> bool:
    """Whether runs are built in the form that lanes can take."""
    return lane_mode() != NEVER and no_kernels_here() is None


def no_kernels_here() -> str | None:
    """Returns the reason why the default device has no kernels; `None` if it has."""
    device = jax.default_backend()
    if device == "cpu":
        return not_here()
    if device == "gpu":
        # Imported here because other devices do without it.
        from jaxrod.lanes.warps.cuda import not_here as no_warps_here

        return no_warps_here()
    return f"there are no kernels for {device}"


def slower() -> str | None:
    """Returns the reason why batches are slower than they could be.

    Returns:
        One sentence, or `None` if batches run in lanes, or on a GPU in warps.
    """
    reason = "the mode is 'never'" if lane_mode() == NEVER else no_kernels_here()
    if reason is None:
        return None
    if jax.default_backend() != "cpu":
        return f"XLA runs batches here, not jaxrod's own kernels, because {reason}."
    return (
        "Lanes are off: batches on CPUs run in XLA, about a fifth as fast, because "
        f"{reason}."
    )


@cache
def say_if_slower() -> None:
    """Logs one line, once, if lanes are installed but cannot be used."""
    reason = no_kernels_here()
    if reason is None:
        return
    refused(reason)
    if llvm_is_installed() and jax.default_backend() == "cpu":
        _log.warning("jaxrod: %s", slower())


def refused(words: str, rods: int = 1) -> None:
    """Records that a run is left to XLA, and the reason."""
    note(LaneChoice(False, words, rods))


def note(choice: LaneChoice) -> None:
    """Records and logs a choice."""
    _choices.append(choice)
    _log.info(
        "%s for %d rods: %s",
        "lanes" if choice.taken else "XLA",
        choice.rods,
        choice.why,
    )
