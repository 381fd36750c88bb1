"""The host side of a training run: it calls chunks of compiled updates.

After every chunk the run writes a row of progress and, from time to time, a checkpoint.
It calls only the functions of an algorithm that `jaxrod.training.Algorithm` declares.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Literal

import jax
import numpy as np

from jaxrod.envs import Environment, EpisodeRecord
from jaxrod.files import make_folder
from jaxrod.training.algorithm import Algorithm, Metrics
from jaxrod.training.evaluation import Evaluation, evaluate
from jaxrod.training.leaves import from_array, named_leaves, to_array, with_leaves
from jaxrod.training.policy import save_policy
from jaxrod.training.progress import ProgressBar, reached
from jaxrod.training.runs.checkpoint import Checkpoints
from jaxrod.training.runs.contract import check_state, updates_of
from jaxrod.training.runs.event_file import EventFile
from jaxrod.training.runs.folder import RunFolder
from jaxrod.training.runs.hosts import (
    Hosts,
    compile_updates,
    device_mesh,
    packed,
    partition_of,
    place,
    trace_updates,
    unpacked,
)
from jaxrod.training.runs.interruption import Interruption
from jaxrod.training.runs.resuming import Stored, facts_of, restore, stored
from jaxrod.training.runs.widening import check_holds_params, widening_of
from jaxrod.training.settings import check_steps

_STORED = "stored"

TENSORBOARD: Literal["tensorboard"] = "tensorboard"
"""Value of `log` that requests an event file in the folder of the run."""

Log = Callable[[dict[str, Any]], None] | Literal["tensorboard"]
"""Type of `log`: a function called with every row of progress, or "tensorboard"."""


@dataclasses.dataclass(frozen=True)
class Result:
    """Result of a run.

    Example:
        >>> env = envs.make("trivial")
        >>> config = training.PPOConfig(num_envs=4, rollout_steps=8)
        >>> result = training.train(
        ...     env, steps=64, config=config, evaluation_episodes=0, progress=False
        ... )
        >>> result.summary["env_steps"], result.policy(jnp.zeros(1)).shape
        (64, (1,))
    """

    summary: dict[str, Any]
    """Contents of `summary.json`: scores, steps, times and the device."""
    policy: Any = dataclasses.field(repr=False)
    """The deterministic policy: a `Policy`, or with a memory a
    `jaxrod.envs.MemoryPolicy`."""
    progress: list[dict[str, Any]] = dataclasses.field(repr=False)
    """One row per chunk of this call, as in `progress.csv`."""
    episodes: EpisodeLog = dataclasses.field(repr=False)
    """Every complete training episode of the run."""
    evaluation: Evaluation | None = dataclasses.field(repr=False)
    """Evaluation of `policy`; None if interrupted or not requested."""
    state: Any = dataclasses.field(repr=False)
    """The final train state."""
    folder: RunFolder | None
    """The run's folder; None without a folder, and in all processes but the first."""


