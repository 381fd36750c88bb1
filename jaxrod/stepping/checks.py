"""Checks of a run's arguments, and of its step against the stability bound."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.model import Model, check_model
from jaxrod.validation import MOST, check_count

_ADVICE = (
    ": expect the simulation to blow up, with or without NaN. Use "
    "jaxrod.stable_dt(scene).dt, fewer elements, or a softer or thicker rod; "
    'warnings.simplefilter("error", jaxrod.UnstableStepWarning) makes this an error.'
)


class UnstableStepWarning(UserWarning):
    """The time step is above the stability bound of the scene."""


def check_step(scene: Model, dt: Array, state: Any = None) -> bool:
    """Warns if a concrete time step is above the scene's stability bound.

    Args:
        scene: The scene.
        dt: Step size [s].
        state: State of the rod, if the bound is to account for compression. In
            consistent mode it is read, and so waited for, only if that matters.

    Returns:
        Whether the step may become unstable if the rod is compressed further. True if
        it is near the bound and no warning was given.

    Raises:
        ValueError: If `dt` is not a positive number.
    """
    words, near = scene.step_warning(dt, state)
    if words is not None:
        warnings.warn(words + _ADVICE, UnstableStepWarning, stacklevel=3)
    return near


def check_counter(n_steps: Array, name: str = "n_steps") -> None:
    """Checks a number of steps that may be traced."""
    if n_steps.shape != () or not jnp.issubdtype(n_steps.dtype, jnp.integer):
        raise ValueError(
            f"{name} must be one integer, got {n_steps.dtype}{list(n_steps.shape)}"
        )


def check_first(scene: Model, first: int | Array, n_steps: int | Array) -> Array | None:
    """First step of a run, for a scene that depends on it; `None` for others."""
    check_model(scene)
    if isinstance(first, jax.Array):
        check_counter(first, "first")
    else:
        known = n_steps if isinstance(n_steps, int) else 0
        first = check_count("first", first, 0, MOST - known)
    if not scene.evolves:
        return None
    return jnp.asarray(first, jnp.int32)


def check_records(n_steps: int, every: int) -> int:
    """Checks how a run is recorded; returns the number of records except the first."""
    n_steps = check_count("n_steps", n_steps, 0)
    every = check_count("every", every, 1)
    if n_steps % every:
        raise ValueError(
            f"n_steps must be a multiple of every, got {n_steps} and {every}"
        )
    return n_steps // every
