"""Checks of a learner's settings, on the host, before anything is compiled."""

from __future__ import annotations

from typing import Any

Settings = Any
"""A configuration: a pytree with the fields that are named."""


def check_counts(config: Settings, *names: str) -> None:
    """Raises ValueError unless every one of these is at least 1."""
    for name in names:
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be at least 1, got {getattr(config, name)}")


def check_sizes(config: Settings, num_devices: int) -> None:
    """Checks what every learner has: a batch, a rollout, networks.

    Raises:
        ValueError: with the name and the value of what is wrong.
    """
    check_counts(config, "num_envs", "rollout_steps", "action_repeat")
    check_not_negative(config, "short_steps")
    check_positive(config, "short_length")
    if config.num_envs % num_devices:
        raise ValueError(
            f"num_envs must be a multiple of the number of devices, {num_devices}, "
            f"got {config.num_envs}"
        )
    if any(size < 1 for size in config.hidden_sizes):
        raise ValueError(
            f"hidden_sizes must all be at least 1, got {config.hidden_sizes}"
        )


def check_fractions(config: Settings, *names: str) -> None:
    """Raises ValueError unless every one of these is between 0 and 1."""
    for name in names:
        number = float(getattr(config, name))
        if not 0 <= number <= 1:
            raise ValueError(f"{name} must be between 0 and 1, got {number}")


def check_positive(config: Settings, *names: str) -> None:
    """Raises ValueError unless every one of these is positive and finite."""
    for name in names:
        number = float(getattr(config, name))
        if not 0 < number < float("inf"):
            raise ValueError(f"{name} must be positive and finite, got {number}")


def check_not_negative(config: Settings, *names: str) -> None:
    """Raises ValueError unless every one of these is finite and not negative."""
    for name in names:
        number = float(getattr(config, name))
        if not 0 <= number < float("inf"):
            raise ValueError(f"{name} must be finite and not negative, got {number}")


def check_finite(config: Settings, *names: str) -> None:
    """Raises ValueError unless every one of these is finite."""
    for name in names:
        number = float(getattr(config, name))
        if not abs(number) < float("inf"):
            raise ValueError(f"{name} must be finite, got {number}")
