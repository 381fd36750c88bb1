r"""PyElastica mode: PyElastica 1.0's law and stepping order, on jaxrod's state.

For comparisons with the reference and for reproducing published results. With
$\ell$ the current and $\hat\ell$ the rest length, $e = \ell/\hat\ell$,
$\varepsilon$ the mean of current over rest length at a joint, and $t$ the tangent,

- forces: $\Delta^h (R\, S(\sigma-\sigma_0)/e)$;
- couples (material frame): $\Delta^h(\tau/\varepsilon^3)
  + \mathcal A^h(\kappa\times\tau\,\hat D/\varepsilon^3)
  + (R^T t \times n)\,\hat\ell + (J\omega/e)\times\omega + (J\omega/e)\,\dot e/e$;
- $\dot\omega = e\, J^{-1} c$.

These forces and couples are not the gradient of an energy, and the gyroscopic terms
are explicit: the mode conserves neither energy nor angular momentum. Clamped ends
are `effects.FixedEnd`. Source: PyElastica 1.0.0; Gazzola et al. (2018).

After the loads have changed them, PyElastica's `AnalyticalLinearDamper` multiplies
velocities and angular velocities by factors. With the step $h$, the stretch $e$ and the
moments of inertia $J_i$ they are

$$e^{-\gamma_t h/m}, \quad \left(e^{-\gamma_r h/J_i}\right)^e
  \qquad\text{or}\qquad
  e^{-g h}, \quad \left(e^{-g h M/J_i}\right)^e,$$

the first pair with PyElastica's constants of translation and rotation, the second with
its single `damping_constant`. $M$ is the mean of an element's node masses (plus half of
the end node's at either end). Held components stay held; PyElastica's damper also slows
down driven ends.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    multiply_quaternions,
    normalise,
    rotation_exp,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import (
    LoadedRod,
    Method,
    constrain,
    constrain_rates,
    damping_rates,
    dissipate,
    dissipates,
    external_loads,
)
from jaxrod.methods.verlet import Verlet
from jaxrod.rods.elasticity import joint_rotations
from jaxrod.rods.motion import Loads, Motion, accumulate, motion_of, state_of
from jaxrod.rods.rod import Rod, RodState, angular_velocities, with_angular_velocities
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array


@pytree
class PyElasticaStepper(Verlet):
    """Constants of the PyElastica step for one scene and one step size."""

    decay: tuple[Array, Array] | None
    """Fractions of velocities and spins left by damping after one step [1]; `None`
    without damping."""
    lengths: Array
    """Rest lengths of the elements [m]."""
    inverse_lengths: Array
    """Inverse rest lengths of the elements [1/m]."""
    inverse_joint_lengths: Array
    """Inverse rest lengths of the joints [1/m]."""
    shear_stretch: Vec3
    """Shear and axial stiffness [N]."""
    bend_twist: Vec3
    """Bending and twist stiffness of the joints [N m^2]."""
    rest_strains: Vec3
    rest_curvatures: Vec3
    inverse_masses: Array
    """Inverse masses of the nodes [1/kg]."""
    inertia: Vec3
    """Rotary inertia about d1, d2, d3 [kg m^2]."""
    inverse_inertia: Vec3
    """Inverse rotary inertia about d1, d2, d3 [1/(kg m^2)]."""

    @staticmethod
    def create(scene: LoadedRod, dt: Array) -> PyElasticaStepper:
        """Computes the constants for a scene and a step size `dt` [s]."""
        rod: Rod = scene.rod
        inertia = vectors.split(rod.principal_inertias)
        rates = damping_rates(scene)
        decay = rates and (jnp.exp(-rates[0] * dt), jnp.exp(-rates[1] * dt))
        return PyElasticaStepper(
            scene=scene,
            dt=dt,
            decay=decay,
            lengths=rod.rest_lengths,
            inverse_lengths=1 / rod.rest_lengths,
            inverse_joint_lengths=1 / rod.joint_lengths,
            shear_stretch=vectors.split(rod.shear_stretch_stiffness),
            bend_twist=vectors.split(rod.joint_stiffness),
            rest_strains=vectors.split(rod.rest_strains),
            rest_curvatures=vectors.split(rod.rest_curvatures),
            inverse_masses=1 / rod.node_masses,
            inertia=inertia,
            inverse_inertia=(1 / inertia[0], 1 / inertia[1], 1 / inertia[2]),
        )

    def enter(self, state: RodState) -> Motion:
        """Unpacks a state; angular momentum becomes angular velocity."""
        velocities = vectors.split(angular_velocities(self.scene.rod, state))
        motion = replace(motion_of(state), spin=velocities, spin_is_velocity=True)
        return constrain_rates(self.scene, constrain(self.scene, motion))

    def leave(self, motion: Motion) -> RodState:
        """Packs a motion into a state; angular velocity becomes angular momentum."""
        state = state_of(motion)
        return with_angular_velocities(self.scene.rod, state, state.angular_momenta)

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves nodes and rotates elements at constant rates for `dt` [s]."""
        turn = rotation_exp(vectors.scale(dt, motion.spin))
        orientation = normalise(multiply_quaternions(motion.orientation, turn))
        return constrain(self.scene, replace(motion, orientation=orientation).moved(dt))

    def internal_loads(self, motion: Motion) -> Loads:
        """Internal forces and couples, including gyroscopic and dilatation terms."""
        frame = directors(motion.orientation)
        edges, lengths = motion.edges, motion.lengths
        stretch = lengths * self.inverse_lengths
        local = to_material(frame, edges)
        inverse = self.inverse_lengths
        strain = (local[0] * inverse, local[1] * inverse, local[2] * inverse - 1)
        stress = vectors.multiply(
            self.shear_stretch, vectors.subtract(strain, self.rest_strains)
        )
        inverse_stretch = 1 / stretch
        force = to_world(frame, vectors.scale(inverse_stretch, stress))

        joint_stretch = 0.5 * (lengths[1:] + lengths[:-1]) * self.inverse_joint_lengths
        cubed = 1 / (joint_stretch * joint_stretch * joint_stretch)
        rotation, _ = joint_rotations(motion.orientation)
        curvature = vectors.scale(self.inverse_joint_lengths, rotation)
        moment = vectors.multiply(
            self.bend_twist, vectors.subtract(curvature, self.rest_curvatures)
        )
        moment = vectors.scale(cubed, moment)
        couples = vectors.add(
            vectors.difference(moment),
            vectors.pair_sum(vectors.scale(0.5, vectors.cross(rotation, moment))),
        )
        # (R^T t) x n times the rest length: the edge divided by its stretch.
        couples = vectors.add(
            couples,
            vectors.cross(vectors.scale(inverse_stretch, local), stress),
        )

        spin = motion.spin
        momentum = vectors.scale(inverse_stretch, vectors.multiply(self.inertia, spin))
        rates = vectors.inner_difference(motion.velocity)
        stretch_rate = vectors.dot(edges, rates) / (lengths * self.lengths)
        couples = vectors.add(couples, vectors.cross(momentum, spin))
        couples = vectors.add(
            couples, vectors.scale(stretch_rate * inverse_stretch, momentum)
        )
        return Loads(forces=vectors.difference(force), couples=couples)

    def kick(self, motion: Motion, others: Loads | None = None) -> Motion:
        """Changes velocities and angular velocities by all loads over one step.

        Args:
            motion: The motion in the middle of the step.
            others: Loads from outside the scene, if any.
        """
        internal = self.internal_loads(motion)
        assert internal.forces is not None and internal.couples is not None
        forces, couples = internal.forces, internal.couples
        if others is not None:
            forces = accumulate(forces, others.forces)
            couples = accumulate(couples, others.couples)
        loads = external_loads(self.scene, motion, forces, couples)
        assert loads.forces is not None and loads.couples is not None
        accelerations = vectors.scale(self.inverse_masses, loads.forces)
        stretch = motion.lengths * self.inverse_lengths
        turn = vectors.multiply(self.inverse_inertia, loads.couples)
        kicked = replace(
            motion,
            velocity=vectors.add(
                motion.velocity, vectors.scale(self.dt, accelerations)
            ),
            spin=vectors.add(motion.spin, vectors.scale(self.dt * stretch, turn)),
        )
        held = constrain_rates(self.scene, kicked)
        if self.decay is not None:
            held = replace(
                held,
                velocity=vectors.scale(self.decay[0], held.velocity),
                spin=vectors.scale(self.decay[1], held.spin),
            )
        if not dissipates(self.scene):
            return held
        slowed = dissipate(self.scene, held, self.dt)
        return constrain_rates(self.scene, slowed)


