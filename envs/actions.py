"""Actions: checks that their shape fits one environment or a batch of them."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike


def action_of_size(action: ArrayLike, size: int) -> Array:
    """The action, if it is a vector of the given size.

    Raises:
        ValueError: If the shape differs: an action that could be broadcast would drive
            other actuators than intended.
    """
    check_action_shape("action", action, (size,))
    return jnp.asarray(action)


def check_action_shape(name: str, given: Any, shape: tuple[int, ...]) -> None:
    """Raises unless an array from the caller has the expected shape.

    Callers that add a batch axis check first, so that the message describes the user's
    own array.

    Args:
        name: "action" for one environment, "actions" for several.
        given: Array from the caller.
        shape: Expected shape, `(action_size,)` or `(num_envs, action_size)`.

    Raises:
        ValueError: If the shapes differ; the message shows both.
    """
    found = np.shape(given)
    if found == shape:
        return
    hint = ""
    if len(shape) == 1 and len(found) > 1:
        hint = "; a batch of environments is jax.vmap of step"
    raise ValueError(f"{name} must have shape {shape}, got {found}{hint}")
