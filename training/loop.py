"""The host loop: chunks of compiled updates, and between them the world.

A run is `steps` control steps, rounded up to whole updates. After every chunk
the loop logs, shows progress, and now and then saves; it never looks inside an
algorithm, see `jaxrod.training.algorithm`.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxrod.envs import Environment
from jaxrod.training.algorithm import Algorithm, Metrics, find_algorithm
from jaxrod.training.checkpoint import Checkpoints
from jaxrod.training.devices import compile_updates, device_mesh, place
from jaxrod.training.evaluation import Evaluation, evaluate
from jaxrod.training.interruption import Interruption
from jaxrod.training.policy import Policy, save_policy
from jaxrod.training.progress import ProgressBar
from jaxrod.training.run_folder import RunFolder, differences
from jaxrod.training.score import EpisodeLog

CHUNK_STEPS = 16_384
"""A chunk is at least this many control steps, and at least one update."""


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run leaves.

    Attributes:
        summary: as in `summary.json`.
        policy: the deterministic policy.
        progress: one row per chunk of this call, as in `progress.csv`.
        episodes: every complete training episode of the run.
        evaluation: of `policy`; None if interrupted or not asked for.
        state: the final train state.
        folder: the run's folder, None if nothing was written.
    """

    summary: dict[str, Any]
    policy: Policy
    progress: list[dict[str, Any]]
    episodes: EpisodeLog
    evaluation: Evaluation | None
    state: Any
    folder: RunFolder | None


def train(
    env: Environment,
    algorithm: str | Algorithm = "ppo",
    *,
    steps: int,
    seed: int = 0,
    out: str | Path | None = None,
    config: Any = None,
    env_params: Any = None,
    env_options: Mapping[str, Any] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    score_window: int = 50,
    evaluation_episodes: int = 16,
    checkpoint_seconds: float = 60.0,
    devices: Sequence[jax.Device] | None = None,
    progress: bool = True,
    log: Callable[[dict[str, Any]], None] | None = None,
) -> Result:
    """Trains a policy.

    Ctrl-C (or a SIGTERM) lets the running chunk finish, saves and returns what
    there is; a second one stops at once. A run in a folder that was stopped or
    killed, whenever that was, continues with `resume=True` from its last
    checkpoint and ends bit by bit as if nothing had happened.

    Args:
        env: the environment.
        algorithm: a name, or an `Algorithm`.
        steps: control steps, rounded up to whole updates.
        seed: the seed of all randomness.
        out: folder of the run, see `jaxrod.training.run_folder`; None writes
            nothing.
        config: settings of the algorithm, None for its defaults.
        env_params: parameters of the environment, None for its own.
        env_options: how the environment was made, `make(env.name,
            **env_options)`; recorded. "variant" among them is repeated in the
            summary.
        resume: continue the run in `out`.
        overwrite: replace the run in `out`.
        score_window: `final_score` is the mean return of this many last
            complete training episodes.
        evaluation_episodes: episodes of the evaluation at the end, 0 for none.
        checkpoint_seconds: time between checkpoints [s]; there is one at the end
            in any case.
        devices: devices to spread the environments over, None for all.
        progress: show a progress bar on stderr.
        log: called with every row of the progress table.

    Raises:
        ValueError: an argument or a setting makes no sense, or `out` holds a run
            that was not asked to be resumed or overwritten.
    """
    learner = find_algorithm(algorithm) if isinstance(algorithm, str) else algorithm
    config = learner.config_type() if config is None else config
    devices = jax.devices() if devices is None else devices
    _check(learner, config, devices, steps, score_window, evaluation_episodes)
    asked = _describe(env, learner, config, steps, seed, env_options, score_window)
    folder = _open_folder(out, asked, resume, overwrite)
    return _Run(
        env=env,
        learner=learner,
        config=config,
        env_params=env_params,
        asked=asked,
        folder=folder,
        resume=resume,
        checkpoint_seconds=checkpoint_seconds,
        devices=devices,
        show=progress,
        log=log,
    ).go(evaluation_episodes)


