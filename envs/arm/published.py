"""The arm of the `paper` variants: the published simulator, driven by its muscles.

It follows PyElastica's law and order of operations, plus three features of its first
release: viscous drag, contact forces that depend on the loads computed before them, and
muscles that may change from one simulation step to the next. An arm whose motion stays
in a plane is computed in that plane.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod import Rod, RodState, Scene, advance, fixed_end, planar, pyelastica
from jaxrod.actuation import ControlSpline, ElementCouples
from jaxrod.effects.clamps import FixedEnd
from jaxrod.envs.arm.cylinders import Cylinders
from jaxrod.envs.arm.published_contact import PublishedContact
from jaxrod.envs.arm.soft_arm import TORQUE_PER_ELEMENT, VISCOSITY, published_rod
from jaxrod.extend import Effect, Loads, Motion, StabilityBound
from jaxrod.geometry import vectors
from jaxrod.methods.planar import Planar
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.methods.pyelastica import PyElastica
from jaxrod.methods.strides import Strides, drift_time
from jaxrod.stepping.loops import integrated
from jaxrod.structure import pytree

CONTACT_STIFFNESS = 8e4
CONTACT_DAMPING = 4.0


@pytree
class PublishedArm:
    """Parameters of the published arm and of everything that acts on it."""

    rod: Rod
    """Geometry and material of the arm."""
    rest: RodState
    """State of the arm at the start of an episode."""
    held: FixedEnd
    """Clamp at the base of the arm."""
    drag: ViscousDrag
    """Viscous drag of the medium."""
    muscles: MuscleParams
    """Spline, couple and rate limit of the muscles."""
    contact: PublishedContact | None
    """Contact with the obstacles; `None` if there are none."""
    method: PyElastica | Planar
    """PyElastica's stepping method, restricted to the plane of motion if any."""

    def relaxed(self) -> Muscles:
        """Muscles at the start of an episode: no activation, no couples."""
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
            state: State of the arm.
            muscles: State of the muscles after the previous step.
            controls: Commanded control values about d1, d2 and d3 [1].
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The states of arm and muscles, and whether a node's position is no longer
            finite.
        """
        stepper = self.method.stepper(self.scene(), state, dt)
        if self.muscles.largest_change is None:
            # The couples of the first step hold in all steps.
            lengths, new = stepper.begin(state).lengths, jnp.ones((), bool)
            muscles = contract(muscles, controls, lengths, new, self.muscles)
            state = advance(self.scene(muscles.couples), state, dt, n_steps)
            return state, muscles, ~jnp.all(jnp.isfinite(state.positions))

        driven = _DrivenArm(self, stepper, controls)
        state, muscles = integrated(driven, (state, muscles), n_steps)
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
class _DrivenArm(Strides):
    """Stepper of an arm whose muscles change at every step (position Verlet).

    A step is half a drift, a kick and half a drift. A cycle joins the two half drifts:
    it is a kick and a full drift to the next kick.
    """

    arm: PublishedArm
    stepper: Any
    """Stepper of the arm without its muscles."""
    controls: Float[Array, "3 n_controls"]

    def begin(self, given: tuple[RodState, Muscles]) -> tuple[Any, Muscles, Array]:
        """Drifts half a time step from the given states to the first kick.

        Returns:
            Motion, muscles, and True, which marks the commanded values as new.
        """
        state, muscles = given
        return self.stepper.begin(state), muscles, jnp.ones((), bool)

    def stride(
        self, carry: tuple[Any, Muscles, Array], last: bool | Bool[Array, ""]
    ) -> tuple[Any, Muscles, Array]:
        """Updates the muscles, kicks, and drifts one time step to the next kick.

        The last drift is half as long. `carry` is the result of `begin` or of the
        previous stride; the result has the same form.
        """
        motion, muscles, renewed = carry
        muscles = contract(
            muscles, self.controls, motion.lengths, renewed, self.arm.muscles
        )
        driven = replace(self.stepper, scene=self.arm.scene(muscles.couples))
        time = drift_time(self.stepper.dt, last)
        moved = self.stepper.drift(driven.kick(motion), time)
        return moved, muscles, jnp.zeros((), bool)

    def finished(self, carry: tuple[Any, Muscles, Array]) -> tuple[RodState, Muscles]:
        """States of arm and muscles at the end of the last step."""
        motion, muscles, _ = carry
        return self.stepper.leave(motion), muscles


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
    """Makes the published arm, straight and at rest.

    Args:
        n_elements: Number of elements: 20 in Cases 1 and 2, 50 in Cases 3 and 4.
        start: Position of the clamped end [m].
        axis: Axis along the arm: "y" (Cases 1, 2) or "z" (Cases 3, 4).
        spline: Spline through the control points, in rest arc length.
        largest_change: Largest change of a control value in a simulation step; `None`
            if control values jump to the commanded ones.
        obstacles: Cylinders that the arm may touch; `None` for no contact.
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


