"""Rigid bodies: members of a system, in addition to rods.

A body is one node and one element. Bodies support four hooks of an effect: `loads`,
`energy`, `damping_rates` and `stability_bound`. They have masses, but no lengths and no
radii. Effects that ask for these, or that return loads for the nodes of a rod, are
refused before the first step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxrod.analysis.health import HealthLimits
from jaxrod.contacts.bodies import Body, Solid
from jaxrod.effects.base import Effect, StabilityBound, added_bounds, remembers
from jaxrod.effects.own_classes import called_hook, check_own_class
from jaxrod.effects.time import at_clock, clock_at, depends_on_time
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.rods.motion import Motion
from jaxrod.structure import pytree
from jaxrod.systems.coupling import Carried, Parts
from jaxrod.systems.members.member import (
    Member,
    check_axes,
    check_fields,
    step_limit,
)
from jaxrod.systems.members.rigid_stepper import BodyState, RigidStepper
from jaxrod.systems.members.steppers import BodiesStepper, MemberStepper
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
class BodyHealth:
    """Flags of numerical faults in rigid bodies, and the values behind them."""

    finite: Bool[Array, ""]
    """Whether all numbers of the state, and their squares, are finite."""
    spin: Bool[Array, ""]
    """Flag: a body turns in one step by more than `HealthLimits.largest_turn`, one
    radian by default."""
    norm: Bool[Array, ""]
    """Flag: an orientation is not a unit quaternion."""
    largest_spin: Float[Array, ""]
    """Largest angular velocity [rad/s]."""
    largest_norm_error: Float[Array, ""]
    """Largest deviation of the squared norm of a quaternion from one [1]."""

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether a number is not finite, or one of the flags is set."""
        return ~self.finite | self.spin | self.norm


