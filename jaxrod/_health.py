"""Numerical health of a state: is it one a simulation can be trusted to continue?

Inside a compiled program nothing raises: failure is data. Look at the flags after an
`advance` and go on from the last state that was sound:

    after = jaxrod.advance(scene, before, dt, 7)
    flagged = jaxrod.health(scene, after, dt).flagged
    state = jaxrod.freeze(flagged, before, after)

Nothing is clamped or repaired. Under `vmap` every rod of a batch has flags of its own,
and what becomes of one does not touch the others.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxrod import vectors
from jaxrod._pytree import pytree
from jaxrod.elasticity import joint_rotations
from jaxrod.rod import RodState, angular_velocities, check_size
from jaxrod.rotations import split_quaternion
from jaxrod.scene import Scene, total_energy

State = TypeVar("State")


@pytree
class HealthLimits:
    """Beyond these a state is flagged."""

    smallest_stretch: Float[Array, ""] | float = 0.3
    """Current over rest length of an element [1]."""
    largest_stretch: Float[Array, ""] | float = 2.5
    """Current over rest length of an element [1]."""
    largest_joint_angle: Float[Array, ""] | float = 2.5
    """Between neighbouring elements [rad]; no measure of rotation goes past pi."""
    largest_travel: Float[Array, ""] | float = 0.5
    """Distance a node moves in one step, over the radius [1]."""
    largest_turn: Float[Array, ""] | float = 1.0
    """Angle an element turns in one step [rad]."""


@pytree
class Health:
    """Flags and the measured values behind them, for one state."""

    finite: Bool[Array, ""]
    """Every number of the state is finite."""
    stretch: Bool[Array, ""]
    """Flag: an element is too short or too long."""
    joint_angle: Bool[Array, ""]
    """Flag: neighbouring elements are folded onto each other."""
    speed: Bool[Array, ""]
    """Flag: a node crosses more than half a radius per step."""
    spin: Bool[Array, ""]
    """Flag: an element turns more than a radian per step."""
    energy: Bool[Array, ""]
    """Flag: energy grew by more than the work that was put in allows."""
    smallest_stretch: Float[Array, ""]
    largest_stretch: Float[Array, ""]
    largest_joint_angle: Float[Array, ""]
    """[rad]"""
    largest_speed: Float[Array, ""]
    """[m/s]"""
    largest_spin: Float[Array, ""]
    """[rad/s]"""

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether anything is wrong."""
        return (
            ~self.finite
            | self.stretch
            | self.joint_angle
            | self.speed
            | self.spin
            | self.energy
        )


def health(
    scene: Scene,
    state: RodState,
    dt: ArrayLike,
    *,
    limits: HealthLimits | None = None,
    energy_before: ArrayLike | None = None,
    work_input: ArrayLike = 0.0,
) -> Health:
    """Examines a state. Cheap; works inside jit and vmap.

    Args:
        scene: The scene.
        state: The state to examine.
        dt: The step size in use [s].
        limits: What is tolerated.
        energy_before: Total energy at an earlier time [J]; without it energy is not
            examined.
        work_input: Work done on the rod since then by loads without a potential [J].

    Returns:
        The flags and the values behind them. Values that are not finite are flagged.

    Raises:
        ValueError: If the state is not of the scene's rod.
    """
    check_size(scene.rod, state)
    limits = HealthLimits() if limits is None else limits
    rod = scene.rod
    edges = vectors.inner_difference(vectors.split(state.positions))
    stretch = vectors.safe_norm(edges) / rod.rest_lengths
    rotation, _ = joint_rotations(split_quaternion(state.orientations))
    angle = jnp.max(vectors.safe_norm(rotation))
    speeds = vectors.safe_norm(vectors.split(state.velocities))
    spin = jnp.max(vectors.safe_norm(vectors.split(angular_velocities(rod, state))))
    travel = speeds * dt / jnp.min(rod.radii)
    finite = (
        jnp.all(jnp.isfinite(state.positions))
        & jnp.all(jnp.isfinite(state.orientations))
        & jnp.all(jnp.isfinite(state.velocities))
        & jnp.all(jnp.isfinite(state.angular_momenta))
    )
    if energy_before is None:
        grown = jnp.zeros((), bool)
    else:
        before = jnp.asarray(energy_before)
        allowed = 2 * jnp.abs(jnp.asarray(work_input)) + 1e-3 * jnp.abs(before)
        grown = ~(total_energy(scene, state) - before <= allowed)
    # Each comparison is written so that NaN counts as wrong.
    return Health(
        finite=finite,
        stretch=~(
            (jnp.min(stretch) >= limits.smallest_stretch)
            & (jnp.max(stretch) <= limits.largest_stretch)
        ),
        joint_angle=~(angle <= limits.largest_joint_angle),
        speed=~(jnp.max(travel) <= limits.largest_travel),
        spin=~(spin * dt <= limits.largest_turn),
        energy=grown,
        smallest_stretch=jnp.min(stretch),
        largest_stretch=jnp.max(stretch),
        largest_joint_angle=angle,
        largest_speed=jnp.max(speeds),
        largest_spin=spin,
    )


def freeze(flagged: Bool[Array, "*batch"], before: State, after: State) -> State:
    """The last sound state: `after`, but `before` where a flag rose.

    A rod that is frozen in every step from its first flag on stays as it was before
    that flag, bit for bit. Others are not touched.

    Args:
        flagged: From `health`; one for a state, or one for every entry of a batch.
        before: The state before the steps that were examined: any pytree of arrays
            whose leading axes are those of `flagged`.
        after: The state after them.

    Returns:
        A pytree like both.
    """

    def choose(old: Array, new: Array) -> Array:
        shape = flagged.shape + (1,) * (jnp.ndim(new) - flagged.ndim)
        return jnp.where(jnp.reshape(flagged, shape), old, new)

    return jax.tree.map(choose, before, after)
