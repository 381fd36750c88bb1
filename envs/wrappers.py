"""Environment wrappers: actions held for several steps, and batches that restart.

Randomness: environment i of a batch has its own key, and step t draws from
`fold_in(key_i, t)`. So the results of an environment depend neither on its neighbours
nor on the number of devices that share the batch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt

from jaxrod.envs.checking import (
    by_path,
    check_action_shape,
    check_key,
    is_below,
    nearest,
)
from jaxrod.envs.protocol import Environment, Step
from jaxrod.structure import pytree


@pytree
class VectorState:
    """State of a batch of self-restarting environments; every leaf is batched.

    Example:
        >>> env = envs.make("trivial")
        >>> batch, params = envs.VectorEnvironment(env), env.default_params()
        >>> start = batch.reset(jax.random.key(0), 4, params, phase=5)
        >>> start.elapsed.tolist(), start.partial.tolist()
        ([5, 5, 5, 5], [True, True, True, True])
    """

    keys: Key[Array, " num_envs"]
    """One random key per environment, constant over all steps."""
    ticks: UInt[Array, " num_envs"]
    """Control steps since the batch was made; index of the random draws."""
    states: Any
    """States of the environments, stacked along the first axis of every leaf."""
    observation: Float[Array, "num_envs observation"]
    """Current observation of each environment."""
    elapsed: Int[Array, " num_envs"]
    """Control steps of the running episode, counted from its initial `phase`."""
    episode_return: Float[Array, " num_envs"]
    """Sum of the rewards of the running episode."""
    partial: Bool[Array, " num_envs"]
    """Whether the running episode began with `elapsed` above 0, so that its return does
    not count."""


@pytree
class EpisodeRecord:
    """Returns and lengths of the episodes that end in a step.

    Example:
        >>> env = envs.make("trivial", episode_length=1)
        >>> batch, params = envs.VectorEnvironment(env), env.default_params()
        >>> start = batch.reset(jax.random.key(0), 2, params)
        >>> after, step = batch.step(start, jnp.zeros((2, 1)), params)
        >>> step.episodes.finished.tolist(), step.episodes.length.tolist()
        ([True, True], [1, 1])
    """

    finished: Bool[Array, "*batch"]
    """Whether a complete episode ended in this step; the other fields are valid where
    it is true."""
    episode_return: Float[Array, "*batch"]
    """Sum of the rewards of the ended episode."""
    length: Int[Array, "*batch"]
    """Number of control steps of the ended episode."""
    flagged: Bool[Array, "*batch"]
    """Whether a numerical health flag ended the episode."""


@pytree
class VectorStep:
    """Results of one step of the batch; every leaf is batched.

    Example:
        >>> env = envs.make("trivial", episode_length=1)
        >>> batch, params = envs.VectorEnvironment(env), env.default_params()
        >>> start = batch.reset(jax.random.key(0), 2, params)
        >>> after, step = batch.step(start, jnp.zeros((2, 1)), params)
        >>> step.truncated.tolist()
        [True, True]
        >>> bool((step.observation != step.final_observation).all())  # both began again
        True
    """

    observation: Float[Array, "num_envs observation"]
    """Observations to act on next: those after the restart of the ended episodes."""
    final_observation: Float[Array, "num_envs observation"]
    """Observations to bootstrap from: those before the restart."""
    reward: Float[Array, " num_envs"]
    """Reward of the step."""
    terminated: Bool[Array, " num_envs"]
    """Whether the task ended: the value of the next state is 0."""
    truncated: Bool[Array, " num_envs"]
    """Whether the episode was cut short: the value of the next state is that of
    `final_observation`. Terminated takes precedence if both hold."""
    info: dict[str, Array]
    """The environments' scalars before the restart, by name. `"flagged"` is always
    among them: true if the environment reports it, or if a result is not finite."""
    episodes: EpisodeRecord
    """Results of the complete episodes that ended in this step."""


@dataclasses.dataclass(frozen=True)
class VectorEnvironment:
    """Many copies of one environment, each of which restarts when its episode ends.

    The batch keeps the clock of every episode and applies the time limit itself, in
    addition to the environment's own. The two agree, except in the first episodes of a
    batch with `spread_phases`, and after restarts with a `restart_phase` above 0. Those
    episodes start as if part of them had passed, end early, and do not count for the
    score.

    A step that returns a non-finite number is reported as flagged, has zero reward, and
    truncates the episode there. Its final observation is the one before the step. A
    broken environment never affects the others: their results are the same to the last
    bit.

    Example:
        >>> env = envs.make("trivial")
        >>> batch, params = envs.VectorEnvironment(env), env.default_params()
        >>> start = batch.reset(jax.random.key(0), 4, params)
        >>> after, step = batch.step(start, jnp.zeros((4, 1)), params)
        >>> step.observation.shape, step.reward.shape
        ((4, 1), (4,))
        >>> each = replace(params, stride=jnp.array([0.1, 0.2, 0.3, 0.4]))
        >>> varied = envs.VectorEnvironment(env, batched=("stride",))
        >>> after, step = varied.step(start, jnp.ones((4, 1)), each)
    """

    env: Environment
    """Environment of which the batch holds copies."""
    batched: Sequence[str] = ()
    """Dotted paths of the parameters that differ between environments, such as
    "arm.rod.radii"; a path includes everything below it. These leaves have a first axis
    of length `num_envs`. All others are shared by the batch."""

    def __post_init__(self) -> None:
        """Keeps `batched` as a tuple.

        Raises:
            ValueError: `batched` is a string instead of a sequence of strings.
        """
        if isinstance(self.batched, str):
            raise ValueError(
                f"batched must be a sequence of paths, such as ({self.batched!r},), "
                f"got {self.batched!r}"
            )
        object.__setattr__(self, "batched", tuple(self.batched))

    def reset(
        self,
        key: Key[Array, ""],
        num_envs: int,
        params: Any,
        *,
        spread_phases: bool = False,
        phase: Int[Array, ""] | int = 0,
    ) -> VectorState:
        """Starts an episode in every environment of a new batch.

        Args:
            key: Typed random key.
            num_envs: Number of environments, at least 1.
            params: Traced parameters of the environment, shared by the batch except for
                those in `batched`.
            spread_phases: Whether the elapsed step count of every environment starts
                uniformly in [phase, episode_length), so that the episodes of the
                batch end at different times.
            phase: Initial elapsed step count [control steps]; the lower bound with
                `spread_phases`.

        Raises:
            ValueError: `num_envs` is below 1, or the parameters do not fit `batched`.
            TypeError: `key` is no random key.

        Example:
            >>> env = envs.make("trivial")
            >>> batch, params = envs.VectorEnvironment(env), env.default_params()
            >>> start = batch.reset(jax.random.key(0), 4, params)
            >>> start.observation.shape
            (4, 1)
        """
        check_key(key)
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        keys = jax.random.split(key, num_envs)
        ticks = jnp.zeros(num_envs, jnp.uint32)
        observation, states = self._together(
            self.env.reset, params, _randomness(keys, 2 * ticks)
        )
        elapsed = jnp.full(num_envs, phase, jnp.int32)
        if spread_phases:
            elapsed = jax.vmap(
                lambda k: jax.random.randint(
                    k, (), phase, self.env.episode_length, jnp.int32
                )
            )(_randomness(keys, 2 * ticks + 1))
        return VectorState(
            keys=keys,
            ticks=ticks,
            states=states,
            observation=observation,
            elapsed=elapsed,
            episode_return=jnp.zeros(num_envs, observation.dtype),
            partial=elapsed > 0,
        )

    def step(
        self,
        state: VectorState,
        action: Float[Array, "num_envs action"],
        params: Any,
        *,
        restart_phase: Int[Array, ""] | int = 0,
    ) -> tuple[VectorState, VectorStep]:
        """Advances every environment by one control step.

        If the environment's `info` has an entry "control_steps"
        (`jaxrod.envs.ActionRepeat`), it advances by that number of control steps. The
        restart runs in a branch that is taken only when some episode ends, so it costs
        nothing in other steps (under an outer `vmap` both branches run).

        Args:
            state: State of the batch.
            action: In [-1, 1], shape (num_envs, action_size).
            params: Traced parameters of the environment.
            restart_phase: Initial elapsed step count of episodes that start now
                [control steps]. If above 0 they end that much earlier and do not
                count.

        Raises:
            ValueError: The actions have another shape, or the parameters do not fit
                `batched`.

        Example:
            >>> env = envs.make("trivial")
            >>> batch, params = envs.VectorEnvironment(env), env.default_params()
            >>> start = batch.reset(jax.random.key(0), 4, params)
            >>> after, step = batch.step(start, jnp.zeros((4, 1)), params)
            >>> step.reward.shape, step.truncated.tolist()
            ((4,), [False, False, False, False])
        """
        shape = (state.ticks.shape[0], self.env.action_size)
        check_action_shape("actions", action, shape)
        ticks = state.ticks + 1
        keys = _randomness(state.keys, 2 * ticks)
        observation, states, reward, terminated, truncated, info = self._together(
            self.env.step, params, keys, state.states, action
        )

        sound = jnp.isfinite(reward) & jnp.all(jnp.isfinite(observation), axis=-1)
        observation = jnp.where(sound[:, None], observation, state.observation)
        reward = jnp.where(sound, reward, 0).astype(state.episode_return.dtype)
        flagged = ~sound | info.get("flagged", ~sound)
        info = info | {"flagged": flagged}

        elapsed = state.elapsed + info.get("control_steps", 1)
        terminated = terminated & sound
        truncated = truncated | ~sound | (elapsed >= self.env.episode_length)
        done = terminated | truncated
        episode_return = state.episode_return + reward
        episodes = EpisodeRecord(
            finished=done & ~state.partial,
            episode_return=episode_return,
            length=elapsed,
            flagged=flagged,
        )

        def restart(running: tuple[Array, Any]) -> tuple[Array, Any]:
            keys = _randomness(state.keys, 2 * ticks + 1)
            fresh = self._together(self.env.reset, params, keys)
            return jax.tree.map(lambda a, b: _select(done, a, b), fresh, running)

        shown, states = jax.lax.cond(
            jnp.any(done), restart, lambda running: running, (observation, states)
        )
        following = VectorState(
            keys=state.keys,
            ticks=ticks,
            states=states,
            observation=shown,
            elapsed=jnp.where(done, restart_phase, elapsed),
            episode_return=jnp.where(done, 0, episode_return),
            partial=jnp.where(done, restart_phase > 0, state.partial),
        )
        step = VectorStep(
            observation=shown,
            final_observation=observation,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            info=info,
            episodes=episodes,
        )
        return following, step

    def _together(
        self, function: Callable[..., Any], params: Any, keys: Array, *given: Any
    ) -> Any:
        """Calls `reset` or `step` for all environments, each with its parameters.

        Raises:
            ValueError: The parameters do not fit `batched`.
        """
        leaves, structure = jax.tree.flatten(params)
        axes = self._axes(params, len(keys))

        def call(leaves: Any, *given: Any) -> Any:
            return function(*given, jax.tree.unflatten(structure, leaves))

        mapped = jax.vmap(call, in_axes=(axes, *(0 for _ in (keys, *given))))
        try:
            results = mapped(leaves, keys, *given)
        except (TypeError, ValueError) as error:
            self._check_shared(params, len(keys), error)
            raise
        observation, _, *scalars = results
        if observation.shape != (len(keys), self.env.observation_size) or any(
            jnp.shape(leaf) != (len(keys),) for leaf in jax.tree.leaves(scalars)
        ):
            self._check_shared(params, len(keys), None)
        return results

    def _axes(self, params: Any, num_envs: int) -> list[int | None]:
        """Batch axis of each leaf of the parameters, None for a shared one."""
        if not self.batched:
            return [None] * len(jax.tree.leaves(params))
        leaves, axes = by_path(params), []
        for above in self.batched:
            if not any(is_below(path, above) for path in leaves):
                raise ValueError(
                    f"batched names {above!r}; the nearest parameters are "
                    f"{nearest(above, leaves)}"
                )
        for path, leaf in leaves.items():
            own = any(is_below(path, above) for above in self.batched)
            if own and jnp.shape(leaf)[:1] != (num_envs,):
                raise ValueError(
                    f"batched names {path!r}, which must have a first axis of "
                    f"{num_envs} environments, got shape {jnp.shape(leaf)}"
                )
            axes.append(0 if own else None)
        return axes

    def _check_shared(
        self, params: Any, num_envs: int, error: Exception | None
    ) -> None:
        """Raises if shared parameters have a batch axis, the likely cause of an error.

        Raises:
            ValueError: Some have, and `batched` does not name them.
        """
        usual = by_path(self.env.default_params())
        wide = [
            path
            for path, leaf in by_path(params).items()
            if path in usual
            and jnp.shape(leaf) == (num_envs, *jnp.shape(usual[path]))
            and not any(is_below(path, above) for above in self.batched)
        ]
        if wide:
            raise ValueError(
                f"{', '.join(wide[:5])}: these parameters have a first axis of "
                f"{num_envs}, the number of environments. If they differ between "
                f"environments, say VectorEnvironment(env, batched=({wide[0]!r},))"
            ) from error


def _randomness(
    keys: Key[Array, " num_envs"], index: UInt[Array, " num_envs"]
) -> Key[Array, " num_envs"]:
    """Random key number `index` of each environment: `fold_in(key, index)`."""
    return jax.vmap(jax.random.fold_in)(keys, index)


def _select(done: Bool[Array, " num_envs"], new: Array, old: Array) -> Array:
    """Rows of `new` where `done` is true, of `old` elsewhere; axis 0 is the batch."""
    mask = jnp.reshape(done, done.shape + (1,) * (jnp.ndim(old) - 1))
    return jnp.where(mask, new, old)


class EnvironmentWrapper:
    """Base class of wrappers: forwards properties, parameters and `reset`.

    Subclasses are frozen dataclasses. They define `step`, and override what differs
    from the wrapped environment.
    """

    env: Environment
    """The wrapped environment."""

    @property
    def unwrapped(self) -> Environment:
        """The innermost environment, without wrappers."""
        return getattr(self.env, "unwrapped", self.env)

    @property
    def name(self) -> str:
        """Name of the wrapped environment's task."""
        return self.env.name

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return self.env.action_size

    @property
    def episode_length(self) -> int:
        """Control steps after which an episode is truncated."""
        return self.env.episode_length

    def default_params(self) -> Any:
        """Default parameters of the wrapped environment."""
        return self.env.default_params()

    def reset(self, key: Key[Array, ""], params: Any) -> tuple[Array, Any]:
        """Starts an episode of the wrapped environment."""
        return self.env.reset(key, params)


