"""The choice between jaxrod's own kernels (lanes) and XLA, and a record of choices."""

from __future__ import annotations

import logging
import os
from collections import deque
from dataclasses import dataclass
from functools import cache

import jax

from jaxrod.lanes.llvm.machine_code import llvm_is_installed, not_here

AUTO, ALWAYS, LOOPS, ROWS, NEVER = "auto", "always", "loops", "rows", "never"
MODES = (AUTO, ALWAYS, LOOPS, ROWS, NEVER)

_log = logging.getLogger("jaxrod.lanes")
_mode = [os.environ.get("JAXROD_LANES", AUTO)]


@dataclass(frozen=True)
class LaneChoice:
    """The choice between jaxrod's kernels and XLA for one compiled run.

    Example:
        >>> final = jaxrod.advance(scene, state, 1e-4, 10)
        >>> jaxrod.lane_choices()[-1]
        LaneChoice(taken=..., why='...', rods=..., ...)
    """

    taken: bool
    """Whether a kernel of lanes, rows or warps was chosen; otherwise XLA was."""
    why: str
    """Reason of the choice; if a kernel was chosen, its type, such as `"rows of 64
    bytes"`."""
    rods: int
    """Number of rods in the batch; 1 without a batch."""
    operations: int = 0
    """Size of the kernel; 0 for XLA. Lanes: number of graph nodes, with inputs and
    constants. Lanes in loops, rows and warps: lines of LLVM IR that compute a value.
    Beginning and end of a run count too."""
    seconds: float = 0.0
    """Time spent on generating and compiling the kernel [s]; 0 for XLA."""


_choices: deque[LaneChoice] = deque(maxlen=100)


def use_lanes(mode: str) -> None:
    """Sets when programs compiled from now on use jaxrod's kernels instead of XLA.

    On CPUs, lanes process as many rods at once as a vector register has numbers, and
    rows process one rod, with its elements in the vector register. Long programs of
    lanes are loops over the elements. On NVIDIA GPUs, warps of 32 threads process one
    scene each: wherever they are faster in mode `"auto"`, and wherever they are
    possible in modes `"always"`, `"loops"` and `"rows"`. Other devices use XLA.

    Args:
        mode: `"auto"` (whichever is likely to be faster), `"always"` (lanes wherever
            they are possible), `"loops"` (lanes in loops wherever they are possible),
            `"rows"` (rows wherever they are possible), or `"never"`. The environment
            variable `JAXROD_LANES` sets the initial mode.

    Raises:
        ValueError: The mode is unknown.

    Example:
        >>> jaxrod.use_lanes("never")  # XLA alone, from now on
        >>> after = jaxrod.step(scene, state, 1e-4)
        >>> jaxrod.use_lanes("auto")  # whichever is faster
        >>> jaxrod.use_lanes("often")
        Traceback (most recent call last):
            ...
        ValueError: mode must be one of auto, always, loops, rows, never; got 'often'
    """
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}; got {mode!r}")
    _mode[0] = mode


def lane_choices() -> list[LaneChoice]:
    """Returns the latest choices between kernels and XLA, one per compiled run.

    At most 100 are kept, the oldest first.

    Example:
        >>> final = jaxrod.advance(scene, state, 1e-4, 10)
        >>> jaxrod.lane_choices()[-1].rods
        1
    """
    return list(_choices)


def lane_mode() -> str:
    """Returns the mode of the choice between kernels and XLA, such as `"auto"`.

    It is set by `use_lanes` or by the environment variable `JAXROD_LANES`. A program
    that was compiled in one mode is not reused in another.

    Raises:
        ValueError: The environment variable has an unknown mode.
    """
    if _mode[0] not in MODES:
        raise ValueError(
            f"JAXROD_LANES must be one of {', '.join(MODES)}; got {_mode[0]!r}"
        )
    return _mode[0]


def lanes_wanted() -> bool:
    """Whether runs are traced as primitives that kernels can replace.

    It is false in mode `"never"`, and if the default device has no kernels.
    """
    return lane_mode() != NEVER and no_kernels_here() is None


def rows_wanted() -> bool:
    """Whether rows may run a program for one scene, or for one after another.

    Only rows have loops whose length depends on numbers.
    """
    return lane_mode() in (AUTO, ROWS) and jax.default_backend() == "cpu"


def no_kernels_here() -> str | None:
    """Returns the reason why there are no kernels for the default device, or `None`."""
    device = jax.default_backend()
    if device == "cpu":
        return not_here()
    if device == "gpu":
        # Imported here because other devices do without it.
        from jaxrod.lanes.warps.cuda import not_here as no_warps_here

        return no_warps_here()
    return f"there are no kernels for {device}"


def slower() -> str | None:
    """Returns the reason why batches run in XLA rather than in jaxrod's kernels.

    Returns:
        One sentence; `None` if batches run in lanes, or on a GPU in warps.
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
    """Records once per process why the default device has no kernels.

    On a CPU with llvmlite installed, the reason is logged as a warning too.
    """
    reason = no_kernels_here()
    if reason is None:
        return
    refused(reason)
    if llvm_is_installed() and jax.default_backend() == "cpu":
        _log.warning("jaxrod: %s", slower())


def refused(words: str, rods: int = 1) -> None:
    """Records that a run of `rods` rods is left to XLA, for the reason `words`."""
    note(LaneChoice(False, words, rods))


def note(choice: LaneChoice) -> None:
    """Appends a choice to the record that `lane_choices` returns, and logs it."""
    _choices.append(choice)
    _log.info(
        "%s for %d rods: %s",
        "lanes" if choice.taken else "XLA",
        choice.rods,
        choice.why,
    )
