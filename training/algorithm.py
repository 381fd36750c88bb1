"""Learning algorithms as records of functions, and the registry of their names."""

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
from jaxrod.envs.importing import find_object, import_path_in
from jaxrod.spelling import nearest
from jaxrod.structure import pytree

DEVICE_AXIS = "env"
"""Name of the device axis over which the environments of a run are spread."""


@pytree
class Metrics:
    """Metrics of one update.

    Attributes:
        scalars: Scalar metrics by name, equal on every device.
        episodes: Results of the episodes, arrays of shape (steps, num_envs) in
            chronological order, valid where `finished` is true.

    Example:
        >>> none = envs.EpisodeRecord(*jnp.zeros((4, 8, 16)))  # 8 steps of 16
        >>> metrics = training.Metrics({"loss": jnp.array(0.25)}, none)
        >>> float(metrics.scalars["loss"]), metrics.episodes.length.shape
        (0.25, (8, 16))
    """

    scalars: dict[str, Array]
    episodes: EpisodeRecord


def steps_per_update(config: Any) -> int:
    """Control steps of one update: num_envs * rollout_steps * action_repeat.

    Args:
        config: Configuration with these three fields, such as a `LearnerConfig`.

    Example:
        >>> config = training.PPOConfig(num_envs=64, rollout_steps=32, action_repeat=4)
        >>> training.steps_per_update(config)
        8192
    """
    return config.num_envs * config.rollout_steps * config.action_repeat


def mean_over_devices(tree: Any, axis_name: str | None) -> Any:
    """Averages every leaf over the devices of a mapped axis, if there is one.

    Leaves of one dtype are exchanged as one array, because on a network the number of
    messages costs more than their size.

    Args:
        tree: Any pytree of floats, such as gradients.
        axis_name: Name of the mapped axis; `None` returns `tree` unchanged.

    Example:
        >>> mean = jax.vmap(
        ...     lambda slope: training.mean_over_devices(slope, "env"), axis_name="env"
        ... )
        >>> mean(jnp.array([1.0, 3.0])).tolist()
        [2.0, 2.0]
        >>> training.mean_over_devices(3.0, None)  # no devices to share with
        3.0
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
    """Accepts every configuration; the default of `Algorithm.validate`."""


@dataclass(frozen=True)
class Algorithm:
    """A learner as a record of pure functions.

    Training, resuming and evaluating use only these functions. The train state of a
    learner is one pytree of arrays with everything that a run needs: numbers of the
    configuration, weights, optimiser, environments, keys. Anything that is not a number
    (the environment, say) is static structure, see `jaxrod.extend.static`. Two states
    made by `init` from configurations that differ only in numbers share one compiled
    program. `train` checks all of this before it compiles anything.

    A run records the algorithm as `module:NAME`. So it must be a variable of a module
    that can be imported, or `--resume` and `jaxrod evaluate` cannot find it.

    Example:
        >>> learner = training.find_algorithm("ppo")
        >>> learner is training.PPO, learner.config_type.__name__
        (True, 'PPOConfig')
        >>> learner.steps_per_update(learner.config_type(num_envs=64, rollout_steps=32))
        2048
    """

    name: str
    """Name for display; `find_algorithm` finds a built-in algorithm by it."""
    config_type: type
    """Class of the configuration: a `jaxrod.extend.pytree` whose instance without
    arguments holds the defaults. Fields that are not static are numbers. `config.json`
    must be able to hold every field, as numbers, text, booleans, tuples of these, or
    functions of a module."""
    steps_per_update: Callable[[Any], int]
    """`config -> int`: number of control steps of one update, summed over all
    environments."""
    init: Callable[..., Any]
    """`(key, env, config, env_params, total_steps) -> state`: the train state before
    the first update. All randomness comes from the key; `total_steps` is the length of
    the whole run, for schedules. Pure: it is compiled, and vectorised over keys."""
    update: Callable[..., tuple[Any, Metrics]]
    """`state -> (state, Metrics)`: one update; the state keeps its structure, shapes
    and types. With `partition` it is `(state, axis_name=None) -> (state, Metrics)`.
    Under a mapped axis of that name the state holds this device's part of the split
    leaves. Replicated leaves must stay equal on all devices, see
    `mean_over_devices`."""
    policy: Callable[[Any], Any]
    """`state -> policy`: the deterministic policy, a pytree of arrays. It is called as
    `policy(observation) -> action` with any leading axes, or it is a
    `jaxrod.envs.MemoryPolicy` that does not look at the states."""
    validate: Callable[[Any, int], None] = check_nothing
    """`(config, num_devices) -> None`: raises ValueError with the name and the value of
    the wrong setting. The default accepts every configuration."""
    partition: Callable[[Any], Any] | None = None
    """`state -> tree prefix of PartitionSpec`: which leaves are split over the devices
    (axis `DEVICE_AXIS`) and which are replicated. None, the default, limits the
    algorithm to one device."""

    def checked(self, config: Any) -> Any:
        """Validates the type of `config` and returns it; for `None`, the defaults.

        Raises:
            ValueError: The configuration belongs to another algorithm.

        Example:
            >>> learner = training.find_algorithm("ppo")
            >>> learner.checked(None).num_envs
            128
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
    "ddpg": "jaxrod.training.algorithms.td3:DDPG",
    "ppo": "jaxrod.training.algorithms.ppo:PPO",
    "sac": "jaxrod.training.algorithms.sac:SAC",
    "shac": "jaxrod.training.algorithms.shac:SHAC",
    "td3": "jaxrod.training.algorithms.td3:TD3",
    "trpo": "jaxrod.training.algorithms.trpo:TRPO",
}


