"""Base class of tasks with one scene; users add actions, observations and reward."""

from __future__ import annotations

import dataclasses
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxrod.analysis.health import HealthLimits, freeze, health
from jaxrod.envs.checking import action_of_size, check_key
from jaxrod.envs.protocol import Number, Point, Snapshot, Step
from jaxrod.stepping.runs import advance
from jaxrod.structure import pytree


@pytree
class SceneTaskParams:
    """Parameters of a `SceneTask`: the scene, and the state in which episodes start.

    Example:
        >>> paths = {"scene.effects[1].acceleration": {"uniform": (0.9, 1.1)}}
        >>> sorted(paths)  # a path of `Randomisation` begins with the field's name
        ['scene.effects[1].acceleration']
    """

    scene: Any
    """The scene or the system, without what actions add."""
    start: Any
    """Its state at the start of every episode."""


@pytree
class SceneTaskState:
    """State of a `SceneTask`: state of the scene, and the goal of the episode.

    Example:
        >>> now = envs.SceneTaskState(body=state, goal=jnp.array([0.1, 0.0, 0.2]))
        >>> now.body.tip.shape, now.goal.shape
        ((3,), (3,))
    """

    body: Any
    """State of the scene or of the system."""
    goal: Any
    """The goal that `SceneTask.goal` drew for the episode, as it has moved since."""


