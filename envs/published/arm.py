"""The arm of the `paper` variants: the published simulator, driven by its muscles.

PyElastica's law and order of operations, with what its first release had besides:
viscous drag, contact forces that depend on all loads found so far, and muscles that may
change from one simulation step to the next. An arm that cannot leave a plane moves in
it exactly.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
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
from jaxrod.methods.verlet import Verlet
from jaxrod.structure import pytree

CONTACT_STIFFNESS = 8e4
CONTACT_DAMPING = 4.0


@pytree
class PublishedArm:
    """Parameters of the published arm and of all that acts on it."""

    rod: Rod
    """The arm."""
    rest: RodState
    """The arm at the start of an episode."""
    held: FixedEnd
    """Its base."""
    drag: ViscousDrag
    """Viscous drag of the medium."""
    muscles: MuscleParams
    """Parameters of the muscles."""
    contact: PublishedContact | None
    """Contact with the obstacles; `None` where there are none."""
    method: PyElastica | Planar
    """Method of PyElastica's law, in the plane of motion where there is one."""

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
        """Simulation steps under one action.

        Args:
            state: The arm.
            muscles: Its muscles in the step before.
            controls: Commanded values [1] about d1, d2 and d3.
            dt: Step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The arm, the muscles, and whether a node is no longer anywhere.
        """
        stepper = self.method.stepper(self.scene(), state, dt)
        if self.muscles.largest_change is None:
            # What they do in the first step they do in all.
            lengths, new = stepper.begin(state).lengths, jnp.ones((), bool)
            muscles = contract(muscles, controls, lengths, new, self.muscles)
            state = advance(self.scene(muscles.couples), state, dt, n_steps)
            return state, muscles, ~jnp.all(jnp.isfinite(state.positions))

        def driven_by(couples: Array) -> Verlet:
            return replace(stepper, scene=self.scene(couples))

        def cycle(
            carry: tuple[Any, Muscles], given: tuple[Array, Array]
        ) -> tuple[tuple[Any, Muscles], None]:
            motion, muscles = carry
            drift, renewed = given
            muscles = contract(muscles, controls, motion.lengths, renewed, self.muscles)
            kicked = driven_by(muscles.couples).kick(motion)
            return (stepper.drift(kicked, drift), muscles), None

        # From kick to kick it is a whole step, from the last one half a step.
        drifts = dt * jnp.ones(n_steps, dt.dtype).at[-1].set(0.5)
        renewed = jnp.zeros(n_steps, bool).at[0].set(True)
        (motion, muscles), _ = lax.scan(
            jax.checkpoint(cycle), (stepper.begin(state), muscles), (drifts, renewed)
        )
        state = stepper.leave(motion)
        return state, muscles, ~jnp.all(jnp.isfinite(state.positions))

    def scene(self, couples: Float[Array, "3 n"] | None = None) -> Scene:
        """Scene of the arm: all that acts on it.

        Args:
            couples: Of the muscles on the elements, material frame [N m]; `None` for
                the arm without its muscles.
        """
        effects: tuple[Effect, ...] = (self.held, self.drag)
        if self.contact is not None:
            effects = (*effects, self.contact)
        if couples is not None:
            effects = (*effects, ElementCouples(couples))
        return Scene(self.rod, effects, self.method)


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
        n_elements: 20 in Cases 1 and 2, 50 in Cases 3 and 4.
        start: Where it is clamped [m].
        axis: "y" (Cases 1, 2) or "z" (Cases 3, 4).
        spline: Spline through the control points, in rest arc length.
        largest_change: Largest change of a control value in a simulation step; `None`
            where they jump.
        obstacles: Cylinders that it may touch.
        plane: The plane of motion, where there is one: obstacles are perpendicular to
            it.
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
