"""Numbers that change during a run."""

from __future__ import annotations

from typing import Protocol

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxrod.training.settings import Scalar


class HasProgress(Protocol):
    """A train state that counts its updates."""

    @property
    def updates(self) -> Int[Array, ""]:
        """Number of updates so far."""

    @property
    def total_updates(self) -> Int[Array, ""]:
        """Number of updates of the whole run."""


def along_the_run(
    state: HasProgress, first: Scalar, last: Scalar, dtype: DTypeLike
) -> Float[Array, ""]:
    """Linear interpolation from `first` to `last` over the run."""
    remaining = 1 - state.updates / jnp.maximum(state.total_updates, 1)
    return last + (first - last) * jnp.clip(remaining, 0, 1).astype(dtype)
