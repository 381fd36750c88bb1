"""An average over the devices that share a run."""

from __future__ import annotations

from typing import Any

import jax


def mean_over_devices(tree: Any, axis_name: str | None) -> Any:
    """The mean of every leaf over a mapped axis, if there is one."""
    return tree if axis_name is None else jax.lax.pmean(tree, axis_name)
