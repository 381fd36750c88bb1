"""The arm of the `paper` variants: the published simulator, driven by its muscles.

It follows PyElastica's law and order of operations, plus three features of its first
release: viscous drag, contact forces that depend on all loads found so far, and muscles
that may change from one simulation step to the next. An arm that cannot leave a plane
moves exactly in that plane.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod import (
    ControlSpline,
    Effect,
    ElementCouples,
    FixedEnd,
    Planar,
    PyElastica,
    Rod,
    RodState,
    Scene,
    advance,
    fixed_end,
    planar,
    pyelastica,
)
from jaxrod.envs.arm.cylinders import Cylinders
from jaxrod.envs.arm.soft_arm import TORQUE_PER_ELEMENT, VISCOSITY, published_rod
from jaxrod.envs.published.contact import PublishedContact
from jaxrod.envs.published.law import ViscousDrag
from jaxrod.envs.published.muscles import MuscleParams, Muscles, contract, relaxed
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.stepping.loops import integrated
from jaxrod.structure import pytree

CONTACT_STIFFNESS = 8e4
CONTACT_DAMPING = 4.0


@pytree
class PublishedArm:
    """Parameters of the published arm and of everything that acts on it."""

    rod: Rod
    """The arm."""
    rest: RodState
    """The arm at the start of an episode."""
    held: FixedEnd
    """Clamp at its base."""
    drag: ViscousDrag
    """Viscous drag of the medium."""
    muscles: MuscleParams
    """Parameters of the muscles."""
    contact: PublishedContact | None
    """Contact with the obstacles; `None` if there are none."""
    method: PyElastica | Planar
    """PyElastica's method, restricted to the plane of motion if there is one."""

    def relaxed(self) -> Muscles:
        """The muscles at the start of an episode."""
        return relaxed(self.rod, self.muscles)

    def advance(
        self,
        state: RodState,
        muscles: Muscles,
        controls: Float[Array, "3 n_controls"],
        dt: Array,
        n_steps: int,
    ) -> tuple[RodState, Muscles, Bool[Array, ""]]:
        """Advances the arm by simulation steps under one action.

        Args:
            state: The arm.
            muscles: Muscles in the step before.
            controls: Commanded values [1] about d1, d2 and d3.
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The arm, the muscles, and whether a node's position is no longer finite.
        """
        stepper = self.method.stepper(self.scene(), state, dt)
        if self.muscles.largest_change is None:
            # Their couples in the first step hold in all steps.
            lengths, new = stepper.begin(state).lengths, jnp.ones((), bool)
            muscles = contract(muscles, controls, lengths, new, self.muscles)
            state = advance(self.scene(muscles.couples), state, dt, n_steps)
            return state, muscles, ~jnp.all(jnp.isfinite(state.positions))

        driven = _DrivenArm(self, stepper, controls)
        state, muscles = integrated(driven, (state, muscles), n_steps - 1)
        return state, muscles, ~jnp.all(jnp.isfinite(state.positions))

    def scene(self, couples: Float[Array, "3 n"] | None = None) -> Scene:
        """Scene of the arm with everything that acts on it.

        Args:
            couples: Couples of the muscles on the elements, material frame [N m];
                `None` for the arm without its muscles.
        """
        effects: tuple[Effect, ...] = (self.held, self.drag)
        if self.contact is not None:
            effects = (*effects, self.contact)
        if couples is not None:
            effects = (*effects, ElementCouples(couples))
        return Scene(self.rod, effects, self.method)


@pytree
class _DrivenArm:
    """The arm with muscles that change in every step; one cycle runs kick to kick."""

    arm: PublishedArm
    stepper: Any
    """Stepper of the arm without its muscles."""
    controls: Float[Array, "3 n_controls"]

    def begin(self, given: tuple[RodState, Muscles]) -> tuple[Any, Muscles, Array]:
        """The first drift; the last entry states that the action is new."""
        state, muscles = given
        return self.stepper.begin(state), muscles, jnp.ones((), bool)

    def cycle(self, carry: tuple[Any, Muscles, Array]) -> tuple[Any, Muscles, Array]:
        """Muscles, kick, and a drift to the next kick."""
        kicked, muscles = self._kicked(carry)
        moved = self.stepper.drift(kicked, self.stepper.dt)
        return moved, muscles, jnp.zeros((), bool)

    def end(self, carry: tuple[Any, Muscles, Array]) -> tuple[RodState, Muscles]:
        """The last kick, and half a drift."""
        kicked, muscles = self._kicked(carry)
        moved = self.stepper.drift(kicked, 0.5 * self.stepper.dt)
        return self.stepper.leave(moved), muscles

    def _kicked(self, carry: tuple[Any, Muscles, Array]) -> tuple[Any, Muscles]:
        motion, muscles, renewed = carry
        muscles = contract(
            muscles, self.controls, motion.lengths, renewed, self.arm.muscles
        )
        driven = replace(self.stepper, scene=self.arm.scene(muscles.couples))
        return driven.kick(motion), muscles


def published_arm(
    n_elements: int,
    start: tuple[float, float, float],
    axis: str,
    spline: ControlSpline,
    *,
    largest_change: float | None = None,
    obstacles: Cylinders | None = None,
    plane: PlaneName | None = None,
) -> PublishedArm:
    """The arm at rest, with the published numbers.

    Args:
        n_elements: Number of elements: 20 in Cases 1 and 2, 50 in Cases 3 and 4.
        start: Position of the clamped end [m].
        axis: Axis along the arm: "y" (Cases 1, 2) or "z" (Cases 3, 4).
        spline: Spline through the control points, in rest arc length.
        largest_change: Largest change of a control value in a simulation step; `None`
            if they jump.
        obstacles: Cylinders that it may touch.
        plane: Plane of motion, if any; obstacles are perpendicular to it.
    """
    rod, rest = published_rod(n_elements, start, axis)

    def number(value: float) -> Array:
        return jnp.asarray(value, rod.radii.dtype)

    contact = None
    if obstacles is not None:
        contact = PublishedContact(
            obstacles, number(CONTACT_STIFFNESS), number(CONTACT_DAMPING), plane
        )
    return PublishedArm(
        rod=rod,
        rest=rest,
        held=fixed_end(rest),
        drag=ViscousDrag(number(VISCOSITY)),
        muscles=MuscleParams(
            spline,
            number(TORQUE_PER_ELEMENT),
            None if largest_change is None else number(largest_change),
        ),
        contact=contact,
        method=pyelastica() if plane is None else planar(plane, pyelastica()),
    )