class Run:
    """Host side of one call of `train`: steps so far, train state, records."""

    def __init__(
        self,
        *,
        env: Environment,
        learner: Algorithm,
        config: Any,
        env_params: Any,
        requested: dict[str, Any],
        folder: RunFolder | None,
        resume: bool,
        checkpoint_seconds: float,
        chunk_steps: int,
        devices: Sequence[jax.Device],
        hosts: Hosts,
        show: bool,
        log: Log | None,
    ) -> None:
        """Makes or restores the train state; the arguments are those of `train`."""
        self.began = time.monotonic()
        env_params = env.default_params() if env_params is None else env_params
        self.env, self.learner, self.env_params = env, learner, env_params
        self.requested, self.devices, self.hosts = requested, devices, hosts
        self.folder = folder if hosts.writes else None
        self.saves = folder is not None
        self.checkpoint_seconds = checkpoint_seconds
        self.show = show and hosts.writes
        self.per_update = updates_of(learner, config)
        self.total = check_steps(requested["steps"], self.per_update)
        self.capacity = min(self.total, math.ceil(chunk_steps / self.per_update))
        self.done = 0
        self.wall_s = self.wall_before = 0.0
        self.rows: list[dict[str, Any]] = []
        self.episodes = EpisodeLog()
        own = self.folder
        self.checkpoints = Checkpoints(own.checkpoints) if own else None

        # The mesh is made first, because it fails at once if the devices do not fit.
        self.mesh = device_mesh(devices)
        # Static, because 32 bits cannot hold the control steps of a very long run.
        start = jax.jit(learner.init, static_argnums=(1, 4))
        key = jax.random.key(requested["seed"])
        self.widening = widening_of(env)
        # The evaluation at the end keeps the full randomisation of `self.env_params`.
        narrow = self.widening.put(env_params) if self.widening else env_params
        state = start(key, env, config, narrow, self.total * self.per_update)
        check_state(learner, state, env)
        tracing = time.monotonic()
        self.updates = trace_updates(learner, state, self.capacity, self.mesh)
        self.tracing_s = time.monotonic() - tracing
        if self.widening:
            check_holds_params(state, learner.name)
        if folder and resume:
            state = self._restore(state)
        elif folder:
            # Only after the state could be made: a failure before costs nothing.
            hosts.from_writer(partial(_begin, folder, requested))
        self.state = place(state, partition_of(learner, state), self.mesh)
        self.log = log if hosts.writes and log != TENSORBOARD else None
        self.events: EventFile | None = None
        if own and log == TENSORBOARD:
            known = own.progress.read()
            self.events = EventFile(own.tensorboard, known, self.wall_before)

    @property
    def env_steps(self) -> int:
        """Number of control steps so far, of all environments together."""
        return self.done * self.per_update

    def _clock(self) -> float:
        """Updates and returns the time of the run so far [s].

        Time before the run was resumed counts too.
        """
        self.wall_s = self.wall_before + time.monotonic() - self.began
        return self.wall_s

    def go(self, evaluation_episodes: int) -> Result:
        """Trains to the end or to an interruption, evaluates, and writes the result."""
        # A run that had finished before keeps its summary.
        ended = self.done == self.total
        summary = {} if ended else self._advance()
        finished = self.done == self.total
        policy = self._policy()
        self._export(policy)
        evaluation = None
        if finished and evaluation_episodes:
            evaluation, report = self._evaluate(policy, evaluation_episodes)
            if self.events:
                at = {"env_steps": self.env_steps, "wall_s": self.wall_s}
                score = {"evaluation_score": evaluation.mean}
                self.events.append({**at, **score})
            summary |= report
        if ended and self.folder and self.folder.finished:
            summary = self.folder.summary()
        else:
            status = "finished" if finished else "interrupted"
            summary = self._summary() | {"status": status} | summary
        if self.folder:
            self.folder.write_summary(summary)
        return Result(
            summary=summary,
            policy=policy,
            progress=self.rows,
            episodes=self.episodes,
            evaluation=evaluation,
            state=self.state,
            folder=self.folder,
        )

    def _advance(self) -> dict[str, Any]:
        """Compiles, and trains chunk by chunk; returns compile time and speed."""
        began, steps_before = time.monotonic(), self.env_steps
        if self.show:
            asked, rounded = self.requested["steps"], self.total * self.per_update
            if rounded > asked:
                print(
                    f"{asked:,} steps rounded up to {self.total:,} updates of "
                    f"{self.per_update:,} control steps",
                    file=sys.stderr,
                )
            print(f"compiling {self.learner.name} for {self.env.name}", file=sys.stderr)
        update = compile_updates(self.updates, self.mesh)
        compiled = saved = time.monotonic()
        bar = ProgressBar(
            self.total * self.per_update,
            "steps",
            done=self.env_steps,
            enabled=self.show,
        )
        hosts, stop = self.hosts, False
        with Interruption(bar.message) as interruption:
            while self.done < self.total and not stop:
                count = min(self.capacity, self.total - self.done)
                with hosts.losing_none(self.env_steps):
                    self.state, metrics = update(self.state, count)
                    metrics = hosts.fetched(metrics, self.mesh)
                self._record(metrics, count, bar)
                due = time.monotonic() - saved > self.checkpoint_seconds
                with hosts.losing_none(self.env_steps):
                    stop, due = hosts.agree(interruption.requested, due)
                if due:
                    self._save()
                    saved = time.monotonic()
            self._save()
        self._clock()
        bar.close()
        if self.done < self.total:
            bar.message(f"stopped after {self.env_steps:,} steps")
            if self.folder:
                bar.message(f"resume=True continues the run in {self.folder.path}")
        return {
            "compile_s": self.tracing_s + compiled - began,
            "loop_steps_per_s": (self.env_steps - steps_before)
            / (time.monotonic() - compiled),
        }

    def _record(self, metrics: Metrics, count: int, bar: ProgressBar) -> None:
        """Records a chunk: writes one row of progress and the episodes that ended.

        Args:
            metrics: Metrics of the chunk in host memory; the first axis is updates.
            count: Number of updates of the chunk: valid entries of that axis.
            bar: Progress bar to update.

        Raises:
            FloatingPointError: A reported number is NaN.
        """
        wall = self._clock()
        self.done += count
        new = self.episodes.take(metrics.episodes, count, self.env_steps)
        recent = self.episodes.recent(self.requested["score_window"])
        row = {
            "env_steps": self.env_steps,
            "wall_s": round(wall, 3),
            "steps_per_s": round(self.env_steps / wall, 1),
            "episodes": len(self.episodes),
            "episode_return_mean": recent,
            "flagged_fraction": self.episodes.flagged_fraction,
        }
        if self.widening:
            self.widening.take([row["episode_return"] for row in new])
            self.state = self.widening.put(self.state)
            row["randomisation_share"] = self.widening.share
        row |= {
            name: float(np.mean(values[:count]))
            for name, values in sorted(metrics.scalars.items())
        }
        self.rows.append(row)
        if self.folder:
            self.folder.progress.append([row])
            self.folder.episodes.append(new)
        if self.events:
            self.events.append(row)
        if self.log:
            self.log(row)
        bar.update(self.env_steps, reached(row))
        self._stop_if(name for name, value in row.items() if value != value)

    def _stop_if(self, broken: Iterable[str]) -> None:
        """Raises FloatingPointError if `broken`, the names of NaNs, is not empty."""
        names = ", ".join(broken)
        if names:
            raise FloatingPointError(
                f"{names} is not a number after {self.env_steps:,} steps: "
                "learning diverged"
            )

    def _save(self) -> None:
        # The last step of a chunk may have produced NaNs that no reported number shows
        # yet.
        policy = self._policy()
        lost = any(np.isnan(leaf).any() for leaf in jax.tree.leaves(policy))
        self._stop_if(["the policy"] if lost else [])
        if not self.saves:
            return
        with self.hosts.losing_none(self.env_steps):
            state = self.hosts.fetched(self.state, self.mesh, at_all=False)
        if self.folder and self.checkpoints:
            facts = facts_of(self.folder, self.requested, self.done, self._clock())
            kept = stored(state, self.env_params)
            self.checkpoints.save(self.done, kept, facts)
            # So that a run can be evaluated and drawn while it is running.
            self._export(policy)

    def _policy(self) -> Any:
        """The deterministic policy, in host memory."""
        with self.hosts.losing_none(self.env_steps):
            return self.hosts.fetched(self.learner.policy(self.state), self.mesh)

    def _export(self, policy: Any) -> None:
        """Writes the policy into the folder, if there is one."""
        if self.folder:
            names = ("task", "variant", "algorithm", "seed")
            about = {name: self.requested[name] for name in names}
            make_folder(self.folder.policy)
            save_policy(policy, self.folder.policy, about)

    def _restore(self, template: Any) -> Any:
        """Restores updates, time and episodes; returns the train state to resume."""
        begun = stored(template, self.env_params)
        if not self.hosts.several:
            found = self._read(begun)
        else:
            found = _from_bytes(
                self.hosts.from_writer(lambda: _as_bytes(self._read(begun))), begun
            )
        if found is None:
            return template
        kept, facts, episodes = found
        self.episodes.restore(episodes)
        if self.widening:
            self.widening.take_again(episodes)
        self.done = facts["updates"]
        self.wall_s = self.wall_before = facts["wall_s"]
        return kept.learner

    def _read(self, template: Stored) -> _Found | None:
        """Reads the newest checkpoint and the episodes; None without a checkpoint."""
        assert self.checkpoints and self.folder
        found = restore(self.folder, self.checkpoints, self.requested, template)
        return None if found is None else (*found, self.folder.episodes.read())

    def _evaluate(
        self, policy: Any, episodes: int
    ) -> tuple[Evaluation, dict[str, Any]]:
        began = time.monotonic()
        seed = self.requested["seed"]
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
        names = ("task", "variant", "algorithm", "seed", "score_window")
        return {name: self.requested[name] for name in names} | {
            "first_score": self.episodes.first(self.requested["score_window"]),
            "final_score": self.episodes.recent(self.requested["score_window"]),
            "env_steps": self.env_steps,
            "wall_s": self.wall_s,
            "steps_per_s": self.env_steps / self.wall_s,
            "episodes": len(self.episodes),
            "flagged_fraction": self.episodes.flagged_fraction,
            "jax_version": jax.__version__,
            "device": f"{len(self.devices)} x {self.devices[0].device_kind}",
            **({"randomisation_share": self.widening.share} if self.widening else {}),
        }