@pytree
class RigidBodies(Member):
    """Parameters of one or more rigid bodies of one shape. Every number is traced.

    The origin of a body's own frame is its centre of mass, and the axes of the frame
    are its principal axes of inertia.

    Example:
        >>> shape = shapes.sphere((0.0, 0.0, 0.0), radius=0.1)
        >>> ball, there = systems.rigid_body(shape, density=1000.0)
        >>> round(float(ball.masses[0]), 2), ball.principal_inertias.shape  # [kg]
        (4.19, (3, 1))
    """

    masses: Float[Array, " k"]
    """Mass of each body [kg]."""
    principal_inertias: Float[Array, "3 k"]
    """Moments of inertia about the body's axes [kg m^2]."""
    shape: Body | None = None
    """Surface in the body's own frame, the same for all; `None` for no surface."""
    effects: tuple[Effect, ...] = ()
    """Effects on the bodies, such as gravity. They may use masses and rates, but no
    lengths or radii."""

    # Effects use these attributes of the member on which they act: a body is one node
    # and one element.
    @property
    def n_elements(self) -> int:
        """Number of bodies: for effects each body is one element."""
        return self.masses.shape[-1]

    @property
    def node_masses(self) -> Float[Array, " k"]:
        """Mass of each body [kg]: for effects each body is one node."""
        return self.masses

    @property
    def dtype(self) -> Any:
        """Floating-point dtype of all numbers."""
        return self.masses.dtype

    @property
    def array_shape(self) -> tuple[int, ...]:
        """Shape of the masses, `(bodies,)`."""
        return jnp.shape(self.masses)

    def check(self, name: str) -> None:
        """Raises a ValueError or TypeError for a batch, or effects that need rods."""
        check_axes(name, "masses", self.array_shape, ("bodies",))
        check_body_effects(name, self)

    def with_effect(self, effect: Effect) -> RigidBodies:
        """Copy of the bodies with one more effect."""
        return replace(self, effects=(*self.effects, effect))

    def in_own_type(self, name: str) -> RigidBodies:
        """Copy of the bodies with the numbers of effects converted to their dtype."""
        where = f"effects of {name!r}"
        return replace(self, effects=in_type(self.dtype, where, self.effects))

    def check_state(self, name: str, state: Any, dtype: Any) -> None:
        """Raises a TypeError or a ValueError if a state is not of these bodies."""
        check_kind(f"state of {name!r}", state, BodyState)
        shape = (3, *self.array_shape)
        check_fields(name, state, shape, shape[-1], dtype, "angular_velocities")

    def parts(self) -> Parts:
        """Constants of the bodies, for couplings: each is one node and one element."""
        return Parts(
            node_masses=self.masses,
            inertias=self.principal_inertias,
            shape=self.shape,
            count=self.n_elements,
            is_rod=False,
            is_rigid=True,
        )

    def motion(self, state: Any) -> Motion:
        """Positions and rates in a state; `spin` is angular momentum, world frame."""
        return Motion(
            vectors.split(state.positions),
            split_quaternion(state.orientations),
            vectors.split(state.velocities),
            vectors.split(body_angular_momenta(self, state)),
        )

    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Integrator of the bodies, with the masses of attached nodes (`carried`)."""
        return BodiesStepper(RigidStepper.create(self, carried, dt))

    def momenta(self, state: Any) -> tuple[Array, Array]:
        """Momenta [kg m/s] and angular momenta [kg m^2/s] of bodies, world frame."""
        masses = self.masses[None]
        return masses * state.velocities, body_angular_momenta(self, state)

    def kinetic_energy(self, state: Any) -> Array:
        """Kinetic energy of translation and rotation [J].

        Example:
            >>> sphere = shapes.sphere((0.0, 0.0, 0.0), 0.1)
            >>> ball, start = systems.rigid_body(sphere, density=1000.0)
            >>> moving = replace(start, velocities=jnp.ones((3, 1)))
            >>> round(float(ball.kinetic_energy(moving)), 3)
            6.283
        """
        return body_kinetic_energy(self, state)

    def potential_energy(self, state: Any) -> Array:
        """Sum of the potential energies of the effects [J]."""
        total = jnp.zeros((), state.positions.dtype)
        bodies: Any = self
        for effect in self.effects:
            total = total + effect.energy(bodies, state)
        return total

    def momentum(self, state: Any) -> Array:
        """Total linear momentum, world frame [kg m/s].

        Example:
            >>> sphere = shapes.sphere((0.0, 0.0, 0.0), 0.1)
            >>> ball, start = systems.rigid_body(sphere, density=1000.0)
            >>> moving = replace(start, velocities=jnp.ones((3, 1)))
            >>> print(ball.momentum(moving).round(3))
            [4.189 4.189 4.189]
        """
        return jnp.sum(self.masses[None] * state.velocities, axis=1)

    def angular_momentum(self, state: Any) -> Array:
        """Total angular momentum about the origin, world frame [kg m^2/s]."""
        orbital = vectors.cross(
            vectors.split(state.positions),
            vectors.scale(self.masses, vectors.split(state.velocities)),
        )
        own = body_angular_momenta(self, state)
        return jnp.sum(vectors.join(orbital) + own, axis=1)

    def health(self, state: Any, dt: ArrayLike, limits: HealthLimits) -> BodyHealth:
        """Flags of numerical faults in a state, and the values behind them."""
        spins = vectors.safe_norm(vectors.split(state.angular_velocities))
        norms = jnp.abs(jnp.sum(state.orientations**2, axis=0) - 1)
        spin, norm = jnp.max(spins), jnp.max(norms)
        squares = jnp.sum(state.positions**2) + jnp.sum(state.velocities**2)
        return BodyHealth(
            finite=jnp.isfinite(squares + spin + norm),
            spin=~((spin * dt <= limits.largest_turn) & (jnp.asarray(dt) > 0)),
            norm=~(norm <= limits.largest_norm_error),
            largest_spin=spin,
            largest_norm_error=norm,
        )

    def stable_step(self, bound: StabilityBound, safety: ArrayLike) -> tuple[Any, Any]:
        """Largest stable step times the factor `safety` [s], and `None`.

        Springs and dashpots of couplings (`bound`) and of effects limit it. `None`
        takes the place of the `StableStep` of rods.
        """
        bodies: Any = self
        for effect in self.effects:
            own = effect.stability_bound(bodies)
            bound = bound if own is None else added_bounds(bound, own)
        least = jnp.min(self.principal_inertias, axis=0)
        one = jnp.ones((), self.dtype)
        nodes, elements = bound.drags(one, one)
        moving = step_limit(self.masses, bound.nodes, nodes)
        turning = step_limit(least, bound.elements, elements)
        limit = jnp.min(jnp.minimum(moving, turning))
        return jnp.asarray(safety) * limit, None


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
        shape: A `jaxrod.shapes.sphere`, `capsule`, `cylinder` or `box`; or another body
            with `mass`, `inertia` and its centre of mass at the origin; or `None`.
        density: Mass density of the shape [kg/m^3].
        mass: Mass [kg], in place of a density.
        inertia: Principal moments of inertia `(3,)` [kg m^2]; by default those of the
            shape at uniform density.
        effects: Effects on the body, such as `gravity()` or `exponential_damping`.
        position: Centre of mass, world frame `(3,)` [m].
        orientation: Orientation of the principal axes, a quaternion (w, x, y, z).
        velocity: Velocity of the centre of mass, world frame `(3,)` [m/s].
        angular_velocity: Angular velocity, world frame `(3,)` [rad/s].
        dtype: float32 or float64; by default JAX's default.

    Returns:
        The body, as `RigidBodies` with one entry, and its state.

    Raises:
        ValueError: If mass or inertia are missing, not positive or impossible (a moment
            above the sum of the two others), or if both mass and density are given.
        TypeError: If the shape is not a `Body`, or an effect is not an `Effect`.

    Example:
        >>> shape = shapes.box((0.0, 0.0, 0.5), half_lengths=(0.1, 0.1, 0.2))
        >>> block, there = systems.rigid_body(shape, mass=3.0)
        >>> there.positions[:, 0].tolist()
        [0.0, 0.0, 0.5]
        >>> print(block.principal_inertias[:, 0].round(3))  # [kg m^2]
        [0.05 0.05 0.02]
    """
    dtype = check_dtype(dtype)
    if shape is not None:
        check_kind("shape", shape, Body)
        if shape.count is not None:
            raise ValueError("shape must be one body; for many use several members")
    solid = None if shape is None else shape.solid()
    total, moments = _inertia(solid, density, mass, inertia, dtype)
    place = _place(solid, position, orientation, dtype)
    if not isinstance(effects, tuple | list):
        raise TypeError(
            "effects must be a tuple of effects, such as (jaxrod.gravity(),), got "
            f"{type(effects).__name__}"
        )
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
    """Mass [kg] and principal moments of inertia `(3,)` [kg m^2], validated.

    They are the given values, or else those of the solid.
    """
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
                "inertia [kg m^2] is needed unless the shape is a sphere, capsule, "
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
                "inertia of a body must have no moment above the sum of the two "
                f"others, got {np.asarray(checked).tolist()} kg m^2"
            )
    return total.astype(dtype), jnp.asarray(checked, dtype)


