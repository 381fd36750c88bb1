r"""Tasks in which the tip of a soft arm goes to a target, such as `tracking`.

`ArmTask` is their base class: a step, a reward by the distance of the tip from the
target, a smooth cost for planners, and a snapshot. `BenchmarkTask` adds the published
benchmark's arm. A few control values set the couples along it every 1.4 ms. Each
subclass defines the target and the observation.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import Rod, RodState, freeze
from jaxrod.actuation import control_spline
from jaxrod.envs.arm.clean import clean_arm
from jaxrod.envs.arm.published import published_arm
from jaxrod.envs.arm.soft_arm import CONTROL_PERIOD, LENGTH, REFERENCE_ELEMENTS
from jaxrod.envs.checking import action_of_size, check_key, check_variant
from jaxrod.envs.protocol import Channel, Snapshot, Step
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, check_count

Variant = Literal["paper", "clean"]

OBSERVED_NODES = 11
"""Number of observed nodes of the arm, equidistant, including base and tip."""
TIP = tuple(OBSERVED_NODES * (axis + 1) - 1 for axis in range(3))
"""Entries of the observation that are the position of the tip: x, y, z."""
COST_WIDTH = 0.1
"""Distance from the target beyond which a planner's cost grows linearly [m]."""


@pytree
class Bonus:
    """Largest distances from the target at which the reward has its two bonuses."""

    near: Float[Array, ""]
    """Largest distance at which the reward has the first bonus, 0.5 [m]."""
    touching: Float[Array, ""]
    """Largest distance at which the reward also has the second bonus, 1.5 [m]."""


