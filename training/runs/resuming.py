"""Resuming a run from its newest readable checkpoint, and reading its policy.

The tables of a resumed run are cut back to the rows that the checkpoint counts.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.envs import Environment
from jaxrod.envs.registry import check_object
from jaxrod.files import (
    OBJECT,
    POSITIVE,
    DamagedFileError,
    check_entries,
    reading,
    whole,
)
from jaxrod.structure import pytree
from jaxrod.training.algorithm import Algorithm
from jaxrod.training.leaves import is_key
from jaxrod.training.policy import load_policy, needs_structure
from jaxrod.training.runs.checkpoint import Checkpoints
from jaxrod.training.runs.contract import resolve, updates_of
from jaxrod.training.runs.folder import (
    LEARNING_CURVE,
    REPLAY,
    RunFolder,
    differences,
    renamed,
)
from jaxrod.training.runs.owned_folder import CONFIG
from jaxrod.training.runs.recorded_settings import plain, restored
from jaxrod.training.runs.table import check_mark
from jaxrod.validation import check_seed, warn

_FACTS = {
    "config": OBJECT,
    "updates": whole(1),
    "wall_s": POSITIVE,
    "progress": OBJECT,
    "episodes": OBJECT,
}
"""Names and kinds of the facts that a checkpoint holds beside the train state."""


@pytree
class Stored:
    """Arrays in a checkpoint: train state and parameters of the environment."""

    learner: Any
    """The train state of the algorithm."""
    env_params: Any
    """Parameters of the environment, with which a resumed run must agree."""


class DamagedCheckpointWarning(UserWarning):
    """The newest checkpoint cannot be read; the run continues from the one before."""


def facts_of(
    folder: RunFolder, requested: dict[str, Any], updates: int, wall_s: float
) -> dict[str, Any]:
    """Facts of a checkpoint; waits until the rows of the tables are on the disk.

    Args:
        folder: Folder of the run.
        requested: Contents of `config.json`.
        updates: Number of updates so far.
        wall_s: Time of the run so far [s].
    """
    return {
        "config": requested,
        "updates": updates,
        "wall_s": wall_s,
        "progress": folder.progress.mark(),
        "episodes": folder.episodes.mark(),
    }


def stored(state: Any, env_params: Any) -> Stored:
    """Contents of a checkpoint: a train state and parameters of the environment."""
    return Stored(state, jax.tree.map(jnp.asarray, env_params))


def restore(
    folder: RunFolder,
    checkpoints: Checkpoints,
    requested: dict[str, Any],
    template: Stored,
) -> tuple[Stored, dict[str, Any]] | None:
    """Restores the newest readable checkpoint and cuts the tables back to it.

    Args:
        folder: Folder of the run.
        checkpoints: Checkpoints of the run.
        requested: Contents of `config.json`.
        template: Contents of a checkpoint, of the same structure and shapes.

    Returns:
        The contents and the facts; None if there is no checkpoint, because a run that
        was killed before its first checkpoint starts over.

    Raises:
        ValueError: No checkpoint can be read, the newest belongs to another run, or a
            table has lost rows that the checkpoint counts. No file is changed then.

    Warns:
        DamagedCheckpointWarning: The newest checkpoint cannot be read, but an older one
            can.
    """
    found, damaged = None, []
    for step in checkpoints.steps():
        file = checkpoints.path(step)
        check = partial(_check_facts, file, step, requested)
        try:
            found = checkpoints.restore(template, step, check)
            break
        except DamagedFileError as error:
            damaged.append(str(error))
    if damaged and not found:
        raise ValueError(f"no checkpoint can be used: {'; '.join(damaged)}")
    if found:
        _check_same_task(found[0].env_params, template.env_params)
    # All checks come before any change.
    marks = found[1] if found else {"progress": None, "episodes": None}
    tables = {"progress": folder.progress, "episodes": folder.episodes}
    for name, table in tables.items():
        table.check(marks[name])
    for name, table in tables.items():
        table.cut(marks[name])
    # Files that were being written when the run was killed.
    folder.remove_temporary(but=(LEARNING_CURVE, REPLAY))
    if damaged:
        warn(
            f"{'; '.join(damaged)}. Continuing from {file.name}, the previous one",
            DamagedCheckpointWarning,
        )
    return found


def _check_facts(
    file: Path, step: int, requested: dict[str, Any], facts: dict[str, Any]
) -> None:
    """Raises ValueError unless the facts of a checkpoint are valid and of this run.

    Args:
        file: File of the checkpoint, for messages.
        step: Number of the checkpoint.
        requested: Contents of `config.json`.
        facts: Facts that the checkpoint holds.
    """
    with reading(file):
        check_entries(facts, _FACTS)
        if facts["updates"] != step:
            raise ValueError(f"it is of update {facts['updates']}")
        for name in ("progress", "episodes"):
            check_mark(facts[name])
    changed = differences(renamed(facts["config"]), plain(requested))
    if changed:
        raise ValueError(
            f"{file} belongs to a run with another {CONFIG}: {', '.join(changed)}"
        )


def _check_same_task(stored: Any, given: Any) -> None:
    """Raises ValueError unless two sets of environment parameters agree to 1e-6."""
    for (path, was), now in zip(
        jax.tree.leaves_with_path(stored), jax.tree.leaves(given), strict=True
    ):
        if is_key(now):
            was, now = jax.random.key_data(was), jax.random.key_data(now)
        # Another machine may have computed a different last digit.
        if not np.allclose(was, now, rtol=1e-6, atol=0, equal_nan=True):
            raise ValueError(
                "resume needs the env_params of the run, but "
                f"{jax.tree_util.keystr(path)} differs"
            )


def restore_policy(
    run: str | Path,
    env: Environment,
    *,
    env_params: Any = None,
    trust: Collection[str] = (),
) -> Any:
    """Reads the policy of a run: a `Policy`, or a `jaxrod.envs.MemoryPolicy`.

    Args:
        run: Folder of the run.
        env: The environment that the policy was trained on.
        env_params: Parameters of the environment, None for its defaults.
        trust: Modules that may be imported because the run names them, such as
            `("my_learners",)`: those of an algorithm or a network of your own. The
            policies of built-in algorithms and networks need none.

    Raises:
        ValueError: There is no run, it has no policy yet, or a file is damaged; the
            message names the file.
        UntrustedError: The run names an algorithm or a network that is not trusted.
        ImportError: The algorithm or the network of the run is not found.

    Example:
        >>> env = envs.make("trivial")
        >>> config = training.PPOConfig(num_envs=4, rollout_steps=8)
        >>> result = training.train(
        ...     env, steps=64, config=config, out="runs/first", progress=False
        ... )
        >>> policy = training.restore_policy("runs/first", env)
        >>> bool((policy(jnp.ones(1)) == result.policy(jnp.ones(1))).all())
        True
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
    seed: int | None = None,
) -> Any:
    """Policy with which training begins, or only its shapes.

    Args:
        env: The environment.
        algorithm: A name, an import path or an `Algorithm`.
        config: Settings of the algorithm, None for its defaults.
        env_params: Parameters of the environment, None for its defaults.
        seed: Seed of the initial numbers, as for `train`. None computes no numbers: the
            policy then has shapes and dtypes (`jax.ShapeDtypeStruct`) in their place,
            cannot be called, and serves `load_policy` as `like`.

    Returns:
        The policy.

    Raises:
        ValueError: There is no such algorithm, or a setting or the seed is invalid.

    Example:
        >>> env = envs.make("trivial")
        >>> policy = training.untrained_policy(env, seed=0)
        >>> training.evaluate(env, policy).mean < 16.0  # at best 19.7
        True
        >>> training.untrained_policy(env).layers[0][0].shape  # without numbers
        (1, 64)
    """
    check_object(env)
    algorithm, config = resolve(algorithm, config)
    algorithm.validate(config, 1)
    params = env.default_params() if env_params is None else env_params
    steps = updates_of(algorithm, config)

    def make(key: jax.Array) -> Any:
        return algorithm.policy(algorithm.init(key, env, config, params, steps))

    if seed is None:
        return jax.eval_shape(make, jax.random.key(0))
    return jax.jit(make)(jax.random.key(check_seed(seed)))