def _place(
    solid: Solid | None,
    position: Numbers | None,
    orientation: Numbers | None,
    dtype: Any,
) -> tuple[Array, Array]:
    """Centre of mass `(3,)` [m] and unit quaternion: as given, or of the solid."""
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
    """Sum of 1/2 m |v|^2 + 1/2 w . I w over all bodies [J]."""
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
        TypeError: If an entry is not a pair of `RigidBodies` and `BodyState`.

    Example:
        >>> def ball(height):
        ...     shape = shapes.sphere((0.0, 0.0, height), radius=0.1)
        ...     return systems.rigid_body(shape, density=1000.0)
        >>> balls, there = systems.stacked_bodies(ball(0.1), ball(0.5), ball(0.9))
        >>> balls.masses.shape, there.positions.shape
        ((3,), (3, 3))
    """
    if not bodies:
        raise ValueError("bodies must contain at least one body, got none")
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


_OF_RODS = (
    "loads_after",
    "constrain",
    "constrain_rates",
    "dissipate",
    "after_step",
    "drag",
)
"""Hooks of effects that act on a rod but would do nothing to a body."""


def check_body_effects(name: str, bodies: Any) -> None:
    """Validates that all effects on bodies can act on them.

    Args:
        name: Name of the member, for messages.
        bodies: The `RigidBodies`.

    Raises:
        ValueError: If an effect does not act on bodies; the message names member and
            effect.
        TypeError: If an effect is not an instance of `Effect`.
    """
    for effect in bodies.effects:
        check_kind(f"member {name!r}: effect", effect, Effect)
        check_own_class(effect, Effect, "an effect")
        kind = type(effect)
        for hook in _OF_RODS:
            if getattr(kind, hook) is not getattr(Effect, hook):
                raise _unfit(name, effect, f"it has {hook}, which bodies do not use")
        if remembers((effect,)):
            raise _unfit(
                name, effect, "it has memory, which effects on bodies cannot have"
            )
        if kind.damping_rates is not Effect.damping_rates and depends_on_time(effect):
            raise ValueError(
                f"member {name!r}: {kind.__name__} has damping rates, so it must not "
                "depend on time: a run computes them once"
            )
        _try(name, effect, bodies)


def _try(name: str, effect: Effect, bodies: Any) -> None:
    """Raises a ValueError unless all four hooks of an effect work for bodies.

    The hooks are traced, not computed. They must raise no error and return one number,
    or one per body.
    """
    count, dtype = bodies.n_elements, bodies.masses.dtype

    def asked(bodies: Any) -> Any:
        own = at_clock(effect, clock_at(0.0, dtype))
        rows = jnp.zeros((3, count), dtype)
        turns = jnp.concatenate([rows[:1] + 1, rows])
        zero = vectors.split(rows)
        motion = Motion(zero, split_quaternion(turns), zero, zero)
        state: Any = BodyState(rows, turns, rows, rows)
        given = {
            "loads": (bodies, motion),
            "energy": (bodies, state),
            "damping_rates": (bodies,),
            "stability_bound": (bodies,),
        }
        answers = []
        for hook, arguments in given.items():
            with called_hook(own, hook):
                answers.append(getattr(own, hook)(*arguments))
        return tuple(answers)

    try:
        loads, energy, rates, bound = jax.eval_shape(asked, bodies)
    except Exception as error:
        # Any exception counts: an effect may use any attribute of a rod.
        raise _unfit(name, effect, f"{type(error).__name__}: {error}") from error
    for what, found in (("forces", loads.forces), ("couples", loads.couples)):
        shapes = {jnp.shape(component) for component in found or ()}
        if shapes - {(count,), ()}:
            raise _unfit(
                name,
                effect,
                f"its {what} are of shape {max(shapes)}, and there are {count} bodies",
            )
    if jnp.shape(energy) != ():
        raise _unfit(name, effect, f"its energy is of shape {jnp.shape(energy)}")
    for rate in rates or ():
        if jnp.shape(rate) not in ((), (count,)):
            raise _unfit(name, effect, f"its rates are of shape {jnp.shape(rate)}")
    for part in jax.tree.leaves(bound):
        if jnp.shape(part) not in ((), (count,)):
            raise _unfit(name, effect, f"its bounds are of shape {jnp.shape(part)}")


def _unfit(name: str, effect: Effect, why: str) -> ValueError:
    return ValueError(
        f"member {name!r}: {type(effect).__name__} does not act on rigid bodies "
        f"({why}); gravity and exponential_damping do. For contact with walls and the "
        "floor give make_system a rigid_contact, with rods a body_contact"
    )
