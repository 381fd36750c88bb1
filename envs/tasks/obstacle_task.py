r"""Common parts of Cases 3 and 4 of the benchmark: a fixed target past obstacles.

The arm grows along +z from (0, 0.5, 0) m. It is driven through two or a few control
points per direction, whose values change by at most 100 per second. Actions are renewed
every 1.4 ms, 3571 times (5 s). Reward per control step, at distance $d$ of the tip from
the target: $-d^2$, plus 0.5 within 10 cm, plus 1.5 more within 5 cm. Eleven points of
the arm, the tip's velocity, the target, and five points of every obstacle are observed.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod import RodState, contact, control_spline, freeze
from jaxrod.contacts.bodies import Body
from jaxrod.envs.arm.arm_task import (
    CONTROL_PERIOD,
    OBSERVED_NODES,
    Arm,
    Bonus,
    check_sizes,
    check_variant,
    distance_reward,
    observed_points,
    shown_distance,
    speed_and_direction,
)
from jaxrod.envs.arm.clean import clean_arm
from jaxrod.envs.arm.cost import COST_WIDTH, CostOfResiduals, tip_residuals
from jaxrod.envs.arm.cylinders import OBSERVED_POINTS, Cylinders, points_along
from jaxrod.envs.arm.scenery import arm_and_target
from jaxrod.envs.arm.soft_arm import LENGTH
from jaxrod.envs.checking import action_of_size
from jaxrod.envs.protocol import Snapshot
from jaxrod.envs.published.arm import published_arm
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.structure import pytree
from jaxrod.validation import Numbers

Variant = Literal["paper", "clean"]
VARIANTS: tuple[Variant, ...] = ("paper", "clean")

PUBLISHED_ELEMENTS = 50
SIZES: dict[Variant, tuple[int, int]] = {
    "paper": (PUBLISHED_ELEMENTS, 14),
    "clean": (40, 13),
}
"""Default elements and simulation steps per control step.

"clean" has more elements than accuracy requires (docs/clean_settings.md), so that
nothing passes between two nodes of an arm that the strongest actions stretch.
"""
CONTROL_STEPS = 3571
BASE = (0.0, 0.5, 0.0)
AXIS = "z"
LARGEST_RATE = 100.0
"""Largest rate of a control value [1/s]."""
PLACED = (0.4, 0.9)
"""The paper's two control points, in lengths of the arm."""
STIFFNESS = 2e8
"""Stiffness of contact in "clean" [N/m^2]. The strongest actions stretch the arm
twofold, to a tension of 100 kN. Drawn over a cylinder, the arm presses on it with 1
MN/m, as in a first touch at 100 m/s. The overlap is then half a centimetre to 2 cm,
less than the arm's radius of 5 cm. With half the stiffness, one arm of ten thousand was
drawn into a cylinder past its centreline (`benchmarks/extremes`)."""
SMALLEST_STRETCH = 0.15
LARGEST_STRETCH = 3.0
"""Largest element stretch in "clean" before the arm is flagged [1]. Saturated actions
stretch elements to 2.5, and impacts on a cylinder compress them below 0.3. Throughout
0.15 to 3 the time step is far below the stable one of a free arm, and within the bound
that counts every obstacle in view."""
DAMPING = 4e3
"""Damping of contact in "clean": a twentieth of critical [kg/(m s)]."""


@pytree
class FixedTarget:
    """A sphere to reach."""

    position: Float[Array, "3"]
    """Centre [m]."""
    radius: Float[Array, ""]
    """Radius of the sphere to draw [m]."""