_Found = tuple[Stored, dict[str, Any], list[dict[str, str]]]
"""Data to resume from: contents and facts of a checkpoint, and rows of episodes.csv."""


def _begin(folder: RunFolder, requested: dict[str, Any]) -> bytes:
    folder.begin(requested)
    return b""


def _as_bytes(found: _Found | None) -> bytes:
    """Data to resume from as bytes, to send to other processes; empty for None."""
    if found is None:
        return b""
    kept, *about = found
    leaves = named_leaves(kept, _STORED)
    return packed({name: to_array(leaf) for name, leaf in leaves.items()}, about)


def _from_bytes(content: bytes, template: Stored) -> _Found | None:
    """Data to resume from, from the bytes of `_as_bytes`."""
    if not content:
        return None
    arrays, (facts, episodes) = unpacked(content)
    leaves = named_leaves(template, _STORED)
    found = {name: from_array(arrays[name], leaf) for name, leaf in leaves.items()}
    return with_leaves(template, _STORED, found), facts, episodes


class EpisodeLog:
    """Every complete training episode of a run.

    Attributes:
        returns: Sum of the rewards of each episode.
        lengths: Number of control steps of each episode.
        flagged: Whether a numerical health flag ended each episode.
    """

    def __init__(self) -> None:
        """Starts with no episodes."""
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.flagged: list[bool] = []

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.returns)

    def take(
        self, records: EpisodeRecord, updates: int, env_steps: int
    ) -> list[dict[str, Any]]:
        """Adds the complete episodes of a chunk, in chronological order.

        Args:
            records: Arrays in host memory, shape (capacity, steps, num_envs).
            updates: Number of updates of the chunk: valid entries of the first axis.
            env_steps: Control steps of the run when the chunk ended.

        Returns:
            The new episodes, as rows of episodes.csv.
        """
        # The indices are sorted by update, then step, then environment.
        where = np.nonzero(records.finished[:updates])
        returns = [float(x) for x in records.episode_return[where]]
        lengths = [int(x) for x in records.length[where]]
        flagged = [bool(x) for x in records.flagged[where]]
        self.returns += returns
        self.lengths += lengths
        self.flagged += flagged
        return [
            {
                "env_steps": env_steps,
                "episode_return": earned,
                "length": length,
                "flagged": int(flag),
            }
            for earned, length, flag in zip(returns, lengths, flagged, strict=True)
        ]

    def restore(self, rows: list[dict[str, str]]) -> None:
        """Replaces the episodes by those in the rows of an episodes.csv."""
        self.returns = [float(row["episode_return"]) for row in rows]
        self.lengths = [int(row["length"]) for row in rows]
        self.flagged = [row["flagged"] == "1" for row in rows]

    def recent(self, window: int) -> float | None:
        """Mean return of the last `window` episodes, None before the first.

        At the end of a run with the paper's window (10 episodes in Cases 3 and 4, else
        50) this is the final score, which can be compared with the published one.
        """
        return float(np.mean(self.returns[-window:])) if self.returns else None

    def first(self, window: int) -> float | None:
        """Mean return of the first `window` episodes, None before the first."""
        return float(np.mean(self.returns[:window])) if self.returns else None

    @property
    def flagged_fraction(self) -> float:
        """Fraction of the episodes that a health flag ended; 0 before the first."""
        return float(np.mean(self.flagged)) if self.flagged else 0.0
