r"""The snake of Gazzola et al. (2018) as a rod on flat ground, and its muscles.

Dimensions, moduli, friction and damping are those of PyElastica's continuum snake, at a
Froude number of 0.1. The muscles are moments at the joints about the vertical, shaped
by a spline through a few control points. Within a control step they change linearly in
time from their old to their commanded values. Moments that jump would shake the body,
and a shaken body has less friction.

Transverse rotary inertia is scaled up (`jaxrod.scale_inertia`); the slow motion on the
ground is insensitive to it. The couples of rotational damping are kept unchanged.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrod import (
    HealthLimits,
    Rod,
    RodState,
    Scene,
    advance,
    angular_velocities,
    freeze,
    health,
    make_scene,
    planar,
    scale_inertia,
    straight_rod,
)
from jaxrod.actuation import ElementCouples, control_spline
from jaxrod.contacts.contact_law import directional_friction_force
from jaxrod.effects.loads import ExponentialDamping
from jaxrod.extend import Effect, Loads, StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.schedules import Ramp
from jaxrod.structure import pytree

LENGTH = 0.35
"""Length of the snake [m]."""
RADIUS = 0.011 * LENGTH
"""Radius of the snake [m]."""
DENSITY = 1000.0
"""Density of the snake [kg/m^3]."""
YOUNGS_MODULUS = 1e6
"""Young's modulus of the snake [Pa]."""
PERIOD = 2.0
"""Period of the published gait [s]."""
GRAVITY = 9.80665
"""Gravitational acceleration [m/s^2]."""
FROUDE = 0.1
"""Froude number, length / (period^2 g friction): inertia over friction [1]."""
DAMPING = 2e-3
"""PyElastica's damping rate of translation [1/s]. The rate of rotation is this number
times m/J, with mass m and moment of inertia J of an element in SI units."""
RELAXATION_TIME = 0.05
"""Ratio of viscous to elastic bending stiffness [s]. The lowest free vibration, with a
period of 0.56 s, has a damping ratio of 0.28. PyElastica's snake has no such damping,
and a policy would learn to exploit the vibration."""
DRAG_RATE = 1000.0
"""Largest ratio of friction per mass to slip speed [1/s]. Friction is regularised, so
the snake creeps, at 1.7 mm/s or less."""


