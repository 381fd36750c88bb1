"""Rigid bodies: members of a system, in addition to rods."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body
from jaxrod.effects.base import Effect
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    directors_from_orientations,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.structure import pytree
from jaxrod.systems.members.solids import Solid, solid_of
from jaxrod.validation import (
    Numbers,
    as_array,
    check_array,
    check_dtype,
    check_held,
    check_kind,
    in_type,
    is_traced,
)


@pytree
class RigidBodies:
    """Parameters of one or more rigid bodies of one shape. Every number is traced.

    The origin of a body's own frame is its centre of mass, and the axes of the frame
    are its principal axes of inertia.
    """

    masses: Float[Array, " k"]
    """Mass of each body [kg]."""
    principal_inertias: Float[Array, "3 k"]
    """Moments of inertia about the body's axes [kg m^2]."""
    shape: Body | None = None
    """Surface in the body's own frame, the same for all; `None` for no surface."""
    effects: tuple[Effect, ...] = ()
    """Effects on the bodies: only those that ask for nothing but masses and rates."""

    # Effects ask for these of the member on which they act: a body is one node and one
    # element.
    @property
    def n_elements(self) -> int:
        """Number of bodies."""
        return self.masses.shape[-1]

    @property
    def node_masses(self) -> Float[Array, " k"]:
        """Mass of each body [kg]."""
        return self.masses


@pytree
class BodyState:
    """State of rigid bodies."""

    positions: Float[Array, "3 k"]
    """Centres of mass, world frame [m]."""
    orientations: Float[Array, "4 k"]
    """Unit quaternions (w, x, y, z), body to world."""
    velocities: Float[Array, "3 k"]
    """Velocities of the centres of mass, world frame [m/s]."""
    angular_velocities: Float[Array, "3 k"]
    """Angular velocities, world frame [rad/s]."""

    @property
    def rates(self) -> tuple[Array, Array]:
        """Velocities and angular velocities."""
        return self.velocities, self.angular_velocities

    def with_rates(self, velocities: Array, spins: Array) -> BodyState:
        """The state with other rates."""
        return replace(self, velocities=velocities, angular_velocities=spins)

    @property
    def directors(self) -> Float[Array, "3 3 k"]:
        """Body axes: `[i, j]` is world component j of axis i."""
        return directors_from_orientations(self.orientations)


def rigid_body(
    shape: Body | None = None,
    *,
    density: Numbers | None = None,
    mass: Numbers | None = None,
    inertia: Numbers | None = None,
    effects: tuple[Effect, ...] = (),
    position: Numbers | None = None,
    orientation: Numbers | None = None,
    velocity: Numbers = (0.0, 0.0, 0.0),
    angular_velocity: Numbers = (0.0, 0.0, 0.0),
    dtype: Any = None,
) -> tuple[RigidBodies, BodyState]:
    """A rigid body and its state.

    Its pose is that of the shape, unless `position` and `orientation` are given.

    Args:
        shape: A `jaxrod.sphere`, `capsule`, `cylinder` or `box`; or another body with
            `mass`, `inertia` and its centre of mass at the origin; or `None`.
        density: Mass density of the shape [kg/m^3].
        mass: Mass [kg], in place of a density.
        inertia: Principal moments of inertia `(3,)` [kg m^2]; by default those of the
            shape at uniform density.
        effects: Effects on the body, such as `gravity()` or `exponential_damping`.
        position: Centre of mass `(3,)` [m].
        orientation: Orientation of the principal axes, a quaternion (w, x, y, z).
        velocity: Velocity of the centre of mass `(3,)` [m/s].
        angular_velocity: Angular velocity, world frame `(3,)` [rad/s].
        dtype: float32 or float64; by default JAX's default.

    Returns:
        The body, as `RigidBodies` with one entry, and its state.

    Raises:
        ValueError: If mass or inertia are missing, not positive or impossible (a moment
            above the sum of the two others), or if both mass and density are given.
        TypeError: If the shape is not a body, or an effect is not an effect.
    """
    dtype = check_dtype(dtype)
    if shape is not None:
        check_kind("shape", shape, Body)
        if shape.count is not None:
            raise ValueError("shape must be one body; for many use several members")
    solid = None if shape is None else solid_of(shape)
    total, moments = _inertia(solid, density, mass, inertia, dtype)
    place = _place(solid, position, orientation, dtype)
    for effect in effects:
        check_kind("effect", effect, Effect)
    body = RigidBodies(
        masses=total[None],
        principal_inertias=moments[:, None],
        shape=None if solid is None else in_type(dtype, "shape", solid.shape),
        effects=tuple(effects),
    )
    state = BodyState(
        positions=place[0][:, None],
        orientations=place[1][:, None],
        velocities=as_array("velocity", velocity, "m/s", [(3,)], dtype=dtype)[:, None],
        angular_velocities=as_array(
            "angular_velocity", angular_velocity, "rad/s", [(3,)], dtype=dtype
        )[:, None],
    )
    return body, state