class SceneTask(ABC):
    """Base class of your own tasks, which move one scene, or one system, by actions.

    A subclass has four attributes: `action_size`, `episode_length` in control steps,
    `control_period`, the time between actions [s], and `dt`, the time step [s]. It has
    four methods: `build`, `act`, `observe` and `reward`. The base class steps, checks
    the health of each state, predicts for planners (`Plannable`) and draws
    (`Drawable`). Make the subclass a frozen dataclass if it has options. Equal tasks
    share compiled programs, so attributes of an object cannot be set.

    If a health flag rises, the scene keeps its last sound state, and the episode is
    truncated.

    Example:
        >>> class Reach(envs.SceneTask):
        ...     action_size, episode_length = 2, 50
        ...     control_period, dt = 0.02, 2e-4
        ...
        ...     def build(self):
        ...         size = dict(length=0.3, radius=0.01, density=1e3)
        ...         rod, start = jaxrod.straight_rod(8, youngs_modulus=1e6, **size)
        ...         return jaxrod.make_scene(rod, jaxrod.clamp(start)), start
        ...
        ...     def act(self, scene, action):
        ...         couple = jnp.append(0.5 * action, 0.0)  # [N m/m]
        ...         return scene.with_effect(jaxrod.uniform_load((0, 0, 0), couple))
        ...
        ...     def goal(self, key):
        ...         return jax.random.uniform(key, (3,), minval=0.1, maxval=0.2)
        ...
        ...     def observe(self, state, goal):
        ...         return jnp.concatenate([state.tip, goal])
        ...
        ...     def reward(self, state, goal):
        ...         return -jnp.linalg.norm(state.tip - goal)
        >>> env = Reach()
        >>> envs.check_environment(env)
        >>> env.name, env.observation_size, env.substeps
        ('reach', 6, 100)
    """

    action_size: ClassVar[int]
    """Length of the action vector."""
    episode_length: ClassVar[int]
    """Control steps after which an episode is truncated."""
    control_period: ClassVar[float]
    """Time between actions [s], a whole multiple of `dt`."""
    dt: ClassVar[float]
    """Time step of the simulation [s], see `jaxrod.stable_dt`."""
    limits: ClassVar[HealthLimits | None] = None
    """Limits beyond which a state is flagged; None for the usual ones."""

    def __eq__(self, other: object) -> bool:
        """Whether the classes are the same; a dataclass also compares its options."""
        return type(other) is type(self)

    def __hash__(self) -> int:
        """Hash of the class."""
        return hash(type(self))

    def __setattr__(self, name: str, value: Any) -> None:
        """Raises an error: equal tasks must do the same.

        Raises:
            dataclasses.FrozenInstanceError: Always.
        """
        kind = type(self).__name__
        raise dataclasses.FrozenInstanceError(
            f"{name} of a task cannot be set: make {kind} a frozen dataclass with the "
            f"field {name}, and give its value as {kind}({name}={value!r:.60})"
        )

    @abstractmethod
    def build(self) -> tuple[Any, Any]:
        """Makes the scene, or the system, and the state in which episodes start."""

    @abstractmethod
    def act(self, scene: Any, action: Float[Array, " action"]) -> Any:
        """Returns the scene on which an action acts during one control step.

        Args:
            scene: The scene of `build`, never that of an earlier action.
            action: In [-1, 1], shape (action_size,).
        """

    @abstractmethod
    def observe(self, state: Any, goal: Any) -> Float[Array, " observation"]:
        """Returns the observation vector.

        Args:
            state: State of the scene.
            goal: The goal of the episode.
        """

    @abstractmethod
    def reward(self, state: Any, goal: Any) -> Float[Array, ""]:
        """Returns the reward of a control step.

        Args:
            state: State of the scene after the step.
            goal: The goal of the episode, as it has moved since.
        """

    def goal(self, key: Key[Array, ""]) -> Any:
        """Draws the goal of an episode: any pytree of arrays. By default it is empty.

        Args:
            key: Random key of the episode.
        """
        del key
        return ()

    def moved_goal(self, goal: Any) -> Any:
        """Returns the goal one control period later. By default it stays.

        Args:
            goal: The goal at the start of the control step. If it moves at random, it
                may hold a random key.
        """
        return goal

    def ended(self, state: Any, goal: Any) -> Bool[Array, ""]:
        """Whether the task has ended, by success or failure. By default it never does.

        Args:
            state: State of the scene after the step.
            goal: The goal of the episode.
        """
        del state, goal
        return jnp.zeros((), bool)

    def spheres(self, state: Any, goal: Any) -> Sequence[tuple[Point, Number]]:
        """Spheres to draw, each with its centre and radius [m]. By default none.

        Args:
            state: State of the scene.
            goal: The goal of the episode.
        """
        del state, goal
        return ()

    @property
    def name(self) -> str:
        """Name for display: the class's name in lower case."""
        return type(self).__name__.lower()

    @property
    def observation_size(self) -> int:
        """Length of the vector that `observe` returns.

        Raises:
            ValueError: `observe` returns something other than a vector, or a method
                asks for something that does not exist.
        """
        try:
            return _observation_size(self)
        except AttributeError as error:  # hasattr would take it for a missing size
            raise ValueError(
                f"{self.name} has no first observation: {error}"
            ) from error

    @property
    def substeps(self) -> int:
        """Number of time steps in a control step.

        Raises:
            ValueError: `control_period` is not a whole multiple of `dt`.
        """
        period, dt = self.control_period, self.dt
        if not 0 < dt < math.inf:
            raise ValueError(f"dt of {self.name} must be above 0, got {dt!r} s")
        count = round(period / dt) if 0 < period < math.inf else 0
        if count < 1 or not math.isclose(count * dt, period, rel_tol=1e-6):
            raise ValueError(
                f"control_period of {self.name} must be a whole multiple of dt, "
                f"got {period!r} s and {dt!r} s"
            )
        return count

    def default_params(self) -> SceneTaskParams:
        """The scene of `build`, and its state with the memory of all effects.

        Raises:
            ValueError: `build` returns something other than a scene and a state.
        """
        made: Any = self.build()
        try:
            scene, start = made
        except (TypeError, ValueError):
            raise ValueError(
                f"build of {self.name} must return a scene and its state, "
                f"got {type(made).__name__}"
            ) from None
        acting: Any = self.act(scene, jnp.zeros(self.action_size))
        return SceneTaskParams(scene, acting.with_memory(start))

    def reset(
        self, key: Key[Array, ""], params: SceneTaskParams
    ) -> tuple[Float[Array, " observation"], SceneTaskState]:
        """Starts an episode: draws its goal.

        Args:
            key: Typed random key.
            params: Traced parameters.
        """
        check_key(key)
        state = SceneTaskState(params.start, self.goal(key))
        return self.observe(state.body, state.goal), state

    def step(
        self,
        key: Key[Array, ""],
        state: SceneTaskState,
        action: Float[Array, " action"],
        params: SceneTaskParams,
    ) -> Step:
        """Advances one control step, during which the action is constant.

        Args:
            key: Not used: steps are not random.
            state: State from `reset` or from the step before.
            action: In [-1, 1], shape (action_size,).
            params: Traced parameters.
        """
        del key
        scene = self.act(params.scene, action_of_size(action, self.action_size))
        body = advance(scene, state.body, self.dt, self.substeps)
        goal = self.moved_goal(state.goal)
        flagged = health(
            scene, body, self.dt, limits=self.limits, before=state.body
        ).flagged
        body = freeze(flagged, state.body, body)
        return (
            self.observe(body, goal),
            SceneTaskState(body, goal),
            self.reward(body, goal),
            self.ended(body, goal),
            flagged,
            {"flagged": flagged},
        )

    def predict(
        self,
        state: SceneTaskState,
        action: Float[Array, " action"],
        params: SceneTaskParams,
        control_steps: int = 1,
    ) -> SceneTaskState:
        """Predicts the state under one action, for planners.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Traced parameters.
            control_steps: Number of control steps for which the action is held.
        """
        scene = self.act(params.scene, action)
        body = advance(scene, state.body, self.dt, control_steps * self.substeps)
        goal = state.goal
        for _ in range(control_steps):
            goal = self.moved_goal(goal)
        return SceneTaskState(body, goal)

    def cost(
        self,
        state: SceneTaskState,
        action: Float[Array, " action"],
        params: SceneTaskParams,
    ) -> Float[Array, ""]:
        """Cost for planners: the negative reward.

        Args:
            state: State after the control step.
            action: Action of that step; not used.
            params: Traced parameters; not used.
        """
        del action, params
        return -self.reward(state.body, state.goal)

    def snapshot(self, state: SceneTaskState, params: SceneTaskParams) -> Snapshot:
        """Snapshot of the spheres, and of the rods, which must have the same size.

        Args:
            state: Current state.
            params: Traced parameters.

        Raises:
            ValueError: Rods of the system differ in their numbers of elements.
        """
        states = params.scene.states_by_name(state.body)
        rods = [
            (states[name].positions, member.rod.radii)
            for name, member in params.scene.interfaces().items()
            if member.rod is not None
        ]
        sizes = sorted({places.shape[-1] - 1 for places, _ in rods})
        if len(sizes) != 1:
            raise ValueError(
                f"{self.name} must define snapshot(state, params) to be drawn, because "
                f"its rods have different numbers of elements: {sizes}"
            )
        spheres = tuple(self.spheres(state.body, state.goal))
        if len(rods) == 1:
            return Snapshot(*rods[0], spheres=spheres)
        (n,) = sizes
        stacked = [
            (
                jnp.reshape(places, (-1, 3, n + 1)),
                jnp.reshape(jnp.broadcast_to(radii, (*places.shape[:-2], n)), (-1, n)),
            )
            for places, radii in rods
        ]
        positions, radii = map(jnp.concatenate, zip(*stacked, strict=True))
        return Snapshot(positions, radii, spheres=spheres)


@functools.lru_cache(maxsize=128)
def _observation_size(env: SceneTask) -> int:
    """Length of a task's observation, found by tracing `reset`."""
    with jax.ensure_compile_time_eval():  # scenes choose numbers from known values
        params = env.default_params()
    seen, _ = jax.eval_shape(lambda: env.reset(jax.random.key(0), params))
    shape = getattr(seen, "shape", None)
    if shape is None or len(shape) != 1:
        got = type(seen).__name__ if shape is None else f"an array of shape {shape}"
        raise ValueError(f"observe of {env.name} must return a vector, got {got}")
    return int(shape[0])