@pytree
class PyElastica(Method):
    """PyElastica's law and stepping order in three dimensions."""

    steps_in_systems = True

    @property
    def has_energy(self) -> bool:
        """False: PyElastica's loads are not the gradient of an energy."""
        return False

    @property
    def solves_damping(self) -> bool:
        """False: damping multiplies the rates after the kick."""
        return False

    def loads(self, scene: LoadedRod, motion: Motion) -> Loads:
        """All loads, with couples times the stretch e, as in J w' = e c."""
        step = jnp.ones((), scene.rod.rest_lengths.dtype)
        own = PyElasticaStepper.create(scene, step).internal_loads(motion)
        assert own.forces is not None and own.couples is not None
        loads = external_loads(scene, motion, own.forces, own.couples)
        assert loads.couples is not None
        stretch = motion.lengths / scene.rod.rest_lengths
        return replace(loads, couples=vectors.scale(stretch, loads.couples))

    def stepper(
        self, scene: LoadedRod, state: RodState, dt: Array
    ) -> PyElasticaStepper:
        """Stepper with the constants for a scene and a step size `dt` [s]."""
        return PyElasticaStepper.create(scene, dt)


def pyelastica() -> PyElastica:
    """PyElastica 1.0's law and stepping order, to round-off.

    Returns:
        The method, for `make_scene(..., method=...)`.

    Example:
        >>> method = jaxrod.pyelastica()
        >>> jaxrod.make_scene(rod, jaxrod.fixed_end(state), method=method)
        Scene(Rod(...), FixedEnd, PyElastica)
    """
    return PyElastica()


