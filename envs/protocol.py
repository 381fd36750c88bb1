"""The environment protocol: two pure functions and four facts; what to draw besides.

An environment is a *namespace*: static, without state, hashable. All that
changes in time is in the state it returns, all its numbers are in its
parameters, and both are pytrees. So `jax.vmap` makes a batch of it, `jax.grad`
differentiates through it, and a change of a number recompiles nothing.

Time limit: an environment counts its own control steps with an integer in its
state and says `truncated` at step `episode_length`. Wrappers may end an episode
earlier, never later; `jaxrod.envs.wrappers.VectorEnvironment` does so to spread
the phases of a batch.
"""

from __future__ import annotations

from typing import Any, Protocol

from jaxtyping import Array, Bool, Float, Key

from jaxrod.envs.snapshot import Snapshot

Params = Any
"""Traced parameters of an environment: any pytree."""

State = Any
"""State of one environment: any pytree of arrays."""

Info = dict[str, Array]
"""Scalars about one step, always under the same keys."""


class Environment(Protocol):
    """One arm with a task; see the module docstring.

    Implementations are usually frozen dataclasses whose fields are structure
    (counts, names, flags), so that equal environments share compiled programs.
    """

    @property
    def name(self) -> str:
        """Name of the task, for people; that of a built-in one as in the registry."""

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""

    @property
    def action_size(self) -> int:
        """Length of the action vector."""

    @property
    def episode_length(self) -> int:
        """Control steps after which an episode is truncated."""

    def default_params(self) -> Params:
        """Parameters of the task as published, every float a traced leaf."""

    def reset(
        self, key: Key[Array, ""], params: Params
    ) -> tuple[Float[Array, " observation"], State]:
        """Starts an episode.

        Args:
            key: Typed random key; the only source of randomness.
            params: Traced parameters.

        Returns:
            The first observation, shape (observation_size,), and the state.
        """

    def step(
        self,
        key: Key[Array, ""],
        state: State,
        action: Float[Array, " action"],
        params: Params,
    ) -> tuple[
        Float[Array, " observation"],
        State,
        Float[Array, ""],
        Bool[Array, ""],
        Bool[Array, ""],
        Info,
    ]:
        """Advances one control step; never resets.

        Args:
            key: Typed random key of this step.
            state: State from `reset` or from the step before.
            action: In [-1, 1], shape (action_size,).
            params: Traced parameters.

        Returns:
            `(observation, state, reward, terminated, truncated, info)`.
            `terminated`: the task itself ended; the value of the final
            observation is 0. `truncated`: the episode was cut short (time
            limit, numerical health); the final observation has a value, to be
            estimated from it. `info` maps fixed names to scalars; under
            `"flagged"` an environment may report that a numerical health flag
            rose, in which case the step is also truncated or terminated. What the
            tasks then report of the arm (`"distance"`) is of the last sound one.
        """


class Drawable(Environment, Protocol):
    """An environment that says what to draw; the others train and evaluate as well."""

    @property
    def control_period(self) -> float:
        """Time between actions [s]."""

    def snapshot(self, state: State, params: Params) -> Snapshot:
        """Bodies to be drawn.

        Args:
            state: Of the moment.
            params: Traced parameters.
        """


class Plannable(Environment, Protocol):
    """An environment that can be planned with; the others train and evaluate as well.

    The four tasks of the arm are, and `following`. `predict` and `cost` are pure and
    differentiable; what is random is not foreseen, so a plan knows no more than an
    agent could.
    `jaxrod.control.mpc` takes it; `residuals` only where it plans by Gauss-Newton.
    """

    def predict(
        self,
        state: State,
        action: Float[Array, " action"],
        params: Params,
        control_steps: int = 1,
    ) -> State:
        """The state later, under one action, without the randomness to come.

        It is what `step` makes of the state, wherever no random event falls.

        Args:
            state: Of the moment.
            action: In [-1, 1].
            params: Traced parameters.
            control_steps: For how many the action is held.
        """

    def cost(
        self, state: State, action: Float[Array, " action"], params: Params
    ) -> Float[Array, ""]:
        """Smooth cost of a state and of the action that led there.

        It is least where the reward is greatest, and has a slope where the reward's
        steps have none.

        Args:
            state: After the control step.
            action: In it.
            params: Traced parameters.
        """

    def residuals(
        self, state: State, action: Float[Array, " action"], params: Params
    ) -> Float[Array, " residuals"]:
        """Numbers whose squares add up to the cost; arguments as of `cost`."""
