"""What a learner must offer for the shared loop to train with it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jaxtyping import Array

from jaxrod.envs import EpisodeRecord
from jaxrod.structure import pytree
from jaxrod.training.policy import Policy

DEVICE_AXIS = "env"
"""Name of the device axis over which the environments of a run are spread."""


@pytree
class Metrics:
    """What one update reports.

    Attributes:
        scalars: named numbers, the same on every device.
        episodes: the complete episodes that ended, shape (steps, num_envs), in
            the order of time.
    """

    scalars: dict[str, Array]
    episodes: EpisodeRecord


def steps_per_update(config: Any) -> int:
    """Control steps of one update: num_envs * rollout_steps * action_repeat."""
    return config.num_envs * config.rollout_steps * config.action_repeat


@dataclass(frozen=True)
class Algorithm:
    """A learner as a record of pure functions.

    Its train state is one pytree that holds all there is: numbers of the
    configuration, weights, optimiser, environments, keys. Two states made by
    `init` from configurations that differ only in numbers share one program.

    Attributes:
        name: name in the registry.
        config_type: class of the configuration; made without arguments it holds
            the defaults.
        validate: `(config, num_devices) -> None`; raises ValueError with the
            name and the value of what is wrong.
        steps_per_update: `config -> int`, control steps of one update.
        init: `(key, env, config, env_params, total_steps) -> state`.
        update: `(state, axis_name=None) -> (state, Metrics)`. Under a mapped
            axis of that name the state holds this device's environments.
        partition: `state -> tree prefix of PartitionSpec`: which leaves are
            spread over the devices (axis `DEVICE_AXIS`), which repeated.
        policy: `state -> Policy`, the deterministic policy.
    """

    name: str
    config_type: type
    validate: Callable[[Any, int], None]
    steps_per_update: Callable[[Any], int]
    init: Callable[..., Any]
    update: Callable[..., tuple[Any, Metrics]]
    partition: Callable[[Any], Any]
    policy: Callable[[Any], Policy]

    def checked(self, config: Any) -> Any:
        """A configuration of this algorithm, its defaults for None.

        Raises:
            ValueError: it is of another algorithm.
        """
        config = self.config_type() if config is None else config
        if not isinstance(config, self.config_type):
            raise ValueError(
                f"config must be a {self.config_type.__name__} for {self.name}, "
                f"got {type(config).__name__}"
            )
        return config


_ALGORITHMS = {
    "ddpg": "jaxrod.training.algorithms.ddpg:DDPG",
    "ppo": "jaxrod.training.algorithms.ppo:PPO",
    "sac": "jaxrod.training.algorithms.sac:SAC",
    "td3": "jaxrod.training.algorithms.td3:TD3",
    "trpo": "jaxrod.training.algorithms.trpo:TRPO",
}


def algorithm_names() -> tuple[str, ...]:
    """Returns the names that `find_algorithm` knows, sorted."""
    return tuple(sorted(_ALGORITHMS))


def find_algorithm(name: str) -> Algorithm:
    """Returns the algorithm called `name`.

    Raises:
        ValueError: there is none of this name.
    """
    if name not in _ALGORITHMS:
        known = ", ".join(algorithm_names())
        raise ValueError(f"algorithm must be one of {known}; got {name!r}")
    module, attribute = _ALGORITHMS[name].split(":")
    return getattr(importlib.import_module(module), attribute)
