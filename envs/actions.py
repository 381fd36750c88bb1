"""Actions: as many numbers as the task says, in one environment or in each of many."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike


def action_of_size(action: ArrayLike, size: int) -> Array:
    """The action, if it is a vector of so many numbers.

    Raises:
        ValueError: If the shape differs: an action that could be broadcast would
            drive other actuators than it was meant for.
    """
    check_action_shape("action", action, (size,))
    return jnp.asarray(action)


def check_action_shape(name: str, given: Any, shape: tuple[int, ...]) -> None:
    """Raises unless what the caller handed over has the shape that is expected.

    Whoever adds a batch axis asks before it does, so that the message speaks of the
    caller's own array.

    Args:
        name: "action" of one environment, "actions" of several.
        given: What was handed over.
        shape: `(action_size,)` or `(num_envs, action_size)`.

    Raises:
        ValueError: With both shapes.
    """
    found = np.shape(given)
    if found == shape:
        return
    hint = ""
    if len(shape) == 1 and len(found) > 1:
        hint = "; a batch of environments is jax.vmap of step"
    raise ValueError(f"{name} must have shape {shape}, got {found}{hint}")