@dataclasses.dataclass(frozen=True)
class ActionRepeat(EnvironmentWrapper):
    """Holds every action for `times` control steps and adds up their rewards.

    Control steps of the benchmark are 1.4 ms, far shorter than the response time of an
    arm. An agent that decides at every step explores with noise that the arm averages
    out, and has to look hundreds of decisions ahead.

    An episode may end in between: rewards of the remaining control steps do not count.
    `info` is that of the last step that counts. It also holds `"control_steps"`, the
    number of steps that counted, for `VectorEnvironment`'s clock.

    Raises:
        ValueError: If `times` is below 1.

    Example:
        >>> env = envs.ActionRepeat(envs.make("trivial"), times=4)
        >>> params = env.default_params()
        >>> observation, start = env.reset(jax.random.key(0), params)
        >>> step = env.step(jax.random.key(1), start, jnp.array([0.1]), params)
        >>> int(step[-1]["control_steps"])
        4
    """

    env: Environment
    """The wrapped environment."""
    times: int
    """Number of control steps for which each action is held."""

    def __post_init__(self) -> None:
        """Checks that `times` is at least 1."""
        if self.times < 1:
            raise ValueError(f"times must be at least 1, got {self.times}")

    def step(
        self,
        key: Key[Array, ""],
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> Step:
        """Advances by `times` control steps; step k draws from `fold_in(key, k)`."""

        def step(state: Any, number: Array | int) -> Any:
            return self.env.step(jax.random.fold_in(key, number), state, action, params)

        def again(number: Array, before: Any) -> Any:
            *_, terminated, truncated, info = before
            done = terminated | truncated
            after = _counted(step(before[1], number), info["control_steps"] + 1)
            kept = jax.tree.map(lambda a, b: jnp.where(done, a, b), before, after)
            reward = before[2] + jnp.where(done, 0, after[2])
            return (*kept[:2], reward, *kept[3:])

        first = _counted(step(state, 0), jnp.int32(1))
        return jax.lax.fori_loop(1, self.times, again, first)


def _counted(outcome: Any, control_steps: Array) -> Any:
    """Results of a `step`, with the number of control steps added to `info`."""
    *most, info = outcome
    return (*most, info | {"control_steps": control_steps})


def repeating(env: Environment, times: int) -> Environment:
    """The environment itself, or a wrapper that holds actions for `times` steps."""
    return env if times == 1 else ActionRepeat(env, times)
