"""A batch of environments that restart by themselves and keep score.

Randomness: environment i of the batch has its own key, and step t draws from
`fold_in(key_i, t)`. What happens to an environment therefore depends neither on
its neighbours nor on how many devices share the batch.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt

from jaxrod.envs.actions import check_action_shape
from jaxrod.envs.protocol import Environment
from jaxrod.structure import pytree


@pytree
class VectorState:
    """State of a batch of self-restarting environments; every leaf is batched."""

    keys: Key[Array, " num_envs"]
    """One random key for every environment, never changed."""
    ticks: UInt[Array, " num_envs"]
    """Control steps since the batch was made; counts the randomness."""
    states: Any
    """States of the environments."""
    observation: Float[Array, "num_envs observation"]
    """Current observation of each environment."""
    elapsed: Int[Array, " num_envs"]
    """Control steps of the running episode, initial phase included."""
    episode_return: Float[Array, " num_envs"]
    """Sum of the rewards of the running episode."""
    partial: Bool[Array, " num_envs"]
    """The running episode began in mid-course and does not count."""


@pytree
class EpisodeRecord:
    """Results of the episodes that end in a step."""

    finished: Bool[Array, "*batch"]
    """A complete episode ended here; the rest is valid where true."""
    episode_return: Float[Array, "*batch"]
    """Sum of its rewards."""
    length: Int[Array, "*batch"]
    """Its control steps."""
    flagged: Bool[Array, "*batch"]
    """Whether a numerical health flag ended it."""


@pytree
class VectorStep:
    """Results of one step of the batch; every leaf is batched."""

    observation: Float[Array, "num_envs observation"]
    """Observations after the restart of those that ended: those to act on next."""
    final_observation: Float[Array, "num_envs observation"]
    """Observations before the restart: those to bootstrap from."""
    reward: Float[Array, " num_envs"]
    """Reward of the step."""
    terminated: Bool[Array, " num_envs"]
    """The task ended: the value of what follows is 0."""
    truncated: Bool[Array, " num_envs"]
    """The episode was cut short: the value of what follows is that of
    `final_observation`. Terminated wins where both hold."""
    info: dict[str, Array]
    """The environment's scalars, before the restart; `"flagged"` is always among them,
    raised by the environment or by a number that is not finite."""
    episodes: EpisodeRecord
    """The complete episodes that ended here."""


@dataclasses.dataclass(frozen=True)
class VectorEnvironment:
    """Many copies of one environment, each restarting when its episode ends.

    The batch keeps the clock of every episode and applies the time limit itself,
    beside the environment's own. The two agree, except in the first episodes of
    a batch with spread phases and after restarts in mid-course: those begin as if
    part of the episode had passed, end early, and are left out of the score.

    A step that returns a number that is not finite is reported as flagged, pays
    nothing and truncates there, with the observation before it as the final one. One
    broken environment never affects the others: their results are the same to the
    last bit.
    """

    env: Environment
    """The environment."""

    def reset(
        self,
        key: Key[Array, ""],
        num_envs: int,
        params: Any,
        *,
        spread_phases: bool = False,
        phase: Int[Array, ""] | int = 0,
    ) -> VectorState:
        """Starts the batch.

        Args:
            key: Typed random key.
            num_envs: Number of environments, at least 1.
            params: Traced parameters of the environment, shared by the batch.
            spread_phases: Let the elapsed step count of every environment start
                uniformly in [phase, episode_length), so that the episodes of the
                batch end at different times.
            phase: Where the elapsed step count starts otherwise [control steps].

        Raises:
            ValueError: `num_envs` is below 1.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        keys = jax.random.split(key, num_envs)
        ticks = jnp.zeros(num_envs, jnp.uint32)
        observation, states = jax.vmap(self.env.reset, in_axes=(0, None))(
            _randomness(keys, 2 * ticks), params
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

        Where its `info` has `"control_steps"` (`jaxrod.envs.ActionRepeat`), by that
        many. The restart runs in a branch taken only when some episode ends, so it
        costs nothing in between (under an outer `vmap` both branches run).

        Args:
            state: State of the batch.
            action: In [-1, 1], shape (num_envs, action_size).
            params: Traced parameters of the environment.
            restart_phase: Where the elapsed step count of episodes that start now
                starts [control steps]. Above 0 they end that much earlier and do not
                count.

        Raises:
            ValueError: The actions have another shape.
        """
        shape = (state.ticks.shape[0], self.env.action_size)
        check_action_shape("actions", action, shape)
        ticks = state.ticks + 1
        observation, states, reward, terminated, truncated, info = jax.vmap(
            self.env.step, in_axes=(0, 0, 0, None)
        )(_randomness(state.keys, 2 * ticks), state.states, action, params)

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
            fresh = jax.vmap(self.env.reset, in_axes=(0, None))(
                _randomness(state.keys, 2 * ticks + 1), params
            )
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


def _randomness(
    keys: Key[Array, " num_envs"], index: UInt[Array, " num_envs"]
) -> Key[Array, " num_envs"]:
    """Keys number `index`; nothing is computed where the result is not used."""
    return jax.vmap(jax.random.fold_in)(keys, index)


def _select(done: Bool[Array, " num_envs"], new: Array, old: Array) -> Array:
    """`new` for the environments that are done, `old` for the others."""
    mask = jnp.reshape(done, done.shape + (1,) * (jnp.ndim(old) - 1))
    return jnp.where(mask, new, old)