class ArmTask(ABC):
    """Base class of tasks in which an arm's tip goes to a target.

    Subclasses are frozen dataclasses. Their states have the fields `arm`, `target`
    (with a `position`) and `steps`. Their parameters have `arm`, `dt`, `target`,
    `bonus` and, with a variant "paper", `crash_reward`.
    """

    variant: str
    """Variant of the physics: "paper" (as published) or "clean" (this library's)."""
    n_elements: int
    """Number of elements of the arm."""
    substeps: int
    """Number of simulation steps per control step."""
    episode_length: int
    """Number of control steps per episode."""

    control_period: ClassVar[float] = CONTROL_PERIOD
    """Time between actions [s]."""

    @property
    @abstractmethod
    def action_size(self) -> int:
        """Length of the action vector."""

    @abstractmethod
    def moved(
        self,
        key: Key[Array, ""] | None,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> tuple[Any, Bool[Array, ""]]:
        """Returns the state one control step later, and whether the arm crashed.

        In the variant "paper" an arm crashes when its state is not finite, in the
        variant "clean" when a health flag rises.

        Args:
            key: Random key of the step; `None` for a step without random events.
            state: Current state.
            action: In [-1, 1].
            params: Parameters of the task.
        """

    @abstractmethod
    def observe(self, state: Any, params: Any) -> Float[Array, " observation"]:
        """Observation vector; the module of the task lists its entries."""

    def step(
        self,
        key: Key[Array, ""],
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> Step:
        """Advances one control step: moves arm and target, then rewards the state."""
        before = state
        state, crashed = self.moved(key, state, action, params)
        observation = self.observe(state, params)
        reward = self.reward(state, params)
        timeout = state.steps >= self.episode_length
        if self.variant == "paper":
            observation, crashed = self.ended(observation, crashed, before, params)
            reward = jnp.where(crashed, params.crash_reward, reward)
            terminated, truncated = crashed, timeout
        else:
            terminated, truncated = jnp.zeros((), bool), timeout | crashed
        # A crashed arm has no valid distance, and zero would be the best one.
        sound = freeze(crashed, before.arm, state.arm)
        info = self.scalars(sound, state.target) | {"flagged": crashed}
        return observation, state, reward, terminated, truncated, info

    def ended(
        self,
        observation: Float[Array, " observation"],
        crashed: Bool[Array, ""],
        before: Any,
        params: Any,
    ) -> tuple[Float[Array, " observation"], Bool[Array, ""]]:
        """Observation to return in the variant "paper", and whether the episode ends.

        By default a crash terminates the episode, and the observation is then zero.

        Args:
            observation: Observation after the step.
            crashed: Whether the arm crashed in the step.
            before: State before the step.
            params: Parameters of the task.
        """
        del before, params
        return jnp.where(crashed, 0, observation), crashed

    def reward(self, state: Any, params: Any) -> Float[Array, ""]:
        """Reward of a state whose arm has not crashed: -d^2 plus bonuses.

        d is the distance of the tip from the target; see `distance_reward`.
        """
        return distance_reward(squared_distance(state), params.bonus)

    def scalars(self, arm: RodState, target: Any) -> dict[str, Array]:
        """Scalars of a step's `info`: distance of the tip from the target [m].

        Args:
            arm: State of the arm; after a crash, the last one before it.
            target: State of the target.
        """
        squared = jnp.sum((arm.tip - target.position) ** 2)
        return {"distance": jnp.sqrt(jnp.maximum(squared, 1e-12))}

    def predict(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        control_steps: int = 1,
    ) -> Any:
        """Predicts the state under one action, without random events.

        A target keeps its heading. As long as no random event occurs, this equals
        `step`.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Parameters of the task.
            control_steps: Number of control steps for which the action is held.
        """

        def again(state: Any, _: None) -> tuple[Any, None]:
            return self.moved(None, state, action, params)[0], None

        return jax.lax.scan(again, state, length=control_steps)[0]

    def residuals(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        width: float = COST_WIDTH,
    ) -> Float[Array, " residuals"]:
        """Residuals whose squares sum to the planners' cost; see `tip_residuals`.

        `width` is the distance beyond which the cost grows linearly [m].
        """
        del action
        return tip_residuals(
            state.arm.tip - state.target.position, params.bonus.touching, width
        )

    def cost(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        width: float = COST_WIDTH,
    ) -> Float[Array, ""]:
        """Smooth cost of a state for planners: sum of the squared residuals [1].

        It is smallest where the reward is largest.

        Args:
            state: State after the control step.
            action: Action of that step.
            params: Parameters of the task.
            width: Distance from the target beyond which the cost grows linearly [m].
        """
        return jnp.sum(self.residuals(state, action, params, width) ** 2)

    def snapshot(self, state: Any, params: Any) -> Snapshot:
        """Snapshot of arm and target, with the tip-to-target distance as a readout."""
        tip, target = state.arm.tip, state.target.position
        distance = jnp.sqrt(jnp.sum((tip - target) ** 2))
        return Snapshot(
            positions=state.arm.positions,
            radii=params.arm.rod.radii,
            spheres=((target, params.target.radius),),
            readouts={"distance to target [m]": distance},
            up="y",
        )


class Arm(Protocol):
    """Interface between an arm and its task, for both variants."""

    @property
    def rod(self) -> Rod:
        """Geometry and material of the arm."""

    @property
    def rest(self) -> RodState:
        """State of the arm at the start of an episode."""

    def relaxed(self) -> Any:
        """State of the muscles at the start of an episode, as `advance` takes it."""

    def advance(
        self,
        state: RodState,
        muscles: Any,
        controls: Float[Array, "3 n_controls"],
        dt: Array,
        n_steps: int,
    ) -> tuple[RodState, Any, Bool[Array, ""]]:
        """Advances the arm by simulation steps under one action.

        Args:
            state: State of the arm.
            muscles: State of the muscles.
            controls: Commanded control values about d1, d2 and d3 [1].
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The states of arm and muscles, and whether the arm crashed.
        """


@pytree
class ArmParams:
    """Parameters of a task of the benchmark's arm; every number is a traced leaf."""

    arm: Arm
    """Parameters of the arm and of everything that acts on it, obstacles included."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    target: Any
    """Parameters of the target; their type depends on the task."""
    bonus: Bonus
    """Distances from the target at which the reward has its bonuses."""
    crash_reward: Float[Array, ""]
    """Reward of a step in which the arm crashes, in the variant "paper"."""


@pytree
class ArmState:
    """State of a task of the benchmark's arm."""

    arm: RodState
    """State of the arm."""
    muscles: Any
    """State of the muscles; its type depends on the variant."""
    target: Any
    """State of the target, with a `position`; its type depends on the task."""
    steps: Int[Array, ""]
    """Control steps since reset."""


class BenchmarkTask(ArmTask):
    """Base class of the benchmark's four cases: an arm under couples along its length.

    Actions set the couples every 1.4 ms. Observed are eleven points of the arm, the
    velocity of its tip, and then the numbers that `seen` returns.
    """

    base: ClassVar[tuple[float, float, float]] = (0.0, 0.0, 0.0)
    """Position of the clamped end [m]."""
    axis: ClassVar[str] = "y"
    """World axis along the arm at rest, "y" or "z"."""
    plane: ClassVar[PlaneName | None] = None
    """Plane to which the motion is restricted, such as "zx"; None for none."""
    n_directions: ClassVar[int]
    """Number of directions of couples: 1 (about d1), 2 (d1, d2) or 3 (and twist)."""
    largest_rate: ClassVar[float | None] = None
    """Largest rate of a control value [1/s]; `None` if control values may jump."""
    crash_reward: ClassVar[float]
    """Reward of a step in which the arm crashes, in the variant "paper"."""

    @property
    @abstractmethod
    def n_controls(self) -> int:
        """Number of control points along the arm, per direction."""

    def control_points(self) -> int | Numbers:
        """Number of equidistant control points, or their arc lengths [m]."""
        return self.n_controls

    @abstractmethod
    def first_target(self, key: Key[Array, ""], params: Any) -> Any:
        """State of the target at the start of an episode."""

    @abstractmethod
    def seen(self, state: ArmState, params: Any) -> tuple[Array, ...]:
        """Vectors to append to the observed points and velocity of the arm."""

    @property
    @abstractmethod
    def seen_channels(self) -> tuple[Channel, ...]:
        """Size, name and unit of each group of entries that `seen` returns."""

    @property
    def observation_channels(self) -> tuple[Channel, ...]:
        """Size, name and unit of each group of entries of the observation."""
        return (
            Channel(
                3 * OBSERVED_NODES,
                "points of the arm, base to tip: x of each, then y, then z",
                "m",
            ),
            *speed_channels("the tip"),
            *self.seen_channels,
        )

    @property
    def action_channels(self) -> tuple[Channel, ...]:
        """Size, name and unit of each group of entries of the action."""
        return tuple(
            Channel(self.n_controls, f"control values about {axis}, base to tip", "1")
            for axis in ("d1", "d2", "d3")[: self.n_directions]
        )

    @property
    def action_size(self) -> int:
        """Number of control values: about d1, then d2, then d3 if the task has them."""
        return self.n_directions * self.n_controls

    def arm(self) -> Arm:
        """Makes the arm, at rest, with everything that acts on it."""
        spline = control_spline(self.control_points(), LENGTH)
        if self.variant == "paper":
            return published_arm(self.n_elements, self.base, self.axis, spline)
        return clean_arm(
            self.n_elements,
            self.base,
            self.axis,
            spline,
            published_elements=REFERENCE_ELEMENTS,
        )

    def common_params(self, arm: Arm) -> dict[str, Any]:
        """Fields of `ArmParams` except `target`, in JAX's default precision."""
        number = functools.partial(jnp.asarray, dtype=arm.rod.radii.dtype)
        return {
            "arm": arm,
            "dt": number(CONTROL_PERIOD / self.substeps),
            "bonus": Bonus(near=number(0.10), touching=number(0.05)),
            "crash_reward": number(self.crash_reward),
        }

    def reset(
        self, key: Key[Array, ""], params: Any
    ) -> tuple[Float[Array, " observation"], ArmState]:
        """Starts an episode with the arm straight and at rest."""
        check_key(key)
        state = ArmState(
            arm=params.arm.rest,
            muscles=params.arm.relaxed(),
            target=self.first_target(key, params),
            steps=jnp.zeros((), jnp.int32),
        )
        return self.observe(state, params), state

    def moved(
        self,
        key: Key[Array, ""] | None,
        state: ArmState,
        action: Float[Array, " action"],
        params: Any,
        control_steps: int = 1,
    ) -> tuple[ArmState, Bool[Array, ""]]:
        """Moves the arm for control steps under one action, but not the target.

        Returns:
            The state, and whether the arm crashed.
        """
        action = action_of_size(action, self.action_size)
        values = jnp.reshape(action, (self.n_directions, self.n_controls))
        controls = jnp.pad(values, ((0, 3 - self.n_directions), (0, 0)))
        arm, muscles, crashed = params.arm.advance(
            state.arm, state.muscles, controls, params.dt, control_steps * self.substeps
        )
        steps = state.steps + control_steps
        return ArmState(arm, muscles, state.target, steps), crashed

    def predict(
        self,
        state: ArmState,
        action: Float[Array, " action"],
        params: Any,
        control_steps: int = 1,
    ) -> ArmState:
        """Predicts the state under one action, see `ArmTask.predict`."""
        if self.largest_rate is None:
            return self.moved(None, state, action, params, control_steps)[0]
        # One step at a time, because control values follow the action in every step,
        # and every step selects the nearest obstacles again.
        return super().predict(state, action, params, control_steps)

    def observe(self, state: ArmState, params: Any) -> Float[Array, " observation"]:
        """Observation: points of the arm, velocity of its tip, then `seen`."""
        return jnp.concatenate(
            [
                observed_points(state.arm),
                speed_and_direction(state.arm.velocities[:, -1]),
                *self.seen(state, params),
            ]
        )


def squared_distance(state: Any) -> Float[Array, ""]:
    """Squared distance of the tip from the target [m^2]."""
    return jnp.sum((state.arm.tip - state.target.position) ** 2)


def distance_reward(distance_squared: Array, bonus: Bonus) -> Array:
    """Reward: -distance^2 + 0.5 (distance <= near) + 1.5 (distance <= touching).

    Args:
        distance_squared: Squared distance of the tip from the target [m^2].
        bonus: The distances `near` and `touching`.
    """
    return (
        -distance_squared
        + 0.5 * (distance_squared <= bonus.near**2)
        + 1.5 * (distance_squared <= bonus.touching**2)
    )


def tip_residuals(
    way: Float[Array, "3"], touching: float | Array, width: float | Array
) -> Float[Array, "3"]:
    r"""Residuals along the offset of the tip; their squares sum to the cost [1].

    With $s = |way|/width$ the cost is $2\,(width/touching)^2\,(\sqrt{1 + s^2} - 1)$.
    This is about $(|way|/touching)^2$ near the target and linear far away, with a
    nonzero slope everywhere except at the target. The reward's bonuses are steps, which
    have no slope.

    Args:
        way: Vector from the target to the tip [m].
        touching: Distance that costs about one [m].
        width: Distance beyond which the cost grows linearly [m].
    """
    root = jnp.sqrt(1 + jnp.sum(way**2) / width**2)
    # (root - 1) / s^2 without the cancellation between nearly equal numbers.
    return way / touching * jnp.sqrt(2 / (1 + root))


def observed_points(arm: RodState) -> Float[Array, "33"]:
    """Positions of eleven equidistant nodes: all x, then all y, then all z [m]."""
    n_elements = arm.positions.shape[-1] - 1
    return jnp.ravel(arm.positions[:, :: n_elements // (OBSERVED_NODES - 1)])


def speed_and_direction(velocity: Float[Array, "3"]) -> Float[Array, "4"]:
    """Speed [m/s], then the unit vector of a velocity; all zero at rest."""
    squared = jnp.sum(velocity**2)
    moving = squared > 0
    speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1)), 0)
    direction = velocity / jnp.where(moving, speed, 1)
    return jnp.concatenate([speed[None], direction])


def speed_channels(whose: str) -> tuple[Channel, ...]:
    """Channels of `speed_and_direction`; `whose` names the moving point."""
    return (
        Channel(1, f"speed of {whose}", "m/s"),
        Channel(3, f"direction of the velocity of {whose}: x, y, z", "1"),
    )


def checked_sizes(
    variant: str,
    usual: Mapping[Variant, tuple[int, int]],
    n_elements: int | None,
    substeps: int | None,
    episode_length: int,
) -> tuple[int, int]:
    """Validates a task's sizes; returns the numbers of elements and of substeps.

    `usual` contains the defaults of both for each variant. Arms with more elements take
    more substeps by default, since the largest stable step is proportional to the
    element length.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, usual)
    usual_elements, steps = usual["paper" if variant == "paper" else "clean"]
    elements = usual_elements if n_elements is None else n_elements
    check_count("n_elements", elements, OBSERVED_NODES - 1)
    if elements % (OBSERVED_NODES - 1):
        raise ValueError(f"n_elements must be a multiple of 10, got {elements}")
    steps = max(steps, -(-steps * elements // usual_elements))
    steps = steps if substeps is None else substeps
    check_count("substeps", steps, 1)
    check_count("episode_length", episode_length, 1)
    return elements, steps