@pytree
class SnakeBody:
    """Parameters of the snake and of everything that acts on it."""

    rod: Rod
    """Geometry and material of the snake, with scaled transverse rotary inertia; the
    head is the last node."""
    rest: RodState
    """State of the snake straight along x, at rest, with its middle at the origin."""
    ground: FlatGround
    """Friction of the ground under the snake."""
    damping: ExponentialDamping
    """Exponential damping of translation and rotation."""
    relaxation_time: Float[Array, ""]
    """Ratio of viscous to elastic bending stiffness [s]."""
    basis: Float[Array, "n-1 controls"]
    """Moment at each joint for a unit moment at each control point [1]."""
    strongest: Float[Array, ""]
    """Moment at a control point for a control value of one [N m]."""
    largest_change: Float[Array, ""]
    """Largest change of a control value from one control step to the next [1]."""
    limits: HealthLimits = dataclasses.field(default_factory=HealthLimits)
    """Health limits beyond which the snake is frozen."""

    def scene(self) -> Scene:
        """Scene of the snake without muscles and bending viscosity.

        Neither of them limits the time step.
        """
        return Scene(self.rod, (self.ground, self.damping), planar("xy"))

    def advance(
        self,
        state: RodState,
        before: Float[Array, " controls"],
        after: Float[Array, " controls"],
        dt: Array,
        n_steps: int,
    ) -> tuple[RodState, Bool[Array, ""]]:
        """Advances the snake by the simulation steps of one control step.

        Args:
            state: State of the snake.
            before: Control values as the control step begins [1].
            after: Control values as it ends; linear in time in between [1].
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The state, and whether a health flag rose; if so, the state is unchanged.
        """
        scene = self.scene()
        couples = Ramp(
            first=self.couples(before),
            last=self.couples(after),
            start=jnp.zeros_like(dt),
            duration=n_steps * dt,
        )
        # Any number of an effect may be a schedule, which the field's type does not
        # state.
        muscles = ElementCouples(couples)  # type: ignore[arg-type]
        tissue = bending_viscosity(self.rod, self.relaxation_time, dt)
        effects = (*scene.effects, tissue, muscles)
        acting = dataclasses.replace(scene, effects=effects)
        moved = advance(acting, state, dt, n_steps)
        flagged = health(scene, moved, dt, limits=self.limits).flagged
        return freeze(flagged, state, moved), flagged

    def couples(self, controls: Float[Array, " controls"]) -> Float[Array, "3 n"]:
        """Couples of the muscles on the elements, material frame [N m].

        The couple about d1, the vertical, is the muscle moment of the joint towards the
        tail minus that of the joint towards the head.
        """
        moments = self.strongest * jnp.sum(self.basis * controls[None, :], axis=1)
        about = vectors.pad(moments, 1, 0) - vectors.pad(moments, 0, 1)
        return jnp.stack([about, jnp.zeros_like(about), jnp.zeros_like(about)])

    def centre(self, state: RodState) -> Float[Array, "2"]:
        """Centre of mass of the snake, x and y [m]."""
        return _mean(self.rod.node_masses, state.positions[:2])

    def centre_velocity(self, state: RodState) -> Float[Array, "2"]:
        """Velocity of the centre of mass, x and y [m/s]."""
        return _mean(self.rod.node_masses, state.velocities[:2])

    def bends(self, state: RodState) -> Float[Array, " n-1"]:
        """Angles between neighbouring elements, positive to the left [rad]."""
        x, y, _ = vectors.split(state.directors[2])
        cross = x[:-1] * y[1:] - y[:-1] * x[1:]
        return jnp.arctan2(cross, x[:-1] * x[1:] + y[:-1] * y[1:])

    def bend_rates(self, state: RodState) -> Float[Array, " n-1"]:
        """Rates of the angles between neighbouring elements [rad/s]."""
        about = angular_velocities(self.rod, state)[0]
        return about[1:] - about[:-1]


def _mean(masses: Array, field: Float[Array, "2 n+1"]) -> Float[Array, "2"]:
    return jnp.sum(masses[None, :] * field, axis=1) / jnp.sum(masses)


