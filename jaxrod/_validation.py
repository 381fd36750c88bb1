"""Host-side checks of arguments, in words with units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

Numbers = ArrayLike | Sequence[Any]
"""What a caller may give for a number, a vector or an array of numbers."""


def is_traced(*values: Any) -> bool:
    """Whether any leaf is a tracer, whose value cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def check_count(name: str, value: Any, smallest: int) -> int:
    """Returns `value` as an int, or raises if it is not a count >= `smallest`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name} must be an integer, got {value!r}")
    if value < smallest:
        raise ValueError(f"{name} must be at least {smallest}, got {value}")
    return int(value)


LARGEST_SEED = 2**32 - 1
"""`jax.random.key` looks at no more bits unless 64-bit types are enabled."""


def check_seed(seed: Any, name: str = "seed") -> int:
    """Returns a seed as an int, or raises if it has no random numbers of its own."""
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not whole or not 0 <= seed <= LARGEST_SEED:
        raise ValueError(
            f"{name} must be an integer from 0 to {LARGEST_SEED}, got {seed!r}"
        )
    return int(seed)


def check_array(
    name: str,
    value: Any,
    shapes: Sequence[tuple[int, ...]],
    unit: str,
    *,
    positive: bool = False,
    non_negative: bool = False,
) -> Any:
    """Checks shape, finiteness and sign of a number or array of numbers.

    Values being traced by JAX are checked for shape alone.

    Args:
        name: The argument's name, for the message.
        value: A number or array.
        shapes: The shapes allowed.
        unit: SI unit, for the message ("" for a pure number).
        positive: Demand values > 0.
        non_negative: Demand values >= 0.

    Returns:
        `value`, as a NumPy float64 array unless it is traced.

    Raises:
        ValueError: Naming the argument, its value and its unit.
    """
    unit = f" {unit}" if unit else ""
    traced = is_traced(value)
    if not traced:
        try:
            value = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"{name} must be numeric{unit}, got {value!r}") from None
    if tuple(value.shape) not in [tuple(s) for s in shapes]:
        allowed = " or ".join(str(tuple(s)) for s in shapes)
        raise ValueError(f"{name} must have shape {allowed}, got {tuple(value.shape)}")
    if traced:
        return value
    for is_bad, demand in (
        (~np.isfinite(value), "finite"),
        (value <= 0 if positive else np.zeros(value.shape, bool), "positive"),
        (value < 0 if non_negative else np.zeros(value.shape, bool), "non-negative"),
    ):
        if np.any(is_bad):
            where = "" if value.ndim == 0 else f" at index {np.argwhere(is_bad)[0]}"
            bad = value[is_bad].flat[0] if value.ndim else value[()]
            raise ValueError(f"{name} must be {demand}, got {bad:g}{unit}{where}")
    return value
