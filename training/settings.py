"""Settings that all learners share, and checks of settings.

The checks run on the host, before anything is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from jaxrod.structure import pytree, static
from jaxrod.validation import check_count

Scalar = float | Float[Array, ""]
"""Numeric setting: a Python float, or a JAX array inside a traced train state."""

NetworkFactory = Callable[[str, int], Any]
"""User-supplied function that makes networks: `(role, output_size) -> network`, a flax
module or a pair of functions (init, apply)."""

Settings = Any
"""Any configuration, whose fields the checks read by name."""


@pytree
class LearnerConfig:
    """Settings common to all learners; each learner has its own defaults for some.

    Fields that are not static are traced numbers: changing them recompiles nothing.

    Example:
        >>> config = training.LearnerConfig(num_envs=64, discount=0.95)
        >>> jax.tree.leaves(config)[:2]  # traced: discount, reward_scale
        [0.95, 0.1]
    """

    num_envs: int = static(default=128)
    """Number of environments that run in parallel."""
    rollout_steps: int = static(default=128)
    """Number of decisions of each environment in one update."""
    action_repeat: int = static(default=1)
    """Number of control steps of one decision, for which its action is held."""
    hidden_sizes: tuple[int, ...] = static(default=(64, 64))
    """Widths of the hidden layers of all built-in networks."""
    network: NetworkFactory | None = static(default=None)
    """Function that makes your own networks, `(role, output_size) -> network`: a flax
    module, or a pair of functions `(init, apply)`; `None` for the built-in ones. The
    role is "policy" (observation -> action) or "critic" (observation -> value; in SAC,
    TD3 and DDPG the input is observation and action, concatenated). For SAC a policy
    has two outputs per action: first all means, then all log standard deviations."""
    spread_phases: bool = static(default=True)
    """Whether the first episodes start at random elapsed times, so that they end at
    different times; see `jaxrod.envs.VectorEnvironment`."""
    discount: Scalar = 0.99
    """Discount factor gamma, per decision."""
    reward_scale: Scalar = 0.1
    """Factor by which rewards are scaled for learning."""
    observation_limit: Scalar = 10.0
    """Bound to which normalised observations are clipped."""
    short_steps: Scalar = 0.0
    """Control steps from the start of the run during which episodes are cut short, so
    that more episodes begin. Such episodes are truncated, not terminated, and are left
    out of the mean return."""
    short_length: Scalar = 500.0
    """Length of an episode that is cut short [control steps]."""

    def recurrent_units(self, role: str) -> int:
        """Number of recurrent units of a built-in network; 0 without memory.

        Args:
            role: "policy" or "critic".
        """
        del role
        return 0


WIDEST_LAYER = 16_384
"""Largest number of units of a hidden layer. The weights between two such layers take
1 GB."""

MOST_LAYERS = 1_000
"""Largest number of hidden layers that a policy file can hold."""

LARGEST_COUNT = 2**31 - 1
"""Largest count of updates, sizes and loop iterations, which are 32-bit integers."""


def check_steps(steps: int, per_update: int) -> int:
    """Validates the length of a run and returns its updates: ceil(steps / per_update).

    Args:
        steps: Control steps of the run.
        per_update: Control steps of one update.

    Raises:
        ValueError: `steps` is less than one update, or more than `LARGEST_COUNT`
            updates.
    """
    if steps < per_update:
        raise ValueError(
            f"steps must be at least one update, {per_update} control steps, "
            f"got {steps}"
        )
    if steps > LARGEST_COUNT * per_update:
        raise ValueError(
            f"steps must be at most {LARGEST_COUNT:,} updates of {per_update} control "
            f"steps, got {steps}"
        )
    return -(-steps // per_update)


def check_counts(config: Settings, *names: str) -> None:
    """Raises ValueError unless each named setting is an integer from 1 to 2^31 - 1."""
    for name in names:
        _check_size(name, getattr(config, name))


def _check_size(name: str, value: Any) -> None:
    """Raises ValueError unless a setting is an integer from 1 to `LARGEST_COUNT`."""
    if check_count(name, value, 1) > LARGEST_COUNT:
        raise ValueError(f"{name} must be at most {LARGEST_COUNT}, got {value}")


def check_learner(config: LearnerConfig, num_devices: int) -> None:
    """Validates the settings that all learners share.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_counts(config, "num_envs", "rollout_steps", "action_repeat")
    check_fractions(config, "discount")
    check_not_negative(config, "short_steps")
    check_positive(config, "reward_scale", "observation_limit", "short_length")
    if config.num_envs % num_devices:
        raise ValueError(
            f"num_envs must be a multiple of the number of devices, {num_devices}, "
            f"got {config.num_envs}"
        )
    sizes = config.hidden_sizes
    if not isinstance(sizes, tuple):
        raise ValueError(f"hidden_sizes must be a tuple of sizes, got {sizes}")
    if len(sizes) > MOST_LAYERS:
        raise ValueError(
            f"hidden_sizes must be at most {MOST_LAYERS} layers, got {len(sizes)}"
        )
    for size in sizes:
        check_count(f"each of hidden_sizes {sizes}", size, 1)
        check_units("each of hidden_sizes", size)
    if config.network is not None and not callable(config.network):
        raise ValueError(
            "network must be a function (role, output_size) -> network, got "
            f"{config.network!r:.80}"
        )


def check_units(name: str, size: Any) -> None:
    """Raises ValueError unless a width is an integer from 0 to `WIDEST_LAYER`."""
    if check_count(name, size, 0) > WIDEST_LAYER:
        raise ValueError(
            f"{name} must be at most {WIDEST_LAYER:,} units, got {size:,} units"
        )


def check_fractions(config: Settings, *names: str) -> None:
    """Raises ValueError unless each named setting is between 0 and 1."""
    for name in names:
        number = float(getattr(config, name))
        if not 0 <= number <= 1:
            raise ValueError(f"{name} must be between 0 and 1, got {number}")


def check_positive(config: Settings, *names: str) -> None:
    """Raises ValueError unless each named setting is positive and finite."""
    for name in names:
        number = float(getattr(config, name))
        if not 0 < number < float("inf"):
            raise ValueError(f"{name} must be positive and finite, got {number}")


def check_not_negative(config: Settings, *names: str) -> None:
    """Raises ValueError unless each named setting is finite and not negative."""
    for name in names:
        number = float(getattr(config, name))
        if not 0 <= number < float("inf"):
            raise ValueError(f"{name} must be finite and not negative, got {number}")


def check_finite(config: Settings, *names: str) -> None:
    """Raises ValueError unless each named setting is finite."""
    for name in names:
        number = float(getattr(config, name))
        if not abs(number) < float("inf"):
            raise ValueError(f"{name} must be finite, got {number}")