class _Run:
    """One call of `train`: the state of the host while it lasts."""

    def __init__(
        self,
        *,
        env: Environment,
        learner: Algorithm,
        config: Any,
        env_params: Any,
        asked: dict[str, Any],
        folder: RunFolder | None,
        resume: bool,
        checkpoint_seconds: float,
        devices: Sequence[jax.Device],
        show: bool,
        log: Callable[[dict[str, Any]], None] | None,
    ) -> None:
        self.began = time.monotonic()
        self.env, self.learner, self.env_params = env, learner, env_params
        self.asked, self.folder, self.devices = asked, folder, devices
        self.checkpoint_seconds, self.show, self.log = checkpoint_seconds, show, log
        self.per_update = learner.steps_per_update(config)
        self.total = math.ceil(asked["steps"] / self.per_update)
        self.done = 0
        self.wall_before = 0.0
        self.rows: list[dict[str, Any]] = []
        self.rows_before = 0
        self.episodes = EpisodeLog()
        self.checkpoints = Checkpoints(folder.checkpoints) if folder else None

        # The mesh first: it fails at once where the devices do not fit.
        self.mesh = device_mesh(devices)
        start = jax.jit(learner.init, static_argnums=(1, 4))
        key = jax.random.key(asked["seed"])
        state = start(key, env, config, env_params, self.total * self.per_update)
        if resume and self.checkpoints and self.checkpoints.latest_step() is not None:
            state = self._restore(state)
        elif folder:
            # Killed before the first checkpoint: start over.
            folder.progress.cut(0)
            folder.episodes.cut(0)
        self.state = place(state, learner.partition(state), self.mesh)

    @property
    def env_steps(self) -> int:
        return self.done * self.per_update

    @property
    def wall(self) -> float:
        return self.wall_before + time.monotonic() - self.began

    def go(self, evaluation_episodes: int) -> Result:
        """Runs to the end, or to an interruption, and writes the result."""
        bar = ProgressBar(self.total * self.per_update, self.env_steps, self.show)
        capacity = max(1, min(self.total, math.ceil(CHUNK_STEPS / self.per_update)))
        bar.message(f"compiling {self.learner.name} for {self.env.name}")
        compile_began = time.monotonic()
        update = compile_updates(self.learner, self.state, capacity, self.mesh)
        compile_s = time.monotonic() - compile_began
        bar = ProgressBar(self.total * self.per_update, self.env_steps, self.show)

        looped = saved = time.monotonic()
        steps_before = self.env_steps
        with Interruption(bar.message) as interruption:
            while self.done < self.total and not interruption.asked:
                count = min(capacity, self.total - self.done)
                self.state, metrics = update(self.state, count)
                self._record(jax.device_get(metrics), count, bar)
                if time.monotonic() - saved > self.checkpoint_seconds:
                    self._save()
                    saved = time.monotonic()
            self._save()
        looped = time.monotonic() - looped
        bar.close()
        finished = self.done == self.total

        policy = jax.device_get(self.learner.policy(self.state))
        summary = self._summary() | {
            "status": "finished" if finished else "interrupted",
            "compile_s": compile_s,
            "loop_steps_per_s": (self.env_steps - steps_before) / looped,
        }
        evaluation = None
        if finished and evaluation_episodes:
            evaluation = self._evaluate(policy, evaluation_episodes)
            summary |= evaluation[1]
        if self.folder:
            about = {
                name: self.asked[name] for name in ("case", "variant", "algorithm")
            }
            save_policy(policy, self.folder.policy, about)
            self.folder.write_summary(summary)
            if not finished:
                bar.message(
                    f"stopped after {self.env_steps:,} steps; "
                    f"resume=True continues in {self.folder.path}"
                )
        if self.checkpoints:
            self.checkpoints.close()
        return Result(
            summary=summary,
            policy=policy,
            progress=self.rows,
            episodes=self.episodes,
            evaluation=evaluation[0] if evaluation else None,
            state=self.state,
            folder=self.folder,
        )

    def _record(self, metrics: Metrics, count: int, bar: ProgressBar) -> None:
        """Takes in a chunk: one row of progress, the episodes that ended."""
        before = self.wall
        self.done += count
        new = self.episodes.take(metrics.episodes, count, self.env_steps)
        recent = self.episodes.recent(self.asked["score_window"])
        row = {
            "env_steps": self.env_steps,
            "wall_s": round(before, 3),
            "steps_per_s": round(self.env_steps / before, 1),
            "episodes": len(self.episodes),
            "episode_return_mean": recent,
            "flagged_fraction": self.episodes.flagged_fraction,
        }
        row |= {
            name: float(np.mean(values[:count]))
            for name, values in sorted(metrics.scalars.items())
        }
        self.rows.append(row)
        if self.folder:
            self.folder.progress.append([row])
            self.folder.episodes.append(new)
        if self.log:
            self.log(row)
        bar.update(self.env_steps, recent)

    def _save(self) -> None:
        if self.checkpoints:
            facts = {
                "updates": self.done,
                "wall_s": self.wall,
                "progress_rows": self.rows_before + len(self.rows),
                "episodes": len(self.episodes),
            }
            self.checkpoints.save(self.done, self.state, facts)

    def _restore(self, template: Any) -> Any:
        """Goes back to the last checkpoint, and the tables with it."""
        assert self.checkpoints and self.folder
        state, facts = self.checkpoints.restore(template)
        self.done = facts["updates"]
        self.wall_before = facts["wall_s"]
        self.rows_before = facts["progress_rows"]
        self.folder.progress.cut(facts["progress_rows"])
        self.folder.episodes.cut(facts["episodes"])
        self.episodes.restore(self.folder.episodes.read())
        return state

    def _evaluate(
        self, policy: Policy, episodes: int
    ) -> tuple[Evaluation, dict[str, Any]]:
        began = time.monotonic()
        seed = self.asked["seed"]
        evaluation = evaluate(
            self.env, policy, episodes=episodes, seed=seed, env_params=self.env_params
        )
        return evaluation, {
            "evaluation_score": evaluation.mean,
            "evaluation_std": evaluation.standard_deviation,
            "evaluation_episodes": episodes,
            "evaluation_flagged_fraction": evaluation.flagged_fraction,
            "evaluation_s": time.monotonic() - began,
        }

    def _summary(self) -> dict[str, Any]:
        wall = self.wall
        names = ("case", "variant", "algorithm", "seed", "score_window")
        return {name: self.asked[name] for name in names} | {
            "final_score": self.episodes.recent(self.asked["score_window"]),
            "env_steps": self.env_steps,
            "wall_s": wall,
            "steps_per_s": self.env_steps / wall,
            "episodes": len(self.episodes),
            "flagged_fraction": self.episodes.flagged_fraction,
            "jax_version": jax.__version__,
            "device": f"{len(self.devices)} x {self.devices[0].device_kind}",
        }