@pytree
class LinearDamper(Effect):
    """PyElastica's linear damper with one constant or two; see `linear_damper`."""

    translational: Float[Array, ""]
    r"""Decay rate $g$ of velocities [1/s] if `rotational` is `None`; otherwise the drag
    coefficient $\gamma_t$ of every node [kg/s]."""
    rotational: Float[Array, ""] | None = None
    r"""Rotational drag coefficient $\gamma_r$ of every element [N m s]; `None` with a
    single constant."""

    def dissipate(self, scene: LoadedRod, motion: Motion, dt: Array) -> Motion:
        """Motion with velocities and spins multiplied by the decay factors of one step.

        They are exp(-g dt) for velocities and, with the inertia J and the stretch e,
        exp(-g dt M / J)^e for spins, or those of two separate constants.
        """
        if not motion.spin_is_velocity:
            raise ValueError(
                "linear_damper works with method=pyelastica() only: use "
                "exponential_damping(rate, rotational_rate) with other methods"
            )
        rod: Rod = scene.rod
        if self.rotational is None:
            slowing, turning = self.translational, self.translational * _masses(rod)
        else:
            slowing, turning = self.translational / rod.node_masses, self.rotational
        over = turning * dt * motion.lengths / rod.rest_lengths
        a, b, c = (
            spin * jnp.exp(-over / inertia)
            for spin, inertia in zip(motion.spin, rod.principal_inertias, strict=True)
        )
        velocity = vectors.scale(jnp.exp(-slowing * dt), motion.velocity)
        return replace(motion, velocity=velocity, spin=(a, b, c))


def _masses(rod: Rod) -> Array:
    """Masses of elements from node masses, as PyElastica's damper computes them [kg].

    Each is the mean of two node masses, plus half of the end node's at an end.
    """
    nodes = rod.node_masses
    mean = 0.5 * (nodes[1:] + nodes[:-1])
    return mean.at[0].add(0.5 * nodes[0]).at[-1].add(0.5 * nodes[-1])


def linear_damper(
    damping_constant: Numbers | None = None,
    *,
    translational: Numbers | None = None,
    rotational: Numbers | None = None,
) -> LinearDamper:
    """PyElastica's `AnalyticalLinearDamper`, for `method=pyelastica()`.

    It takes PyElastica's `damping_constant`, or its two physical constants.
    PyElastica's `uniform_damping_constant` is `exponential_damping` here. Other methods
    refuse this damper when they step.

    Args:
        damping_constant: Decay rate of velocities [1/s]. The decay rate of spins is
            this times an element's mass over its inertia, in SI units.
        translational: Drag coefficient of every node [kg/s].
        rotational: Rotational drag coefficient of every element [N m s].

    Raises:
        ValueError: If a number is out of range, or neither the single constant nor both
            others are given.

    Example:
        >>> moving = replace(state, velocities=jnp.ones_like(state.velocities))
        >>> scene = jaxrod.make_scene(
        ...     rod, jaxrod.linear_damper(200.0), method=jaxrod.pyelastica()
        ... )
        >>> after = jaxrod.step(scene, moving, 5e-4)
        >>> round(float(after.velocities[0, 0]), 3)  # exp(-200 * 5e-4)
        0.905
    """
    one, two = damping_constant is not None, translational is not None
    if one == two or two != (rotational is not None):
        raise ValueError(
            "linear_damper takes damping_constant [1/s] alone, or translational [kg/s] "
            "and rotational [N m s]"
        )
    if one:
        rate = as_array("damping_constant", damping_constant, "1/s", non_negative=True)
        return LinearDamper(rate)
    assert translational is not None and rotational is not None
    return LinearDamper(
        as_array("translational", translational, "kg/s", non_negative=True),
        as_array("rotational", rotational, "N m s", non_negative=True),
    )
