"""An action is as many numbers as its task says."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


def action_of_size(action: ArrayLike, size: int) -> Array:
    """The action, if it is a vector of so many numbers.

    Raises:
        ValueError: If it is something else, in words: what could be broadcast would
            drive other actuators than it was meant for.
    """
    shape = jnp.shape(action)
    if shape != (size,):
        raise ValueError(
            f"an action of this task is a vector of {size} numbers in [-1, 1], got "
            f"shape {shape}; a batch of environments is jax.vmap of step"
        )
    return jnp.asarray(action)