def _check(
    learner: Algorithm,
    config: Any,
    devices: Sequence[jax.Device],
    steps: int,
    score_window: int,
    evaluation_episodes: int,
) -> None:
    if not isinstance(config, learner.config_type):
        raise ValueError(
            f"config must be a {learner.config_type.__name__} for {learner.name}, "
            f"got {type(config).__name__}"
        )
    if not devices:
        raise ValueError("devices must hold at least one device, got none")
    learner.validate(config, len(devices))
    per_update = learner.steps_per_update(config)
    if steps < per_update:
        raise ValueError(
            f"steps must be at least one update, {per_update} control steps, "
            f"got {steps}"
        )
    if score_window < 1:
        raise ValueError(f"score_window must be at least 1, got {score_window}")
    if evaluation_episodes < 0:
        raise ValueError(
            f"evaluation_episodes must not be negative, got {evaluation_episodes}"
        )


def _describe(
    env: Environment,
    learner: Algorithm,
    config: Any,
    steps: int,
    seed: int,
    env_options: Mapping[str, Any] | None,
    score_window: int,
) -> dict[str, Any]:
    """What was asked for, as `config.json` keeps it."""
    options = dict(env_options or {})
    settings = {
        field.name: getattr(config, field.name) for field in dataclasses.fields(config)
    }
    return {
        "case": env.name,
        "variant": options.get("variant", getattr(env, "variant", None)),
        "env_options": options,
        "algorithm": learner.name,
        "steps": steps,
        "seed": seed,
        "score_window": score_window,
        "settings": {name: _plain(value) for name, value in settings.items()},
    }


def _plain(value: Any) -> Any:
    """A setting as JSON holds it."""
    if isinstance(value, tuple):
        return list(value)
    return value.tolist() if isinstance(value, (jax.Array, np.ndarray)) else value


def _open_folder(
    out: str | Path | None, asked: dict[str, Any], resume: bool, overwrite: bool
) -> RunFolder | None:
    """Prepares the folder, or says why it cannot be used."""
    if out is None:
        if resume:
            raise ValueError("resume needs the folder of a run, got out=None")
        return None
    folder = RunFolder(out)
    if resume:
        changed = differences(folder.config(), asked)
        if changed:
            raise ValueError(
                f"resume needs what the run in {str(out)!r} was started with; "
                f"{', '.join(changed)}"
            )
        return folder
    if folder.exists and not overwrite:
        raise ValueError(
            f"out must not hold a run already, got {str(out)!r}; "
            "pass resume=True to continue it or overwrite=True to replace it"
        )
    folder.clear()
    folder.write_config(asked)
    return folder