@pytree
class ViscousDrag(Effect):
    r"""Viscous drag of the first release of Elastica, which the benchmark used.

    Each element of current length $\ell$, mean nodal velocity $\bar v$ and angular
    velocity $\omega$ gets the force $f = -\nu\, \bar v\, \ell$ and the couple
    $c = -\nu\, \omega\, \ell$, with `viscosity` $\nu$. They are explicit in time, and
    only for `pyelastica()`. PyElastica 1.0 has no such drag.
    """

    viscosity: Float[Array, ""]
    """Force per length and speed [kg/(m s)]; the same number is the couple per length
    and angular velocity [kg m/s]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Drag forces and couples; half of an element's force acts on each node."""
        drag = -self.viscosity * motion.lengths
        x, y, z = motion.velocity
        means = (0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1]), 0.5 * (z[1:] + z[:-1]))
        return Loads(
            forces=vectors.pair_sum(vectors.scale(0.5 * drag, means)),
            # In PyElastica mode the spin is the material-frame angular velocity.
            couples=vectors.scale(drag, motion.spin),
        )

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Drag of nodes and elements at rest length, which limits the time step."""
        drag = self.viscosity * rod.rest_lengths
        nodes = 0.5 * (vectors.pad(drag, 0, 1) + vectors.pad(drag, 1, 0))
        return StabilityBound(node_drag=nodes, element_drag=drag)


@pytree
class MuscleParams:
    """Spline, couple and rate limit of the muscles of the published arm."""

    spline: ControlSpline
    """Spline along the arm through the control values, over rest arc length."""
    torque: Float[Array, ""]
    """Couple on an element for a control value of one [N m]."""
    largest_change: Float[Array, ""] | None
    """Largest change of a control value in a simulation step [1]; `None` if control
    values jump to the commanded ones."""


@pytree
class Muscles:
    """State of the muscles: rate-limited control values, and the resulting couples.

    Each direction (bending about d1, about d2, twist) is a separate muscle. While its
    control values differ from the commanded ones, they move towards them at every
    simulation step, by `largest_change` at most. The couples are then read from the
    spline through the control values, at the far end of each element, in current arc
    length. Once the commanded values are reached the couples stay constant, for any
    motion of the arm.
    """

    applied: Float[Array, "3 n_controls"]
    """Control values after the rate limit, about d1, d2 and d3 [1]."""
    couples: Float[Array, "3 n"]
    """Couples on the elements, material frame [N m]."""


def relaxed(rod: Rod, params: MuscleParams) -> Muscles:
    """Muscles without activation, as at the start of an episode."""
    dtype = rod.rest_lengths.dtype
    return Muscles(
        applied=jnp.zeros((3, params.spline.n_controls), dtype),
        couples=jnp.zeros((3, rod.n_elements), dtype),
    )


def contract(
    muscles: Muscles,
    commanded: Float[Array, "3 n_controls"],
    lengths: Float[Array, " n"],
    renewed: Bool[Array, ""],
    params: MuscleParams,
) -> Muscles:
    """Moves the control values towards the commanded ones, and updates the couples.

    Args:
        muscles: Muscles after the previous simulation step.
        commanded: Commanded control values [1].
        lengths: Current lengths of the elements [m].
        renewed: Whether the commanded values are new in this step. If they equal the
            old ones, the couples keep their values, but their derivatives become those
            with respect to the new commanded values.
        params: Parameters of the muscles.
    """
    missing = commanded - muscles.applied
    bound = params.largest_change
    applied = commanded
    if bound is not None:
        applied = jnp.where(
            jnp.abs(missing) <= bound,
            commanded,
            muscles.applied + jnp.clip(missing, -bound, bound),
        )
    couples = params.torque * params.spline(applied, jnp.cumsum(lengths))
    changing = jnp.any(missing != 0, axis=1, keepdims=True)
    still = lax.stop_gradient(muscles.couples) + (couples - lax.stop_gradient(couples))
    held = jnp.where(renewed, still, muscles.couples)
    return Muscles(applied, jnp.where(changing, couples, held))
