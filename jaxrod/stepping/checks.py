"""Checks of a run's arguments, and of its step against the stability bound."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxrod.analysis.stability import compression, stable_dt
from jaxrod.composite import Composite
from jaxrod.effects.time import Clock
from jaxrod.scene import Model, check_scene, check_scene_and_state
from jaxrod.validation import MOST, as_array, check_array, check_count, is_traced

COMPRESSED = 0.9
"""Smallest fraction of the bound that remains in consistent mode under compression."""
ROUNDING = 1e-4
"""Fraction of the bound lost to round-off of positions without compression."""


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
    if isinstance(scene, Composite):
        words = scene.step_warning(dt)
        if words is not None:
            warnings.warn(words + _ADVICE, UnstableStepWarning, stacklevel=3)
        return False
    check_scene(scene)
    check_array("dt", dt, [()], "s", positive=True)
    if not scene.method.explicit:
        return False
    bound = stable_dt(scene, safety=1.0)
    largest, where = float(bound.dt), ""
    near = float(dt) > COMPRESSED * largest
    if state is not None and (near or not scene.method.has_energy):
        factor, shortest = map(float, compression(scene, state))
        if factor < 1 - ROUNDING:
            largest *= factor
            where = f" in a rod compressed to {shortest:.3g} of its length"
    if not float(dt) > largest:
        return near
    warnings.warn(
        f"dt = {float(dt):.3g} s is above the stability bound {largest:.3g} s set by "
        f"{bound.limiting_mode}{where}" + _ADVICE,
        UnstableStepWarning,
        stacklevel=3,
    )
    return False


def check_counter(n_steps: Array, name: str = "n_steps") -> None:
    """Checks a number of steps that may be traced."""
    if n_steps.shape != () or not jnp.issubdtype(n_steps.dtype, jnp.integer):
        raise ValueError(
            f"{name} must be one integer, got {n_steps.dtype}{list(n_steps.shape)}"
        )


def check_first(scene: Model, first: int | Array, n_steps: int | Array) -> Array | None:
    """First step of a run, for a scene that depends on it; `None` for others."""
    if not isinstance(scene, Composite):
        check_scene(scene)
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


def check_arguments(
    scene: Model, state: Any, dt: ArrayLike, first: Array | None
) -> Array:
    """Checks the arguments of a run; returns the step in the dtype of the scene."""
    if isinstance(scene, Composite):
        return scene.check_run(state, dt)
    check_scene_and_state(scene, state)
    dtype = scene.rod.rest_lengths.dtype
    step = as_array("dt", dt, "s", positive=True, dtype=dtype)
    if state.positions.dtype != dtype:
        raise ValueError(
            f"state must be {dtype}, as the scene's rod is, got {state.positions.dtype}"
        )
    # Within jit the step is traced, and so is whatever is computed there.
    if not is_traced(scene, state, step, first):
        now = scene.recalling(state)
        if first is not None:
            now = now.at(Clock(first, jnp.zeros_like(step), step))
        scene.method.check_state(now, state)
        if scene.evolves:
            # Values that are zero now may leave the plane or act about the axis later.
            scene.method.check_state(scene.stirred, state)
    return step