def _inertia(
    solid: Solid | None,
    density: Numbers | None,
    mass: Numbers | None,
    inertia: Numbers | None,
    dtype: Any,
) -> tuple[Array, Array]:
    """Mass and principal moments of inertia."""
    if (density is None) == (mass is None):
        raise ValueError("a rigid body needs a density [kg/m^3] or a mass [kg]")
    filled = solid is not None and solid.volume is not None
    if density is not None:
        if not filled:
            raise ValueError(
                "a density needs a sphere, capsule, cylinder or box; give a mass [kg] "
                "and an inertia [kg m^2]"
            )
        assert solid is not None and solid.volume is not None
        total = solid.volume * as_array(
            "density", density, "kg/m^3", positive=True, dtype=dtype
        )
    else:
        assert mass is not None
        total = as_array("mass", mass, "kg", positive=True, dtype=dtype)
    if inertia is None:
        if not filled:
            raise ValueError(
                "inertia [kg m^2] is needed where the shape is no sphere, capsule, "
                "cylinder or box"
            )
        assert solid is not None and solid.gyration is not None
        moments = total * solid.gyration
        for name, value, unit in (
            ("mass", total, "kg"),
            ("inertia", moments, "kg m^2"),
        ):
            if not is_traced(value):
                known = np.asarray(value, np.float64)
                check_held(f"{name} of the shape", known, unit, dtype, each=True)
        return total.astype(dtype), moments.astype(dtype)
    checked = check_array(
        "inertia", inertia, [(3,)], "kg m^2", positive=True, dtype=dtype
    )
    if not is_traced(checked):
        largest = float(np.max(checked))
        if largest > (1 + 1e-6) * (float(np.sum(checked)) - largest):
            raise ValueError(
                "inertia must be of a body: no moment above the sum of the two others, "
                f"got {np.asarray(checked).tolist()} kg m^2"
            )
    return total.astype(dtype), jnp.asarray(checked, dtype)


def _place(
    solid: Solid | None,
    position: Numbers | None,
    orientation: Numbers | None,
    dtype: Any,
) -> tuple[Array, Array]:
    """Centre of mass and orientation."""
    if position is None:
        centre = jnp.zeros(3, dtype) if solid is None else solid.centre.astype(dtype)
    else:
        centre = as_array("position", position, "m", [(3,)], dtype=dtype)
    if orientation is None:
        identity = jnp.asarray((1.0, 0.0, 0.0, 0.0), dtype)
        return centre, identity if solid is None else solid.orientation.astype(dtype)
    given = check_array("orientation", orientation, [(4,)], "", dtype=dtype)
    if not is_traced(given) and not np.any(given):
        raise ValueError("orientation must not be zero, got (0, 0, 0, 0)")
    if not is_traced(given):
        # Squares of large numbers would overflow in a narrow type.
        given = given / np.max(np.abs(given))
    quaternion = jnp.asarray(given, dtype)
    return centre, quaternion / jnp.sqrt(jnp.sum(quaternion**2))


def body_kinetic_energy(bodies: RigidBodies, state: BodyState) -> Float[Array, ""]:
    """Kinetic energy of translation and rotation [J]."""
    translation = 0.5 * jnp.sum(bodies.masses[None] * state.velocities**2)
    frame = directors(split_quaternion(state.orientations))
    own = jnp.stack(to_material(frame, vectors.split(state.angular_velocities)))
    return translation + 0.5 * jnp.sum(bodies.principal_inertias * own**2)


def body_angular_momenta(bodies: RigidBodies, state: BodyState) -> Float[Array, "3 k"]:
    """Angular momentum of each body about its centre, world frame [kg m^2/s]."""
    frame = directors(split_quaternion(state.orientations))
    own = to_material(frame, vectors.split(state.angular_velocities))
    moments = vectors.split(bodies.principal_inertias)
    return vectors.join(to_world(frame, vectors.multiply(moments, own)))


def stacked_bodies(
    *bodies: tuple[RigidBodies, BodyState],
) -> tuple[RigidBodies, BodyState]:
    """Several bodies of equal shape as one member.

    Args:
        *bodies: Pairs of a body and its state from `rigid_body`, at least one.

    Raises:
        ValueError: If there are none.
        TypeError: If something else is given.
    """
    if not bodies:
        raise ValueError("bodies must be at least one, got none")
    for body, state in bodies:
        check_kind("body", body, RigidBodies)
        check_kind("state", state, BodyState)
    first = bodies[0][0]

    def joined(*leaves: Array) -> Array:
        return jnp.concatenate(leaves, axis=-1)

    parameters = replace(
        first,
        masses=joined(*(body.masses for body, _ in bodies)),
        principal_inertias=joined(*(body.principal_inertias for body, _ in bodies)),
    )
    leaves = [
        joined(*(getattr(state, name) for _, state in bodies))
        for name in ("positions", "orientations", "velocities", "angular_velocities")
    ]
    return parameters, BodyState(*leaves)
