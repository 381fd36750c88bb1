"""Entry points of training: one recorded run, or one run per seed in one program."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from jaxrod.envs import Environment
from jaxrod.envs.importing import refuse_while_importing
from jaxrod.envs.registry import check_object
from jaxrod.training.algorithm import Algorithm, recorded_name
from jaxrod.training.runs.checkpoint import Checkpoints
from jaxrod.training.runs.contract import resolve, updates_of
from jaxrod.training.runs.event_file import check_installed
from jaxrod.training.runs.folder import RunFolder, differences
from jaxrod.training.runs.hosts import Hosts
from jaxrod.training.runs.owned_folder import CONFIG
from jaxrod.training.runs.recorded_environment import (
    described_environment,
    recorded_environment,
)
from jaxrod.training.runs.recorded_settings import recorded
from jaxrod.training.runs.run import TENSORBOARD, Log, Result, Run
from jaxrod.training.settings import check_steps
from jaxrod.validation import check_count, check_seed


def train(
    env: Environment,
    algorithm: str | Algorithm = "ppo",
    *,
    steps: int,
    seed: int = 0,
    out: str | Path | None = None,
    config: Any = None,
    env_params: Any = None,
    resume: bool = False,
    overwrite: bool = False,
    score_window: int = 50,
    evaluation_episodes: int = 16,
    checkpoint_seconds: float = 60.0,
    chunk_steps: int = 16_384,
    devices: Sequence[jax.Device] | None = None,
    progress: bool = True,
    log: Log | None = None,
) -> Result:
    """Trains a policy.

    Ctrl-C (or a SIGTERM) lets the current chunk of updates finish, saves, and returns
    the result so far; a second one stops immediately. A stopped or killed run in a
    folder continues with `resume=True` from its last checkpoint, no matter when it was
    stopped. On CPUs its results are then equal to the last bit to those of an
    uninterrupted run, on GPUs up to round-off (see `jaxrod doctor`).

    Args:
        env: The environment. If `jaxrod.envs.make` or a class of your own made it, the
            run records how, so that `jaxrod evaluate` and `jaxrod render` can make it
            again. For any other environment these commands need `--task`.
        algorithm: A name, an import path `module:NAME`, or an `Algorithm`.
        steps: Number of control steps, rounded up to whole updates.
        seed: Seed of all random numbers.
        out: Folder of the run, see `jaxrod.training.runs.folder`; None writes
            nothing.
        config: Settings of the algorithm, None for its defaults.
        env_params: Parameters of the environment, None for its defaults.
        resume: Whether to continue the run in `out`.
        overwrite: Whether to replace the run in `out`; other files there are kept.
        score_window: Number of complete training episodes whose mean return is a
            score: the first ones for `first_score`, the last ones for `final_score`.
        evaluation_episodes: Number of episodes of the evaluation at the end, 0 for
            none.
        checkpoint_seconds: Time between checkpoints [s]; there is always one at the
            end.
        chunk_steps: Number of control steps of a chunk, rounded up to whole updates.
            A chunk is one call of the compiled program and one row of progress.
        devices: Devices to spread the environments over. None for all, or for one if
            the algorithm has no `partition`.
        progress: Whether to show a progress bar on stderr.
        log: Function called with every row of the progress table; or "tensorboard",
            which writes them to an event file in `out` (`docs/learning.md`).

    Raises:
        ModuleNotFoundError: A package that `log` needs is not installed.
        ValueError: An argument or a setting is invalid; `out` holds a run and neither
            `resume` nor `overwrite` was set, or it holds files that are not of a run;
            another process trains there; or the run to be resumed is damaged.
        OSError: A file cannot be written; the message has its name.
        FloatingPointError: Learning diverged; the checkpoints are from before.

    Example:
        >>> env = envs.make("trivial")
        >>> config = training.PPOConfig(num_envs=16, rollout_steps=16)
        >>> result = training.train(env, steps=16000, config=config, progress=False)
        >>> result.evaluation.mean > 18.0  # 19.7 at best, 13.3 at rest
        True
    """
    refuse_while_importing("jaxrod.training.train")
    check_object(env)
    steps, seed = check_count("steps", steps, 1, math.inf), check_seed(seed)
    learner, config = resolve(algorithm, config)
    name = algorithm if isinstance(algorithm, str) else recorded_name(learner)
    devices = _devices(learner, devices)
    learner.validate(config, len(devices))
    check_steps(steps, updates_of(learner, config))
    _check_sizes(
        score_window=score_window,
        evaluation_episodes=evaluation_episodes,
        checkpoint_seconds=checkpoint_seconds,
        chunk_steps=chunk_steps,
    )
    settings = {} if out is None else recorded(config)
    requested = request(env, name, settings, steps, seed, score_window)
    if log == TENSORBOARD:
        if out is None:
            raise ValueError("log='tensorboard' needs a folder, got out=None")
        check_installed()
    elif log is not None and not callable(log):
        raise ValueError(f"log must be a function or 'tensorboard', got {log!r:.60}")
    if out is None and resume:
        raise ValueError("resume needs the folder of a run, got out=None")
    folder = None if out is None else RunFolder(out)
    hosts = Hosts(devices)
    with ExitStack() as stack:

        def take(folder: RunFolder) -> bytes:
            if resume and folder.exists and folder.config()["env_options"] is None:
                # The run was recorded without a class that makes its environment.
                requested.update(described_environment(env))
            # Checked first so that a refusal leaves no trace, and again once nobody
            # else can change the folder.
            _check_folder(folder, requested, resume, overwrite)
            stack.enter_context(folder.only_process())
            _check_folder(folder, requested, resume, overwrite)
            return b""

        if folder:
            hosts.from_writer(partial(take, folder))
        return Run(
            env=env,
            learner=learner,
            config=config,
            env_params=env_params,
            requested=requested,
            folder=folder,
            resume=resume,
            checkpoint_seconds=checkpoint_seconds,
            chunk_steps=chunk_steps,
            devices=devices,
            hosts=hosts,
            show=progress,
            log=log,
        ).go(evaluation_episodes)


def _devices(
    learner: Algorithm, devices: Sequence[jax.Device] | None
) -> Sequence[jax.Device]:
    """Devices of a run: the given ones, or all that the learner can use."""
    if devices is None:
        return jax.devices() if learner.partition else jax.devices()[:1]
    if not devices:
        raise ValueError("devices must hold at least one device, got none")
    if len(devices) > 1 and learner.partition is None:
        raise ValueError(
            f"devices must be one for {learner.name}, whose Algorithm has no "
            f"partition, got {len(devices)}"
        )
    return devices


def _check_sizes(
    *,
    score_window: int,
    evaluation_episodes: int,
    checkpoint_seconds: float,
    chunk_steps: int,
) -> None:
    if score_window < 1:
        raise ValueError(f"score_window must be at least 1, got {score_window}")
    if evaluation_episodes < 0:
        raise ValueError(
            f"evaluation_episodes must not be negative, got {evaluation_episodes}"
        )
    if not checkpoint_seconds >= 0:
        raise ValueError(
            f"checkpoint_seconds must not be negative, got {checkpoint_seconds} s"
        )
    if chunk_steps < 1:
        raise ValueError(f"chunk_steps must be at least 1, got {chunk_steps}")


def request(
    env: Environment,
    algorithm: str,
    settings: dict[str, Any],
    steps: int,
    seed: int,
    score_window: int,
) -> dict[str, Any]:
    """Contents of `config.json`: task, options, algorithm, steps, seed, settings."""
    return {
        **recorded_environment(env),
        "algorithm": algorithm,
        "steps": steps,
        "seed": seed,
        "score_window": score_window,
        "settings": settings,
    }


def _check_folder(
    folder: RunFolder, requested: dict[str, Any], resume: bool, overwrite: bool
) -> None:
    """Raises ValueError unless the requested run can begin or resume in a folder."""
    name = str(folder.path)
    if not resume:
        folder.check_replaceable()
        if folder.exists and not overwrite:
            raise ValueError(
                f"out must not hold a run already, got {name!r}; "
                "pass resume=True to continue it or overwrite=True to replace it"
            )
        return
    changed = differences(folder.config(), requested)
    if changed:
        raise ValueError(
            f"resume needs the arguments of the run, as in {CONFIG} of {name!r}; "
            f"{', '.join(changed)}"
        )
    # Replacing unknown files could lose them.
    folder.check_replaceable()
    result = folder.summary_file.exists()
    if result:
        others = [
            name
            for name, was in folder.summary().items()
            if name in requested and was != requested[name]
        ]
        if others:
            raise ValueError(
                f"{folder.summary_file} belongs to another run than {CONFIG}: they "
                f"differ in {', '.join(others)}"
            )
    begun = result or (folder.policy / "policy.json").exists()
    if begun and not Checkpoints(folder.checkpoints).steps():
        # Starting over in this folder would lose the results so far.
        raise ValueError(
            f"out must hold a checkpoint to resume from, but the run in "
            f"{name!r} is {'finished' if folder.finished else 'under way'} and its "
            "checkpoints are gone; pass overwrite=True to train again"
        )


def train_seeds(
    env: Environment,
    algorithm: str | Algorithm = "ppo",
    *,
    steps: int,
    seeds: Sequence[int] = (0, 1, 2),
    config: Any = None,
    env_params: Any = None,
) -> tuple[Any, dict[str, Array]]:
    """Trains one run per seed, all in one compiled program, without any files.

    Suitable for small tasks and studies; for a long run use `jaxrod.training.train`.
    Under vectorisation both branches of a condition are computed, so restarts add a
    small cost to every step.

    Args:
        env: The environment.
        algorithm: A name, an import path `module:NAME`, or an `Algorithm`.
        steps: Number of control steps of each run, rounded up to whole updates.
        seeds: The seeds.
        config: Settings of the algorithm, None for its defaults.
        env_params: Parameters of the environment, None for its defaults.

    Returns:
        The train states, with a leading axis of seeds, and metrics of shape (seeds,
        updates): those of the algorithm, `episodes` (number of complete episodes that
        ended in the update) and `episode_return_mean` (mean over these; NaN if there
        are none).

    Raises:
        ValueError: An argument or a setting is invalid.

    Example:
        >>> env = envs.make("trivial")
        >>> config = training.PPOConfig(num_envs=4, rollout_steps=8)
        >>> states, metrics = training.train_seeds(env, steps=128, config=config)
        >>> metrics["episode_return_mean"].shape  # seeds, updates
        (3, 4)
    """
    check_object(env)
    learner, config = resolve(algorithm, config)
    learner.validate(config, 1)
    steps = check_count("steps", steps, 1)
    if not isinstance(seeds, Sequence):
        raise ValueError(f"seeds must be a sequence of integers, got {seeds!r}")
    if not seeds:
        raise ValueError("seeds must hold at least one seed, got none")
    seeds = [check_seed(seed, "seeds") for seed in seeds]
    per_update = updates_of(learner, config)
    updates = check_steps(steps, per_update)
    params = env.default_params() if env_params is None else env_params

    def update(state: Any, _: None) -> tuple[Any, dict[str, Array]]:
        state, metrics = learner.update(state)
        episodes = metrics.episodes
        count: Int[Array, ""] = jnp.sum(episodes.finished)
        earned = jnp.sum(jnp.where(episodes.finished, episodes.episode_return, 0))
        mean = jnp.where(count > 0, earned / jnp.maximum(count, 1), jnp.nan)
        return state, {
            **metrics.scalars,
            "episodes": count,
            "episode_return_mean": mean,
        }

    def run(key: Key[Array, ""]) -> tuple[Any, dict[str, Array]]:
        state = learner.init(key, env, config, params, updates * per_update)
        return jax.lax.scan(update, state, length=updates)

    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
    return jax.jit(jax.vmap(run))(keys)
