"""The environment protocol: pure functions, four properties, and optional extensions.

An environment object is static, stateless and hashable. Everything that changes in time
is in the state that its functions return. All physical numbers are in its parameters.
Both are pytrees. So `jax.vmap` makes a batch of it, `jax.grad` differentiates through
it, and changing a number recompiles nothing.

Time limit: wrappers and learners truncate an episode at step `episode_length`. An
environment may also count its control steps in its state and return `truncated` there.
Wrappers may end an episode earlier, never later;
`jaxrod.envs.wrappers.VectorEnvironment` does so to let the episodes of a batch end at
different times.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple, Protocol

from jaxtyping import Array, Bool, Float, Key

from jaxrod.structure import pytree, static

Params = Any
"""Traced parameters of an environment: any pytree."""

State = Any
"""State of one environment: any pytree of arrays."""

Info = dict[str, Array]
"""Diagnostics of one step: scalars by name, with the same names at every step."""

Step = tuple[
    Float[Array, " observation"],
    State,
    Float[Array, ""],
    Bool[Array, ""],
    Bool[Array, ""],
    Info,
]
"""Results of a step: observation, state, reward, terminated, truncated, info."""


class Environment(Protocol):
    """Simulated body with a task: observations, actions, rewards and episodes.

    Implementations are usually frozen dataclasses whose fields are structure
    (counts, names, flags), so that equal environments share compiled programs.

    Example:
        >>> env = envs.make("trivial")  # a point on a line is to be moved to zero
        >>> params = env.default_params()
        >>> observation, start = env.reset(jax.random.key(0), params)
        >>> action = jnp.clip(-observation / params.stride, -1.0, 1.0)
        >>> closer, after, reward, terminated, truncated, info = env.step(
        ...     jax.random.key(1), start, action, params
        ... )
        >>> bool(abs(closer[0]) < abs(observation[0]))
        True
    """

    @property
    def name(self) -> str:
        """Name of the task for display; a built-in task has its registry name."""

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
        """Default parameters of the task; every float is a traced leaf."""

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
    ) -> Step:
        """Advances one control step; never resets.

        Args:
            key: Typed random key of this step.
            state: State from `reset` or from the step before.
            action: In [-1, 1], shape (action_size,).
            params: Traced parameters.

        Returns:
            `(observation, state, reward, terminated, truncated, info)`. `terminated`:
            the task itself ended; the value of the final observation is 0. `truncated`:
            the episode was cut short (time limit, numerical health); the final
            observation has a value, to be estimated from it. `info` maps fixed names to
            scalars. Under `"flagged"` an environment may report that a numerical health
            flag rose; the step is then also truncated or terminated. What the tasks
            then report about the arm (`"distance"`) comes from its last sound state.
        """


class Drawable(Environment, Protocol):
    """An environment that can be drawn; training and evaluation do not need this.

    Example:
        >>> env = envs.make("tracking")
        >>> params = env.default_params()
        >>> observation, start = jax.eval_shape(env.reset, jax.random.key(0), params)
        >>> seen = jax.eval_shape(env.snapshot, start, params)
        >>> seen.positions.shape, round(1e3 * env.control_period, 2)  # nodes, [ms]
        ((3, 21), 1.4)
    """

    @property
    def control_period(self) -> float:
        """Time between actions [s]."""

    def snapshot(self, state: State, params: Params) -> Snapshot:
        """Rods, objects and readouts to draw for a state.

        Args:
            state: Current state.
            params: Traced parameters.
        """


class Plannable(Environment, Protocol):
    """An environment that planners can use; training and evaluation do not need this.

    The tasks of the arm, `lift`, `insert`, `catheter` and `trivial` are plannable.
    `predict` and `cost` are pure and differentiable. They do not foresee random events,
    so a plan knows no more than an agent could. `jaxrod.control.mpc` takes such an
    environment; it needs `residuals` only for planning by Gauss-Newton.

    Example:
        >>> env = envs.make("tracking")
        >>> params = env.default_params()
        >>> observation, start = jax.eval_shape(env.reset, jax.random.key(0), params)
        >>> action = jnp.zeros(env.action_size)
        >>> later = jax.eval_shape(env.predict, start, action, params)
        >>> jax.eval_shape(env.cost, later, action, params).shape
        ()
    """

    def predict(
        self,
        state: State,
        action: Float[Array, " action"],
        params: Params,
        control_steps: int = 1,
    ) -> State:
        """Predicts the state under one action, without future random events.

        This is the state that `step` computes, as long as no random event occurs.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Traced parameters.
            control_steps: Number of control steps for which the action is held.
        """

    def cost(
        self, state: State, action: Float[Array, " action"], params: Params
    ) -> Float[Array, ""]:
        """Smooth cost of a state and of the action that led to it, for planners.

        It is smallest where the reward is largest. It has a slope even where the reward
        is a step function, which has none.

        Args:
            state: State after the control step.
            action: Action of that step.
            params: Traced parameters.
        """

    def residuals(
        self, state: State, action: Float[Array, " action"], params: Params
    ) -> Float[Array, " residuals"]:
        """Residuals whose squares sum to the cost; takes the arguments of `cost`."""


class Privileged(Environment, Protocol):
    """An environment that shows a critic more than its observation.

    A critic is only used in training, where the simulation knows everything. Randomised
    environments are of this kind, see `jaxrod.training.PPOConfig.privileged_critic`.

    Example:
        >>> varied = envs.Randomisation(
        ...     parameters={"stride": {"uniform": (0.1, 0.3)}}, noise=0.05
        ... )
        >>> env = envs.make("trivial", randomise=varied)
        >>> params = env.default_params()
        >>> observation, start = env.reset(jax.random.key(0), params)
        >>> env.privileged_observation(start, params).shape  # position and stride
        (2,)
    """

    def privileged_observation(
        self, state: State, params: Params
    ) -> Float[Array, " privileged"]:
        """Quantities that no sensor shows, as one vector.

        Args:
            state: Current state.
            params: Traced parameters.
        """


class Goals(NamedTuple):
    """Indices of the entries of an observation that describe body and goal.

    Example:
        >>> entries = envs.make("tracking").goal_entries
        >>> entries.achieved, entries.desired  # x, y, z of the tip and of the target
        ((10, 21, 32), (37, 38, 39))
    """

    body: tuple[int, ...]
    """Entries that describe the body, and nothing of the goal."""
    achieved: tuple[int, ...]
    """Entries that say where the body is, in the order of `desired`."""
    desired: tuple[int, ...]
    """Entries that say where it should be."""


class GoalConditioned(Environment, Protocol):
    """An environment whose reward depends on an achieved and a desired goal alone.

    `tracking` and `reaching` are such environments. Learners that learn from goals
    other than the desired one need this; see `jaxrod.envs.goal_env`.

    Example:
        >>> env = envs.make("tracking")
        >>> params = env.default_params()
        >>> env.goal_reward(jnp.zeros(3), jnp.array([0.0, 0.0, 0.2]), params).round(2)
        Array(-0.04, dtype=float32)
    """

    @property
    def goal_entries(self) -> Goals:
        """Entries of the observation that describe body and goal."""

    def goal_reward(
        self,
        achieved: Float[Array, " goal"],
        desired: Float[Array, " goal"],
        params: Params,
    ) -> Float[Array, ""]:
        """Reward of a step after which `achieved` holds instead of `desired`.

        It is the reward of `step`, except for steps in which the body breaks.

        Args:
            achieved: Entries of the observation in `goal_entries.achieved`.
            desired: Entries of the observation in `goal_entries.desired`.
            params: Traced parameters.
        """


class Channel(NamedTuple):
    """Number, name and unit of consecutive entries of an observation or an action.

    An environment may have `observation_channels` and `action_channels`: tuples of
    channels, in the order of the entries. Exported policies include them.

    Example:
        >>> env = envs.make("trivial")
        >>> env.observation_channels[0]
        Channel(size=1, name='position', unit='m')
    """

    size: int
    """Number of entries."""
    name: str
    """Quantity that the entries hold, and their order."""
    unit: str
    """Unit: with "0.03 m" an entry of 1 means 0.03 m; "1" for dimensionless entries."""


Number = Float[Array, ""] | float
"""Scalar: an array without axes, or a float."""
Point = Float[Array, "3"]
"""Coordinates x, y, z of a point [m]."""


@pytree
class Snapshot:
    """The rods at one moment, and the objects around them, for drawing.

    Array shapes are those of one moment; `jax.vmap` puts a frame axis first. Everything
    but the nodes and the centres of the spheres stays constant during an episode.

    Example:
        >>> goal = (1.0, 0.0, 0.3), 0.05  # centre and radius [m]
        >>> seen = envs.Snapshot(state.positions, rod.radii, spheres=(goal,))
        >>> seen.positions.shape, len(seen.spheres), seen.up
        ((3, 11), 1, 'z')
    """

    positions: Float[Array, "*rods 3 n+1"]
    """Positions of the nodes [m]; rods of equal size are stacked along a first axis."""
    radii: Float[Array, "*#rods n"]
    """Radii of the elements [m]."""
    spheres: tuple[tuple[Point, Number], ...] = ()
    """Centre and radius of each sphere [m], for example a target."""
    cylinders: tuple[tuple[Point, Point, Number], ...] = ()
    """Midpoints of both ends and radius of each cylinder [m], for example an
    obstacle."""
    readouts: dict[str, Number] = dataclasses.field(default_factory=dict)
    """Numbers to show with the picture, by their labels."""
    up: Literal["x", "y", "z"] = static(default="z")
    """Axis that points up."""
