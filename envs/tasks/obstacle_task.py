r"""Common parts of Cases 3 and 4 of the benchmark: a fixed target behind obstacles.

At rest the arm extends along +z from (0, 0.5, 0) m. Couples are set at two or a few
control points per direction, whose values change by at most 100 per second. Actions are
renewed every 1.4 ms, 3571 times (5 s). Reward per control step, at distance $d$ of the
tip from the target: $-d^2$, plus 0.5 within 10 cm, plus 1.5 more within 5 cm. Eleven
points of the arm, the tip's velocity, the target, and five points of every obstacle are
observed.
"""

from __future__ import annotations

import dataclasses
import functools
from abc import abstractmethod
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxrod import contact
from jaxrod.actuation import control_spline
from jaxrod.contacts.bodies import Body
from jaxrod.envs.arm.clean import clean_arm
from jaxrod.envs.arm.cylinders import OBSERVED_POINTS, Cylinders, points_along
from jaxrod.envs.arm.published import published_arm
from jaxrod.envs.arm.soft_arm import CONTROL_PERIOD, LENGTH
from jaxrod.envs.protocol import Channel, Snapshot
from jaxrod.envs.tasks.arm_task import (
    OBSERVED_NODES,
    Arm,
    ArmParams,
    ArmState,
    BenchmarkTask,
    Variant,
)
from jaxrod.structure import pytree

PUBLISHED_ELEMENTS = 50
SIZES: dict[Variant, tuple[int, int]] = {
    "paper": (PUBLISHED_ELEMENTS, 14),
    "clean": (40, 13),
}
"""Default numbers of elements, and of simulation steps per control step.

"clean" has more elements than accuracy requires (docs/clean_settings.md), so that
nothing passes between two nodes of an arm that the strongest actions stretch.
"""
CONTROL_STEPS = 3571
PLACED = (0.4, 0.9)
"""Arc lengths of the paper's two control points, divided by the arm's length [1]."""
STIFFNESS = 2e8
"""Stiffness of contact in the variant "clean" [N/m^2]. The strongest actions stretch
the arm twofold, to a tension of 100 kN. Pulled over a cylinder, the arm presses on it
with 1 MN/m, as in an impact at 100 m/s. The overlap is then half a centimetre to 2 cm,
less than the arm's radius of 5 cm. With half the stiffness, one arm of ten thousand was
pulled into a cylinder beyond its centreline (`benchmarks/extremes`)."""
FREE_ENDS = (0.0, 0.0)
"""Flags of the arm's two ends in the variant "clean": 0 means without a face in
contact, see `jaxrod.contacts.ends`. A face would have the stiffness of 10 cm of arm, on
a tip with the mass of 1.25 cm of arm. It would require 44 steps per control step in the
maze and 51 in the nest. Without a face the tip is no stiffer for its mass than the
rest."""
SMALLEST_STRETCH = 0.15
LARGEST_STRETCH = 3.0
"""Largest element stretch in the variant "clean" before the arm is flagged [1].
Saturated actions stretch elements to 2.5, and impacts on a cylinder compress them below
0.3. For stretches from 0.15 to 3 the time step is far below the stability bound of a
free arm, and below the bound with contact at every obstacle that a point considers."""
DAMPING = 4e3
"""Damping of contact in the variant "clean": a twentieth of critical damping [kg/(m
s)]."""


@pytree
class FixedTarget:
    """Target sphere that does not move."""

    position: Float[Array, "3"]
    """Centre of the sphere [m]."""
    radius: Float[Array, ""]
    """Radius with which the sphere is drawn [m]."""


@pytree
class ObstacleParams(ArmParams):
    """Parameters of Cases 3 and 4; every number is a traced leaf."""

    shown: Float[Array, " 15m"]
    """Observed points of the m obstacles, five of each, as x, y, z [m]."""


