"""The policy of a run, for any algorithm and network."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import jax

from jaxrod.envs import Environment
from jaxrod.files import reading
from jaxrod.training.algorithm import Algorithm
from jaxrod.training.policy import Policy
from jaxrod.training.policy_files import load_policy, needs_structure
from jaxrod.training.runs.contract import resolve, updates_of
from jaxrod.training.runs.folder import RunFolder
from jaxrod.training.runs.owned_folder import CONFIG
from jaxrod.training.runs.recorded_settings import restored


def restore_policy(
    run: str | Path,
    env: Environment,
    *,
    env_params: Any = None,
    trust: Collection[str] = (),
) -> Policy:
    """Reads the policy of a run.

    Args:
        run: Folder of the run.
        env: The environment it was trained on.
        env_params: Parameters of the environment, None for its defaults.
        trust: Modules that may be imported because the run names them, such as
            `("my_learners",)`: those of an algorithm or a network of your own. The
            policies of built-in algorithms and networks need none.

    Raises:
        ValueError: There is no run, it has no policy yet, or a file is damaged; the
            message names it.
        UntrustedError: The run names an algorithm or a network that is not trusted.
        ImportError: The algorithm or the network of the run is not found.
    """
    folder = RunFolder(run)
    stored = folder.config()
    if not needs_structure(folder.policy):
        return load_policy(folder.policy)
    with reading(folder.path / CONFIG):
        algorithm, config = resolve(stored["algorithm"], None, trust)
        config = restored(config, stored["settings"], trust)
    like = untrained_policy(env, algorithm, config, env_params=env_params)
    return load_policy(folder.policy, like)


def untrained_policy(
    env: Environment,
    algorithm: str | Algorithm = "ppo",
    config: Any = None,
    *,
    env_params: Any = None,
) -> Any:
    """Structure of the policy that training would make, without computing anything.

    Args:
        env: The environment.
        algorithm: A name, an import path or an `Algorithm`.
        config: Settings of the algorithm, None for its defaults.
        env_params: Parameters of the environment, None for its defaults.

    Returns:
        The policy, with shapes and dtypes (`jax.ShapeDtypeStruct`) in place of numbers.
    """
    algorithm, config = resolve(algorithm, config)
    algorithm.validate(config, 1)
    params = env.default_params() if env_params is None else env_params
    steps = updates_of(algorithm, config)

    def make(key: jax.Array) -> Any:
        return algorithm.policy(algorithm.init(key, env, config, params, steps))

    return jax.eval_shape(make, jax.random.key(0))
