"""The arm of the `clean` variants: the library's own physics.

It has elastic loads from a stored energy (`jaxrod.consistent`), a clamp with a
second-order error (`jaxrod.clamp`), damping integrated exactly, and couples per metre
instead of per element, with the same sum as the published couples. When a numerical
health flag rises the arm is frozen at its last sound state. Its energy is not checked:
the check costs more than half a control step, and it raises no flag on sound arms
(`tests/envs/test_energy.py`).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod import (
    HealthLimits,
    Rod,
    RodState,
    Scene,
    advance,
    clamp,
    consistent,
    freeze,
    health,
    near_contact,
    planar,
)
from jaxrod.actuation import ControlSpline, ElementAverages, limit_rate, spline_couples
from jaxrod.contacts.contact import Contact
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.loads import ExponentialDamping
from jaxrod.envs.arm.soft_arm import (
    CONTROL_PERIOD,
    LENGTH,
    TORQUE_PER_ELEMENT,
    VISCOSITY,
    clean_rod,
)
from jaxrod.extend import Effect, Method
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.structure import pytree, static


@pytree
class CleanArm:
    """Parameters of the arm and of everything that acts on it."""

    rod: Rod
    """Geometry and material of the arm."""
    rest: RodState
    """State of the arm at the start of an episode."""
    held: Clamp
    """Clamp of the arm's base at the wall."""
    viscosity: Float[Array, ""]
    """Viscous force per length and speed [kg/(m s)]; the same number is the couple per
    length and angular velocity [kg m/s]."""
    spline: ElementAverages
    """Spline through the control points, averaged over the arm's elements."""
    couple_density: Float[Array, ""]
    """Couple per length for a control value of one [N m/m]."""
    largest_change: Float[Array, ""] | None
    """Largest change of a control value from one control step to the next [1]; `None`
    if control values jump to the commanded ones."""
    obstacles: tuple[Contact, ...] = ()
    """Contact effects, each with one or more obstacles."""
    limits: HealthLimits = dataclasses.field(default_factory=HealthLimits)
    """Health limits beyond which the arm is frozen."""
    method: Method = dataclasses.field(default_factory=consistent)
    """Stepping method, restricted to the plane of motion if any."""
    nearest: int | None = static(default=None)
    """Number of nearest obstacles that each contact point considers in a control step;
    `None` for all."""

    def relaxed(self) -> Array | None:
        """Control values as an episode begins, all zero; None without a rate limit."""
        if self.largest_change is None:
            return None
        return jnp.zeros((3, self.spline.n_controls), self.rod.radii.dtype)

    def advance(
        self,
        state: RodState,
        muscles: Array | None,
        controls: Float[Array, "3 n_controls"],
        dt: Array,
        n_steps: int,
    ) -> tuple[RodState, Array | None, Bool[Array, ""]]:
        """Advances the arm by simulation steps under one action.

        Args:
            state: State of the arm.
            muscles: Control values of the previous control step; None without a rate
                limit.
            controls: Commanded control values about d1, d2 and d3 [1].
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The state of the arm, the control values, and whether a health flag rose; if
            so, the state is unchanged.
        """
        if self.largest_change is not None and muscles is not None:
            muscles = controls = limit_rate(muscles, controls, self.largest_change)
        scene = self.scene(controls, state)
        after = advance(scene, state, dt, n_steps)
        flagged = health(scene, after, dt, limits=self.limits).flagged
        return freeze(flagged, state, after), muscles, flagged

    def scene(
        self,
        controls: Float[Array, "3 n_controls"] | None = None,
        near: RodState | None = None,
    ) -> Scene:
        """Scene of the arm under given control values.

        Args:
            controls: Control values [1]; `None` for the arm without its muscles.
            near: State from which the arm is about to move. Each contact point then
                considers only the `nearest` obstacles in this state; `None` for all.
        """
        obstacles = self.obstacles
        if near is not None and self.nearest is not None:
            obstacles = tuple(
                near_contact(touch, self.rod, near, self.nearest) for touch in obstacles
            )
        muscles: tuple[Effect, ...] = ()
        if controls is not None:
            muscles = (
                spline_couples(self.rod, self.spline, controls, self.couple_density),
            )
        # The published drag as decay rates, per rest length, equal about all axes.
        damping = ExponentialDamping(
            translational_rate=self.viscosity / jnp.mean(self.rod.linear_density),
            rotational_rate=self.viscosity / jnp.mean(self.rod.rotary_inertia[0]),
        )
        effects = (self.held, damping, *muscles, *obstacles)
        return Scene(self.rod, effects, self.method)


def clean_arm(
    n_elements: int,
    start: tuple[float, float, float],
    axis: str,
    spline: ControlSpline,
    *,
    published_elements: int,
    largest_rate: float | None = None,
    obstacles: tuple[Contact, ...] = (),
    nearest: int | None = None,
    smallest_stretch: float = 0.3,
    largest_stretch: float = 2.5,
    plane: PlaneName | None = None,
) -> CleanArm:
    """Makes the arm of the `clean` variants, straight and at rest.

    Args:
        n_elements: Number of elements.
        start: Position of the clamped end [m].
        axis: Axis along the arm: "y" (Cases 1, 2) or "z" (Cases 3, 4).
        spline: Spline through the control points, in rest arc length.
        published_elements: Number of elements of the published arm, each with a couple
            of 75 N m; the sum of these couples is spread over the length.
        largest_rate: Largest rate of a control value [1/s]; None for no limit.
        obstacles: Contact effects of the obstacles.
        nearest: Number of nearest obstacles that each contact point considers in a
            control step; None for all.
        smallest_stretch: Stretch below which an arm is flagged [1].
        largest_stretch: Stretch above which an arm is flagged [1].
        plane: Plane of motion, if any.
    """
    rod, rest = clean_rod(n_elements, start, axis)

    def number(value: float) -> Array:
        return jnp.asarray(value, rod.radii.dtype)

    return CleanArm(
        rod=rod,
        rest=rest,
        held=clamp(rest),
        viscosity=number(VISCOSITY),
        spline=spline.averaged(rod),
        couple_density=number(TORQUE_PER_ELEMENT * published_elements / LENGTH),
        largest_change=(
            None if largest_rate is None else number(largest_rate * CONTROL_PERIOD)
        ),
        obstacles=obstacles,
        limits=jax.tree.map(
            number,
            HealthLimits(
                smallest_stretch=smallest_stretch, largest_stretch=largest_stretch
            ),
        ),
        method=consistent() if plane is None else planar(plane),
        nearest=nearest,
    )