@dataclasses.dataclass(frozen=True)
class ObstacleTask(BenchmarkTask):
    """Base class of Cases 3 and 4: the tip reaches a fixed target behind obstacles."""

    variant: Variant
    n_elements: int
    substeps: int
    episode_length: int

    base = (0.0, 0.5, 0.0)
    axis = "z"
    largest_rate = 100.0
    crash_reward = -100.0
    name: ClassVar[str]
    """Name of the task, as in the registry."""
    n_obstacles: ClassVar[int]
    """Number of cylinders."""
    target_position: ClassVar[tuple[float, float, float]]
    """Position of the target [m]."""
    contact_points: ClassVar[int]
    """Number of contact points per element of the arm, in the variant "clean"."""
    nearest_obstacles: ClassVar[int | None]
    """Number of nearest obstacles that each contact point considers in a control step,
    in the variant "clean"; `None` for all."""

    @abstractmethod
    def obstacles(self) -> Cylinders:
        """Makes the cylinders that are the obstacles."""

    @abstractmethod
    def bodies(self, obstacles: Cylinders) -> Body:
        """Converts the cylinders to bodies for `jaxrod.contact`, in variant "clean"."""

    @abstractmethod
    def observed_starts(self, obstacles: Cylinders) -> Float[Array, "3 m"]:
        """Point at which each cylinder's observed points begin [m].

        The five points are equidistant from there, along the cylinder's direction and
        over its length.
        """

    @property
    def observation_size(self) -> int:
        """Length of the observation: 40, and 15 for the points of each obstacle."""
        return 3 * OBSERVED_NODES + 4 + 3 + 3 * OBSERVED_POINTS * self.n_obstacles

    def arm(self) -> Arm:
        """Makes the arm, at rest, with everything that acts on it and the obstacles."""
        obstacles = self.obstacles()
        spline = control_spline(self.control_points(), LENGTH)
        if self.variant == "paper":
            return published_arm(
                self.n_elements,
                self.base,
                self.axis,
                spline,
                largest_change=self.largest_rate * (CONTROL_PERIOD / self.substeps),
                obstacles=obstacles,
                plane=self.plane,
            )
        touch = contact(
            self.bodies(obstacles),
            stiffness=STIFFNESS,
            damping=DAMPING,
            points_per_element=self.contact_points,
        ).with_free_ends(jnp.asarray(FREE_ENDS))
        return clean_arm(
            self.n_elements,
            self.base,
            self.axis,
            spline,
            published_elements=PUBLISHED_ELEMENTS,
            largest_rate=self.largest_rate,
            obstacles=(touch,),
            nearest=self.nearest_obstacles,
            smallest_stretch=SMALLEST_STRETCH,
            largest_stretch=LARGEST_STRETCH,
            plane=self.plane,
        )

    def default_params(self) -> ObstacleParams:
        """Default parameters of the task, in JAX's default precision."""
        arm, obstacles = self.arm(), self.obstacles()
        number = functools.partial(jnp.asarray, dtype=arm.rod.radii.dtype)
        return ObstacleParams(
            **self.common_params(arm),
            target=FixedTarget(number(self.target_position), number(0.05)),
            shown=points_along(self.observed_starts(obstacles), obstacles),
        )

    def first_target(self, key: Key[Array, ""], params: Any) -> FixedTarget:
        """State of the fixed target, the same in all episodes; `key` is not used."""
        return params.target

    def ended(
        self,
        observation: Float[Array, " observation"],
        crashed: Bool[Array, ""],
        before: ArmState,
        params: Any,
    ) -> tuple[Float[Array, " observation"], Bool[Array, ""]]:
        """Observation to return in the variant "paper", and whether the episode ends.

        The episode ends if a number of the observation is not finite. The number is
        replaced by its value in the state `before` the step.
        """
        finite = jnp.isfinite(observation)
        shown = jnp.where(finite, observation, self.observe(before, params))
        return shown, ~jnp.all(finite)

    def seen(self, state: ArmState, params: Any) -> tuple[Array, ...]:
        """Observed position of the target, then the points of the obstacles."""
        return state.target.position, params.shown

    @property
    def seen_channels(self) -> tuple[Channel, ...]:
        """Size, name and unit of each group of entries that `seen` returns."""
        points = f"{OBSERVED_POINTS} points along each obstacle, start first: x, y, z"
        return (
            Channel(3, "position of the target: x, y, z", "m"),
            Channel(3 * OBSERVED_POINTS * self.n_obstacles, points, "m"),
        )

    def snapshot(self, state: ArmState, params: Any) -> Snapshot:
        """Snapshot of the arm, the target and the obstacles."""
        obstacles = self.obstacles()
        starts, ends = obstacles.starts.T, obstacles.ends.T
        return dataclasses.replace(
            super().snapshot(state, params),
            cylinders=tuple(zip(starts, ends, obstacles.radii, strict=True)),
        )
