"""The record of functions that the shared loop trains with, and where it is found."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.envs import EpisodeRecord
from jaxrod.structure import pytree
from jaxrod.training.import_path import find_object, import_path_in
from jaxrod.training.policy import Policy

DEVICE_AXIS = "env"
"""Name of the device axis over which the environments of a run are spread."""


@pytree
class Metrics:
    """Report of one update.

    Attributes:
        scalars: Named numbers, the same on every device.
        episodes: The complete episodes that ended, shape (steps, num_envs), in
            the order of time.
    """

    scalars: dict[str, Array]
    episodes: EpisodeRecord


def steps_per_update(config: Any) -> int:
    """Control steps of one update: num_envs * rollout_steps * action_repeat.

    For configurations that have these three, as every `LearnerConfig` does.
    """
    return config.num_envs * config.rollout_steps * config.action_repeat


def mean_over_devices(tree: Any, axis_name: str | None) -> Any:
    """The mean of every leaf over the devices of a mapped axis, if there is one.

    The leaves of one type are exchanged as one array: on a network the number of
    exchanges costs more than what is in them.
    """
    if axis_name is None:
        return tree
    leaves, structure = jax.tree.flatten(tree)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    for dtype in sorted({leaf.dtype for leaf in leaves}, key=str):
        alike = [i for i, leaf in enumerate(leaves) if leaf.dtype == dtype]
        mean = jax.lax.pmean(
            jnp.concatenate([leaves[i].ravel() for i in alike]), axis_name
        )
        ends = np.cumsum([leaves[i].size for i in alike])
        for i, part in zip(alike, jnp.split(mean, ends[:-1]), strict=True):
            leaves[i] = part.reshape(leaves[i].shape)
    return jax.tree.unflatten(structure, leaves)


def check_nothing(config: Any, num_devices: int) -> None:
    """Finds no fault with any configuration."""


@dataclass(frozen=True)
class Algorithm:
    """A learner as a record of pure functions.

    This is all that training, resuming and evaluating know of it. Its train state is
    one pytree of arrays that holds all there is: numbers of the configuration,
    weights, optimiser, environments, keys. What is not a number (the environment, say)
    is structure, see `jaxrod.static`. Two states made by `init` from configurations
    that differ only in numbers share one program. `train` checks all of this in words
    before it compiles anything.

    To be found again by `--resume` and `jaxrod evaluate` it has to be a variable of a
    module that can be imported: it is recorded as `module:NAME`.
    """

    name: str
    """Name for people, and in the registry."""
    config_type: type
    """Class of the configuration: a `jaxrod.pytree` that made without arguments holds
    the defaults. Fields that are not static are numbers. `config.json` has to hold
    all, as numbers, text, truth values, tuples of such, or functions of a module."""
    steps_per_update: Callable[[Any], int]
    """`config -> int`: control steps of one update, of all environments together."""
    init: Callable[..., Any]
    """`(key, env, config, env_params, total_steps) -> state`: the train state before
    the first update. All randomness comes from the key; `total_steps` is the length
    of the whole run, for schedules. Pure: it is compiled, and vectorised over keys."""
    update: Callable[..., tuple[Any, Metrics]]
    """`state -> (state, Metrics)`: one update; the state keeps its structure, shapes
    and types. With `partition`: `(state, axis_name=None) -> (state, Metrics)`. Under a
    mapped axis of that name the state holds this device's share, and what is repeated
    must stay equal on all of them, see `mean_over_devices`."""
    policy: Callable[[Any], Policy]
    """`state -> policy`: the deterministic policy, a pytree of arrays that is called
    `policy(observation) -> action` with any leading axes."""
    validate: Callable[[Any, int], None] = check_nothing
    """`(config, num_devices) -> None`: raises ValueError with the name and the value
    of what is wrong. By default every configuration will do."""
    partition: Callable[[Any], Any] | None = None
    """`state -> tree prefix of PartitionSpec`: which leaves are spread over the devices
    (axis `DEVICE_AXIS`), which repeated. None, the default: runs on one device."""

    def checked(self, config: Any) -> Any:
        """A configuration of this algorithm, its defaults for None.

        Raises:
            ValueError: It is of another algorithm.
        """
        config = self.config_type() if config is None else config
        if not isinstance(config, self.config_type):
            raise ValueError(
                f"config must be a {self.config_type.__name__} for {self.name}, "
                f"got {type(config).__name__}"
            )
        return config


_ALGORITHMS = {
    "dagger": "jaxrod.training.algorithms.dagger:DAGGER",
    "ddpg": "jaxrod.training.algorithms.ddpg:DDPG",
    "ppo": "jaxrod.training.algorithms.ppo:PPO",
    "sac": "jaxrod.training.algorithms.sac:SAC",
    "shac": "jaxrod.training.algorithms.shac:SHAC",
    "td3": "jaxrod.training.algorithms.td3:TD3",
    "trpo": "jaxrod.training.algorithms.trpo:TRPO",
}


def algorithm_names() -> tuple[str, ...]:
    """Returns the names that `find_algorithm` knows, sorted."""
    return tuple(sorted(_ALGORITHMS))


def find_algorithm(name: str, trust: Collection[str] | None = None) -> Algorithm:
    """Returns the algorithm called `name`.

    Args:
        name: One of `algorithm_names()`, or the import path of your own,
            `module:NAME`.
        trust: For a name that a file holds, the modules that may be imported because
            of it, see `jaxrod.envs.importing.check_trusted`; None for what the user
            names.

    Raises:
        ValueError: There is none of this name, or what is there is no algorithm.
        UntrustedError: A file names it, and it is not trusted.
        ImportError: An import path leads nowhere.
    """
    if name not in _ALGORITHMS and ":" not in name:
        known = ", ".join(algorithm_names())
        raise ValueError(
            f"algorithm must be one of {known}, or module:NAME; got {name!r}"
        )
    built_in = _ALGORITHMS.get(name)
    found = find_object(built_in) if built_in else find_object(name, trust)
    if not isinstance(found, Algorithm):
        raise ValueError(
            f"algorithm {name!r} must be a jaxrod.training.Algorithm, it is "
            f"a {type(found).__name__}"
        )
    return found


def recorded_name(algorithm: Algorithm) -> str:
    """Name that `find_algorithm` finds an algorithm by, where there is one.

    An algorithm that no module holds has its own name for it, which finds nothing.
    """
    if algorithm.name in _ALGORITHMS:
        return algorithm.name
    likely = getattr(algorithm.update, "__module__", "")
    paths = (import_path_in(name, algorithm) for name in (likely, *sys.modules))
    return next(filter(None, paths), algorithm.name)