def algorithm_names() -> tuple[str, ...]:
    """Returns the names of all built-in algorithms, sorted.

    Example:
        >>> training.algorithm_names()
        ('dagger', 'ddpg', 'ppo', 'sac', 'shac', 'td3', 'trpo')
    """
    return tuple(sorted(_ALGORITHMS))


def find_algorithm(name: str, trust: Collection[str] | None = None) -> Algorithm:
    """Returns the algorithm called `name`.

    Args:
        name: One of `algorithm_names()`, or the import path of your own algorithm,
            `module:NAME`.
        trust: Modules that may be imported, for a name that was read from a file; see
            `jaxrod.envs.importing.check_trusted`. None, for a name that the user typed,
            allows all modules.

    Raises:
        ValueError: There is no algorithm of this name, or the object found is not an
            `Algorithm`.
        UntrustedError: The name was read from a file and its module is not trusted.
        ImportError: Nothing is found at the import path.

    Example:
        >>> training.find_algorithm("sac") is training.SAC
        True
    """
    if name not in _ALGORITHMS and ":" not in name:
        known = ", ".join(algorithm_names())
        listed = f"algorithm must be one of {known}, or module:NAME; got {name!r}"
        meant = nearest(name, _ALGORITHMS)
        raise ValueError(
            f"there is no algorithm {name!r}: did you mean {meant!r}?"
            if meant
            else listed
        )
    built_in = _ALGORITHMS.get(name)
    found = find_object(built_in) if built_in else find_object(name, trust)
    if not isinstance(found, Algorithm):
        raise ValueError(
            f"algorithm {name!r} must be a jaxrod.training.Algorithm, got "
            f"a {type(found).__name__}"
        )
    return found


def recorded_name(algorithm: Algorithm) -> str:
    """Name of an algorithm for `config.json`, by which `find_algorithm` finds it.

    It is the name of a built-in algorithm, or an import path. For an algorithm that is
    not a variable of a module it is `algorithm.name`, which `find_algorithm` does not
    find.
    """
    if algorithm.name in _ALGORITHMS:
        return algorithm.name
    likely = getattr(algorithm.update, "__module__", "")
    paths = (import_path_in(name, algorithm) for name in (likely, *sys.modules))
    return next(filter(None, paths), algorithm.name)