@pytree
class ObstacleParams:
    """Numbers of the task; every one is a traced leaf."""

    arm: Arm
    """The arm and everything that acts on it, obstacles included."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    target: FixedTarget
    """Target."""
    shown: Float[Array, " 15m"]
    """Observed points of the obstacles, five of each [m]."""
    bonus: Bonus
    """Distances within which the bonuses are paid."""
    crash_reward: Float[Array, ""]
    """Reward of a step after which an observed number is not finite ("paper")."""


@pytree
class ObstacleState:
    """State of an episode."""

    arm: RodState
    """The arm."""
    muscles: Any
    """Memory of its muscles."""
    target: FixedTarget
    """Target."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class ObstacleTask(CostOfResiduals):
    """Base of the two tasks; see the module docstring."""

    variant: Variant
    n_elements: int
    substeps: int
    episode_length: int

    n_directions: ClassVar[int]
    """Directions of actuation: about d1, or about d1 and d2."""
    n_obstacles: ClassVar[int]
    """Number of cylinders."""
    target_position: ClassVar[tuple[float, float, float]]
    """Position of the target [m]."""
    plane: ClassVar[PlaneName | None]
    """Plane of motion, if any."""
    contact_points: ClassVar[int]
    """Contact points per element ("clean")."""
    nearest_obstacles: ClassVar[int | None]
    """Number of nearest obstacles that each contact point considers in a control step
    ("clean"); `None` for all."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the task, as in the registry."""

    @property
    @abstractmethod
    def n_controls(self) -> int:
        """Number of control points per direction."""

    @abstractmethod
    def control_points(self) -> int | Numbers:
        """Number of control points, or their arc lengths [m]."""

    @abstractmethod
    def obstacles(self) -> Cylinders:
        """The obstacles."""

    @abstractmethod
    def bodies(self, obstacles: Cylinders) -> Body:
        """The obstacles as bodies of the library's contact ("clean")."""

    @abstractmethod
    def observed_starts(self, obstacles: Cylinders) -> Float[Array, "3 m"]:
        """Observed points of the obstacles at the start [m]."""

    @property
    def observation_size(self) -> int:
        """Eleven points, the tip's velocity, the target, five points per obstacle."""
        return 3 * OBSERVED_NODES + 4 + 3 + 3 * OBSERVED_POINTS * self.n_obstacles

    @property
    def action_size(self) -> int:
        """Control values about d1, then about d2 where the task uses it."""
        return self.n_directions * self.n_controls

    @property
    def control_period(self) -> float:
        """Time between actions [s]."""
        return CONTROL_PERIOD

    def default_params(self) -> ObstacleParams:
        """Numbers of the task, in JAX's default precision."""
        obstacles = self.obstacles()
        spline = control_spline(self.control_points(), LENGTH)
        dt = CONTROL_PERIOD / self.substeps
        arm: Arm
        if self.variant == "paper":
            arm = published_arm(
                self.n_elements,
                BASE,
                AXIS,
                spline,
                largest_change=LARGEST_RATE * dt,
                obstacles=obstacles,
                plane=self.plane,
            )
        else:
            touch = contact(
                self.bodies(obstacles),
                stiffness=STIFFNESS,
                damping=DAMPING,
                points_per_element=self.contact_points,
            )
            arm = clean_arm(
                self.n_elements,
                BASE,
                AXIS,
                spline,
                published_elements=PUBLISHED_ELEMENTS,
                largest_rate=LARGEST_RATE,
                obstacles=(touch,),
                nearest=self.nearest_obstacles,
                smallest_stretch=SMALLEST_STRETCH,
                largest_stretch=LARGEST_STRETCH,
                plane=self.plane,
            )

        def numbers(value: float | tuple[float, float, float]) -> Array:
            return jnp.asarray(value, arm.rod.radii.dtype)

        return ObstacleParams(
            arm=arm,
            dt=numbers(dt),
            target=FixedTarget(numbers(self.target_position), numbers(0.05)),
            shown=points_along(self.observed_starts(obstacles), obstacles),
            bonus=Bonus(near=numbers(0.10), touching=numbers(0.05)),
            crash_reward=numbers(-100.0),
        )

    def reset(
        self, key: Key[Array, ""], params: ObstacleParams
    ) -> tuple[Float[Array, " observation"], ObstacleState]:
        """Starts with the arm straight and at rest; nothing is random."""
        state = ObstacleState(
            params.arm.rest,
            params.arm.relaxed(),
            params.target,
            jnp.zeros((), jnp.int32),
        )
        return self.observe(state, params), state

    def step(
        self,
        key: Key[Array, ""],
        state: ObstacleState,
        action: Float[Array, " action"],
        params: ObstacleParams,
    ) -> tuple[
        Float[Array, " observation"],
        ObstacleState,
        Float[Array, ""],
        Bool[Array, ""],
        Bool[Array, ""],
        dict[str, Array],
    ]:
        """Advances one control step: the muscles follow the action for 1.4 ms."""
        before = state
        state, crashed = self._moved(state, action, params)
        arm = state.arm
        observation = self.observe(state, params)
        distance_squared = jnp.sum((arm.tip - state.target.position) ** 2)
        reward = distance_reward(distance_squared, params.bonus)
        timeout = state.steps >= self.episode_length
        if self.variant == "paper":
            finite = jnp.isfinite(observation)
            crashed = ~jnp.all(finite)
            reward = jnp.where(crashed, params.crash_reward, reward)
            observation = jnp.where(finite, observation, self.observe(before, params))
            terminated, truncated = crashed, timeout
        else:
            terminated, truncated = jnp.zeros((), bool), timeout | crashed
        sound = freeze(crashed, before.arm, arm)
        info = {
            "distance": shown_distance(sound, state.target.position),
            "flagged": crashed,
        }
        return observation, state, reward, terminated, truncated, info

    def predict(
        self,
        state: ObstacleState,
        action: Float[Array, " action"],
        params: ObstacleParams,
        control_steps: int = 1,
    ) -> ObstacleState:
        """Predicts the state under one action, exactly as `step`: nothing is random.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Numbers of the task.
            control_steps: Number of control steps for which the action is held.
        """

        def again(state: ObstacleState, _: None) -> tuple[ObstacleState, None]:
            return self._moved(state, action, params)[0], None

        # One step at a time: control values follow the action in every step, and every
        # step selects the obstacles in view again.
        return jax.lax.scan(again, state, length=control_steps)[0]

    def residuals(
        self,
        state: ObstacleState,
        action: Float[Array, " action"],
        params: ObstacleParams,
        width: float = COST_WIDTH,
    ) -> Float[Array, "3"]:
        """Residuals for planners, from the tip's offset; see `tip_residuals`."""
        del action
        return tip_residuals(
            state.arm.tip - state.target.position, params.bonus.touching, width
        )

    def _moved(
        self,
        state: ObstacleState,
        action: Float[Array, " action"],
        params: ObstacleParams,
    ) -> tuple[ObstacleState, Bool[Array, ""]]:
        """Returns the state one control step later, and whether the arm crashed."""
        action = action_of_size(action, self.action_size)
        values = jnp.reshape(action, (self.n_directions, self.n_controls))
        controls = jnp.pad(values, ((0, 3 - self.n_directions), (0, 0)))
        arm, muscles, crashed = params.arm.advance(
            state.arm, state.muscles, controls, params.dt, self.substeps
        )
        return ObstacleState(arm, muscles, state.target, state.steps + 1), crashed

    def snapshot(self, state: ObstacleState, params: ObstacleParams) -> Snapshot:
        """The arm, the target and the obstacles."""
        target, radius = state.target.position, state.target.radius
        return arm_and_target(
            params.arm.rod, state.arm, target, radius, self.obstacles()
        )

    def observe(
        self, state: ObstacleState, params: ObstacleParams
    ) -> Float[Array, " observation"]:
        """Points of the arm, speed and direction of the tip, target, obstacles."""
        return jnp.concatenate(
            [
                observed_points(state.arm),
                speed_and_direction(state.arm.velocities[:, -1]),
                state.target.position,
                params.shown,
            ]
        )


def checked_sizes(
    variant: str, n_elements: int | None, substeps: int | None, episode_length: int
) -> tuple[int, int]:
    """Checked numbers of elements and substeps, by default those of the variant.

    Raises:
        ValueError: If an argument does not fit.
    """
    check_variant(variant, VARIANTS)
    usual = SIZES["paper" if variant == "paper" else "clean"]
    elements = usual[0] if n_elements is None else n_elements
    steps = usual[1] if substeps is None else substeps
    check_sizes(elements, steps, episode_length)
    return elements, steps
