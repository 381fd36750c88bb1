"""One environment as a `brax.envs.Env`, for brax's wrappers and learners.

Call brax's `train` inside `with patched_jax():`, without which the newest release of
brax does not run on the releases of JAX that jaxrod needs.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Key, UInt32

try:
    from brax.envs.base import Env, State
except ModuleNotFoundError as missing:
    if missing.name != "brax":
        raise
    raise ModuleNotFoundError(
        'jaxrod.envs.brax_env needs brax; install it with: pip install "jaxrod[brax]"',
        name="brax",
    ) from missing

from jaxrod.envs.checking import action_of_size
from jaxrod.envs.protocol import Environment
from jaxrod.envs.registry import made
from jaxrod.installation.backend import compile_for_rods
from jaxrod.structure import pytree

__all__ = ["BraxEnv", "patched_jax"]


@pytree
class Running:
    """Contents of brax's `pipeline_state`, which brax restores at a restart."""

    state: Any
    """State of the environment."""
    elapsed: UInt32[Array, ""]
    """Control steps since the episode began; the episode length plus 1 once the episode
    has ended before the time limit."""


class BraxEnv(Env):
    """An environment with brax's interface.

    Under brax's own training wrappers, a batch of it has the results of
    `jaxrod.envs.VectorEnvironment`, restarts included: environment i uses the i-th
    random key given to `reset`. Three things follow brax's conventions:

    - brax's `AutoResetWrapper` restores the start of an episode from `info`. If that
      did not change, it would replay the first episode forever, so every step writes a
      new random start there.
    - brax's `EpisodeWrapper` knows one kind of truncation: its own clock running out.
      It treats every other end as a termination by the task. So a step truncated before
      the time limit advances that clock instead of being `done`, and at the time limit
      the clock decides. Without the wrapper both are `done`. `info["time_out"]` marks
      truncations with and without the wrapper.
    - The parameters are `sys`: brax's domain randomisation samples and replaces it.

    Attributes:
        env: The environment.
        sys: Its parameters.

    Example:
        >>> from jaxrod.envs.brax_env import BraxEnv
        >>> env = BraxEnv("trivial")
        >>> start = env.reset(jax.random.PRNGKey(0))
        >>> after = env.step(start, jnp.zeros(env.action_size))
        >>> after.obs.shape, float(after.done)
        ((1,), 0.0)
    """

    def __init__(
        self, task: str | Environment, *, params: Any = None, **options: Any
    ) -> None:
        """Makes the environment.

        Args:
            task: A task for `jaxrod.envs.make`, or an environment.
            params: Parameters of the environment; None for its defaults.
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        compile_for_rods()
        self.env = made(task, options)
        self.sys = self.env.default_params() if params is None else params

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
        """Control steps of an episode; the largest valid limit for `EpisodeWrapper`."""
        return self.env.episode_length

    @property
    def backend(self) -> str:
        """Name of the physics simulator, as brax reports it: "jaxrod"."""
        return "jaxrod"

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Starts an episode.

        Args:
            rng: Key of `jax.random.PRNGKey`, as brax passes keys.

        Returns:
            The state. `metrics` holds the environment's scalars; brax reports their
            sums over episodes. `info` holds the data that a restart does not change.
        """
        ticks = jnp.zeros((), jnp.uint32)
        observation, running = self._start(_key(rng, 2 * ticks))
        nothing = jnp.zeros(())
        return State(
            pipeline_state=running,
            obs=observation,
            reward=nothing,
            done=nothing,
            metrics=dict.fromkeys(self._scalars, nothing),
            info={"rng": rng, "ticks": ticks, "time_out": nothing},
        )

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Advances one control step; an ended episode does not change, with reward 0.

        Args:
            state: State from `reset` or from the step before.
            action: In [-1, 1], shape (action_size,).

        Raises:
            ValueError: The action has another shape.
        """
        action = action_of_size(action, self.env.action_size)
        running = state.pipeline_state
        following = self._advance(state, action)
        # brax repeats an action past the end of an episode: nothing moves then.
        over = running.elapsed >= self.env.episode_length
        still = state.replace(reward=jnp.zeros_like(state.reward))
        if "truncation" in state.info:
            limit, steps = self.env.episode_length, state.info["steps"]
            # A clock beyond the episode's length belongs to an episode that ended
            # early.
            early = (running.elapsed > limit) & (state.done == 0)
            ignored = (running.elapsed == limit) & (steps >= limit)
            still = still.replace(
                done=jnp.maximum(state.done, _number(ignored)),
                info=state.info | {"steps": steps + jnp.where(early, limit, 0)},
            )
        return jax.tree.map(lambda a, b: jnp.where(over, a, b), still, following)

    def _advance(self, state: State, action: Float[Array, " action"]) -> State:
        """Advances a running episode by one control step, and updates brax's `info`."""
        info = dict(state.info)
        ticks = info["ticks"] + 1
        observation, following, reward, terminated, truncated, scalars = self.env.step(
            _key(info["rng"], 2 * ticks),
            state.pipeline_state.state,
            action,
            self._params(),
        )
        # As in VectorEnvironment: non-finite results are truncated before anyone sees
        # them.
        sound = jnp.isfinite(reward) & jnp.all(jnp.isfinite(observation))
        observation = jnp.where(sound, observation, state.obs)
        scalars = scalars | {"flagged": ~sound | scalars.get("flagged", ~sound)}
        elapsed = state.pipeline_state.elapsed + 1
        limit = self.env.episode_length
        done = terminated & sound
        time_out = (truncated | ~sound | (elapsed >= limit)) & ~done
        # An episode that ends for another reason than the clock counts as past the
        # limit.
        early = time_out & (elapsed < limit)
        elapsed = jnp.where(early | done, jnp.uint32(limit + 1), elapsed)
        if "truncation" in info:  # An EpisodeWrapper keeps the clock.
            info["steps"] += jnp.where(early, limit, 0)
        else:
            done = done | time_out
        if "first_obs" in info:  # An AutoResetWrapper restarts from here.
            first, running = self._start(_key(info["rng"], 2 * ticks + 1))
            info |= {"first_obs": first, "first_pipeline_state": running}
        return state.replace(
            pipeline_state=Running(following, elapsed),
            obs=_number(observation, jnp.float32),
            reward=_number(jnp.where(sound, reward, 0)),
            done=_number(done),
            metrics=state.metrics | {k: _number(v) for k, v in scalars.items()},
            info=info | {"ticks": ticks, "time_out": _number(time_out)},
        )

    def _start(
        self, key: Key[Array, ""]
    ) -> tuple[Float[Array, " observation"], Running]:
        observation, state = self.env.reset(key, self._params())
        elapsed = jnp.zeros((), jnp.uint32)
        return _number(observation, jnp.float32), Running(state, elapsed)

    def _params(self) -> Any:
        """Parameters behind an optimisation barrier, so that XLA cannot fold them.

        brax's programs hold them as constants. XLA folds constants ahead of time, and
        the result differs in the last bit from a computation with arguments.
        """
        return jax.lax.optimization_barrier(self.sys)

    @functools.cached_property
    def _scalars(self) -> tuple[str, ...]:
        """Names in brax's `State.metrics`: scalars of a step's `info`, "flagged"."""

        def one_step(key: Key[Array, ""]) -> dict[str, Array]:
            _, state = self.env.reset(key, self.sys)
            action = jnp.zeros(self.action_size)
            return self.env.step(key, state, action, self.sys)[-1]

        key = jax.eval_shape(lambda: jax.random.key(0))
        return (*(jax.eval_shape(one_step, key).keys() | {"flagged"}),)


def _key(rng: UInt32[Array, "2"], index: UInt32[Array, ""]) -> Key[Array, ""]:
    """Random key number `index` of an environment: `fold_in` of its raw key `rng`."""
    return jax.random.fold_in(jax.random.wrap_key_data(rng), index)


def _number(value: Array, dtype: Any = float) -> Array:
    """Casts a value to the dtype that brax uses, so that brax's scans can carry it."""
    return jnp.asarray(value, dtype)


@contextmanager
def patched_jax() -> Iterator[None]:
    """Restores `jax.device_put_replicated`, which brax's learners call.

    JAX 0.10 removed it. Inside `with patched_jax():` it exists again, and afterwards it
    is gone: call brax's `train` there.

    Example:
        >>> from jaxrod.envs.brax_env import patched_jax
        >>> with patched_jax():
        ...     hasattr(jax, "device_put_replicated")
        True
    """
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = _device_put_replicated
    try:
        yield
    finally:
        del jax.device_put_replicated


def _device_put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
    """Copies every array to every device, along a new first axis.

    The mesh axis is named "i", as in brax's learners. Under another name the programs
    would be compiled twice: for the first epoch, and again for the next.
    """
    one_each = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([leaf] * len(devices)), one_each), x
    )