def snake_body(
    n_elements: int, n_controls: int, strongest: float, largest_change: float
) -> SnakeBody:
    """Makes the snake, at rest, in JAX's default precision.

    Args:
        n_elements: Number of elements, a multiple of `n_controls + 1`.
        n_controls: Number of equidistant control points of the muscles.
        strongest: Moment at a control point for a control value of one [N m].
        largest_change: Largest change of a control value in a control step [1].
    """
    rod, rest = straight_rod(
        n_elements,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNGS_MODULUS,
        shear_modulus=YOUNGS_MODULUS / 1.5,
        start=(-0.5 * LENGTH, 0.0, 0.0),
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    line = rod.linear_density[0]
    unit = LENGTH / (PERIOD**2 * GRAVITY * FROUDE)
    ground = FlatGround(
        weight=line * GRAVITY,
        friction=unit * jnp.asarray([1.0, 1.5, 2.0], line.dtype),
        friction_drag=DRAG_RATE * line,
    )
    scaled = scale_inertia(make_scene(rod, ground, method=planar("xy")))
    spline = control_spline(n_controls, LENGTH)
    joints = jnp.asarray(np.arange(1, n_elements) * (LENGTH / n_elements), line.dtype)

    def number(value: float) -> Array:
        return jnp.asarray(value, line.dtype)

    return SnakeBody(
        rod=scaled.scene.rod,
        rest=rest,
        ground=ground,
        damping=ExponentialDamping(
            translational_rate=number(DAMPING),
            rotational_rate=4 * DAMPING / RADIUS**2 / jnp.mean(scaled.factors),
        ),
        relaxation_time=number(RELAXATION_TIME),
        basis=spline.basis(joints),
        strongest=number(strongest),
        largest_change=number(largest_change),
        limits=jax.tree.map(number, HealthLimits()),
    )


@pytree
class FlatGround(Effect):
    """Anisotropic friction of a rod that lies on flat ground with its full weight.

    The friction law is that of `jaxrod.contact` with `friction=(forward, backward,
    sideways)`. The normal force is known: a rod that moves in the plane of the ground
    presses on it with its weight per length. So the motion is planar. This takes a
    third of the work of a rod in space on stiff ground, and there is no vertical
    vibration to resolve.
    """

    weight: Float[Array, ""]
    """Normal force per length of rod [N/m]."""
    friction: Float[Array, "3"]
    """Friction coefficients forward (along d3), backward and sideways [1]."""
    friction_drag: Float[Array, ""]
    """Largest ratio of friction per length to slip speed [kg/(m s)]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Friction forces on the nodes; forward is the mean d3 of adjacent elements."""
        axis = _at_nodes(directors(motion.orientation)[2])
        density = directional_friction_force(
            self.weight, motion.velocity, axis, self.friction, self.friction_drag
        )
        return Loads(forces=vectors.scale(_lengths(rod), density))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Friction per slip speed of each node at rest, which limits the time step."""
        return StabilityBound(node_drag=self.friction_drag * _lengths(rod))


def _lengths(rod: Rod) -> Array:
    """Rest length of each node: half of each adjacent element [m]."""
    half = 0.5 * rod.rest_lengths
    return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)


def _at_nodes(axis: Vec3) -> Vec3:
    """Unit vectors at the nodes: normalised sums of those of the adjacent elements."""
    x, y, z = (vectors.pad(c, 0, 1) + vectors.pad(c, 1, 0) for c in axis)
    size = vectors.safe_norm((x, y, z))
    return vectors.scale(1 / size, (x, y, z))


@pytree
class BendingViscosity(Effect):
    r"""Viscosity of bending about the vertical: joints resist their rate of bending.

    The moment of a joint is $-\tau B\,\dot\phi/\hat D$ (Kelvin-Voigt), with relaxation
    time $\tau$, bending stiffness $B$, rest length $\hat D$ and angle $\phi$ of the
    joint. It changes only the elements' angular momenta $P$ about the vertical. In a
    plane the matrix $A = \Delta^T (\tau B/\hat D)\,\Delta\,J^{-1}$ is constant, with
    rotary inertia $J$ and differences $\Delta$ of neighbouring elements. So a backward
    Euler step of size $h$ is one matrix product, $P \leftarrow (1 + hA)^{-1} P$. It
    does not limit the time step. It costs a fraction of `jaxrod.internal_damping`,
    which also damps stretch, shear and twist, in space. A mode of angular frequency
    $\omega$ decays at the rate $\tau\omega^2/2$.
    """

    kept: Float[Array, "n n"]
    """Matrix (1 + h A)^-1 from angular momenta before a step to those after it [1]."""

    def dissipate(self, scene: Scene, motion: Motion, dt: Array) -> Motion:
        """Returns the motion after viscosity has slowed the bending for one step."""
        x, y, z = motion.spin
        slowed = jnp.sum(self.kept * z[None, :], axis=1)
        return dataclasses.replace(motion, spin=(x, y, slowed))


def bending_viscosity(rod: Rod, relaxation_time: Array, dt: Array) -> BendingViscosity:
    """Makes the bending viscosity of a round, level rod in the plane "xy".

    Args:
        rod: The rod, in a scene whose method is `planar("xy")`.
        relaxation_time: Ratio of viscous to elastic stiffness [s].
        dt: Time step h of the simulation in which the effect is used [s].
    """
    n = rod.n_elements
    eye = jnp.eye(n, dtype=rod.rest_lengths.dtype)
    across = eye[1:] - eye[:-1]
    drag = relaxation_time * rod.joint_stiffness[0] / rod.joint_lengths
    rates = jnp.sum(
        across[:, :, None] * drag[:, None, None] * across[:, None, :], axis=0
    )
    return BendingViscosity(jnp.linalg.inv(eye + dt * rates / rod.inertias[0][None, :]))
