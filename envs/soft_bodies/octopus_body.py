r"""An octopus on the sea floor: a rigid head, eight soft arms, water and ground.

The arms are of soft silicone (an elastic modulus of 30 kPa), attached to the lower side
of the head. In the system they are one member: a stack of equal rods. Arms and head are
a tenth denser than the water. The arms lie on the floor, with friction. The water drags
on the arms. Muscles impose a separate curvature on every arm
(`jaxrod.actuation.ActiveShape`), sideways and upwards, uniform along the arm. An arm in
free space would take this curvature.

Transverse rotary inertia of the arms is scaled up (`jaxrod.scale_inertia`); slow motion
in water is insensitive to it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import jaxrod
from jaxrod import HealthLimits, RodState, Scene
from jaxrod.actuation import ActiveShape
from jaxrod.schedules import Ramp
from jaxrod.structure import pytree
from jaxrod.systems.stepping.assembly import SystemState
from jaxrod.systems.system import System

N_ARMS = 8
LENGTH = 0.2
"""Length of an arm [m]."""
RADII = (0.012, 0.006)
"""Radii of an arm at the head and at its tip [m]."""
HEAD = 0.03
"""Radius of the head [m]."""
DENSITY, WATER = 1100.0, 1000.0
"""Densities of arms and head, and of the water [kg/m^3]."""
YOUNGS_MODULUS = 3e4
"""Young's modulus of the arms [Pa]."""
GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""
FRICTION = 0.6
"""Friction coefficient of the arms on the floor [1]."""
MOST_CURVATURE = 15.0
"""Largest curvature that the muscles impose on an arm about either transverse axis, 3
rad over the arm's length [1/m]."""


@pytree
class OctopusBody:
    """Parameters of the octopus and of everything that acts on it."""

    system: System
    """Members "arms" and "head"; the arms' last effect is their muscles."""
    rest: dict[str, RodState | jaxrod.systems.BodyState]
    """States at rest: all arms straight and parallel to the floor."""
    angles: Float[Array, "8"]
    """Directions of the arms at rest, measured from x towards y [rad]."""
    most_curvature: Float[Array, ""]
    """Rest curvature of an arm for a control value of one [1/m]."""
    largest_change: Float[Array, ""]
    """Largest change of a control value from one control step to the next [1]."""
    limits: HealthLimits = dataclasses.field(default_factory=HealthLimits)
    """Health limits beyond which the octopus is frozen."""

    @property
    def arms(self) -> Scene:
        """Scene of the arms; every leaf has a leading axis over the eight."""
        arms: Any = self.system.members["arms"]
        return arms

    def advance(
        self,
        state: SystemState,
        before: Float[Array, "8 2"],
        after: Float[Array, "8 2"],
        dt: Array,
        n_steps: int,
    ) -> tuple[SystemState, Bool[Array, ""]]:
        """Advances the octopus by the simulation steps of one control step.

        Args:
            state: State of the octopus.
            before: Control values of every arm as the control step begins, sideways (to
                the left as seen from the head) and upwards [1].
            after: Control values as it ends; linear in time in between [1].
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The state, and whether a health flag rose; if so, the state is unchanged.
        """
        duration = n_steps * dt
        curvature = Ramp(
            first=self._curvatures(before),
            last=self._curvatures(after),
            start=jnp.zeros((N_ARMS,), dt.dtype),
            duration=jnp.broadcast_to(duration, (N_ARMS,)),
        )
        acting = self._with_curvature(curvature)
        moved = jaxrod.advance(acting, state, dt, n_steps)
        still = self._with_curvature(curvature.last)
        flagged = jaxrod.health(still, moved, dt, limits=self.limits).flagged
        return jaxrod.freeze(flagged, state, moved), flagged

    def _with_curvature(self, curvature: Array | Ramp) -> System:
        """System whose arm muscles impose a rest curvature (8, 3), or a ramp of it."""
        muscles = ActiveShape(curvature=curvature, strain=None)
        effects = (*self.arms.effects[:-1], muscles)
        arms = dataclasses.replace(self.arms, effects=effects)
        members = {**self.system.members, "arms": arms}
        return dataclasses.replace(self.system, members=members)

    def _curvatures(self, controls: Float[Array, "8 2"]) -> Float[Array, "8 3"]:
        """Rest curvatures of the arms about d1 (vertical) and d2 (horizontal) [1/m].

        They are `most_curvature` times the control values. The third, twist, is zero.
        """
        return self.most_curvature * jnp.pad(controls, ((0, 0), (0, 1)))


def octopus_body(n_elements: int, largest_change: float) -> OctopusBody:
    """Makes the octopus, at rest, in JAX's default precision.

    Args:
        n_elements: Number of elements of every arm.
        largest_change: Largest change of a control value in a control step [1].
    """
    angles = 2 * jnp.pi * (jnp.arange(N_ARMS) + 0.5) / N_ARMS
    weight = jaxrod.gravity((0.0, 0.0, -GRAVITY * (1 - WATER / DENSITY)))
    root = (HEAD**2 - (HEAD - RADII[0]) ** 2) ** 0.5

    def arm(angle: Array) -> tuple[Scene, RodState]:
        zero = jnp.zeros_like(angle)
        outwards = jnp.stack([jnp.cos(angle), jnp.sin(angle), zero])
        rod, state = jaxrod.straight_rod(
            n_elements,
            length=LENGTH,
            radius=RADII,
            density=DENSITY,
            youngs_modulus=YOUNGS_MODULUS,
            start=root * outwards + jnp.asarray([0.0, 0.0, RADII[0]]),
            direction=outwards,
            normal=(0.0, 0.0, 1.0),
        )
        floor = jaxrod.contact(
            jaxrod.shapes.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            stiffness=1500.0,
            damping=8.0,
            friction=FRICTION,
            friction_drag=12.0,
        )
        effects = (
            weight,
            jaxrod.fluids.quadratic_drag(WATER, across=1.1, along=0.02),
            floor,
            jaxrod.actuation.active_shape(rod, curvature=jnp.zeros(3)),
        )
        return jaxrod.make_scene(rod, *effects), state

    one, _ = arm(angles[0])
    factors = jaxrod.scale_inertia(one).factors
    arms, of_arms = jax.vmap(arm)(angles)
    inertia = arms.rod.rotary_inertia.at[:, 0].multiply(factors[None, :])
    arms = dataclasses.replace(
        arms, rod=dataclasses.replace(arms.rod, rotary_inertia=inertia)
    )
    head, of_head = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.0, HEAD), HEAD),
        density=DENSITY,
        effects=(weight, jaxrod.exponential_damping(0.5, 0.5)),
    )
    rest: dict[str, RodState | jaxrod.systems.BodyState] = {
        "arms": of_arms,
        "head": of_head,
    }
    roots = [("arms", k, "base") for k in range(N_ARMS)]
    system = jaxrod.make_system(
        {"arms": arms, "head": head},
        jaxrod.systems.attach(roots, ("head",), rest),
        state=rest,
    )
    kind = angles.dtype

    def number(value: float) -> Array:
        return jnp.asarray(value, kind)

    return OctopusBody(
        system=system,
        rest=rest,
        angles=angles,
        most_curvature=number(MOST_CURVATURE),
        largest_change=number(largest_change),
        limits=jax.tree.map(number, HealthLimits()),
    )
