r"""Consistent mode: a symplectic, second-order, momentum-conserving step.

The state's angular momentum $P$ is a world vector. Between kicks every element turns
as a free symmetric top, exactly: with transverse and polar inertia $J_1, J_3$,

$$R(t+s) = \exp\!\left(\frac{s P}{J_1}\right) R(t)\,
   \exp\!\left(s \left(\frac1{J_3} - \frac1{J_1}\right) (d_3\cdot P)\, e_3\right).$$

Kicks change $v$ and $P$ at fixed configuration: $v \mathrel{+}= s f/m$,
$P \mathrel{+}= s R c$. Drift, kick, drift is position Verlet.
"""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Array

from jaxrod import vectors
from jaxrod._pytree import pytree
from jaxrod.elasticity import ElasticLaw, elastic_law, internal_loads
from jaxrod.motion import Motion
from jaxrod.rod import RodState
from jaxrod.rotations import (
    directors,
    join_quaternion,
    multiply_quaternions,
    normalise,
    rotation_exp,
    sine_ratio_and_cosine,
    split_quaternion,
    to_world,
)
from jaxrod.scene import Scene, decay, external_loads, hold, hold_rates


@pytree
class ConsistentStepper:
    """Constants of the consistent step for one scene.

    Attributes:
        scene: The scene.
        law: Constants of the elastic law.
        inverse_masses: One over nodal mass [1/kg].
        inverse_inertia: One over transverse inertia [1/(kg m^2)].
        inertia_contrast: One over polar less one over transverse inertia.
    """

    scene: Scene
    law: ElasticLaw
    inverse_masses: Array
    inverse_inertia: Array
    inertia_contrast: Array

    @staticmethod
    def create(scene: Scene) -> ConsistentStepper:
        """Works out the constants once, outside the loop."""
        transverse, polar = scene.rod.inertias
        return ConsistentStepper(
            scene=scene,
            law=elastic_law(scene.rod),
            inverse_masses=1 / scene.rod.node_masses,
            inverse_inertia=1 / transverse,
            inertia_contrast=1 / polar - 1 / transverse,
        )

    def enter(self, state: RodState) -> Motion:
        """Takes a state apart and makes it respect the scene's constraints."""
        motion = Motion(
            position=vectors.split(state.positions),
            orientation=split_quaternion(state.orientations),
            velocity=vectors.split(state.velocities),
            spin=vectors.split(state.angular_momenta),
        )
        return hold_rates(self.scene, hold(self.scene, motion))

    def leave(self, motion: Motion) -> RodState:
        """Puts the state together again."""
        return RodState(
            positions=vectors.join(motion.position),
            orientations=join_quaternion(motion.orientation),
            velocities=vectors.join(motion.velocity),
            angular_momenta=vectors.join(motion.spin),
        )

    def drift(self, motion: Motion, dt: Array) -> Motion:
        """Moves nodes and turns elements freely for a time `dt` [s]."""
        q, momentum = motion.orientation, motion.spin
        axial = vectors.dot(directors(q)[2], momentum)
        half_twist = 0.5 * dt * self.inertia_contrast * axial
        sine_ratio, cosine = sine_ratio_and_cosine(half_twist * half_twist)
        sine = half_twist * sine_ratio
        w, x, y, z = multiply_quaternions(
            rotation_exp(vectors.scale(dt * self.inverse_inertia, momentum)), q
        )
        twisted = (
            w * cosine - z * sine,
            x * cosine + y * sine,
            y * cosine - x * sine,
            z * cosine + w * sine,
        )
        moved = replace(
            motion,
            position=vectors.add(motion.position, vectors.scale(dt, motion.velocity)),
            orientation=normalise(twisted),
        )
        return hold(self.scene, moved)

    def kick(self, motion: Motion, dt: Array) -> Motion:
        """Changes velocities and angular momenta by all loads over `dt` [s]."""
        internal = internal_loads(self.law, motion)
        assert internal.forces is not None and internal.couples is not None
        loads = external_loads(self.scene, motion, internal.forces, internal.couples)
        assert loads.forces is not None and loads.couples is not None
        gain = vectors.scale(dt * self.inverse_masses, loads.forces)
        couples = to_world(directors(motion.orientation), loads.couples)
        kicked = replace(
            motion,
            velocity=vectors.add(motion.velocity, gain),
            spin=vectors.add(motion.spin, vectors.scale(dt, couples)),
        )
        return decay(self.scene, hold_rates(self.scene, kicked), dt)
