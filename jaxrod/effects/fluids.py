r"""Fluids around a rod: drag, linear (Stokes) or quadratic, buoyancy and added mass.

The velocity relative to the flow has the components $w_\parallel$ along the rod and
$w_\perp$ across it. Linear and quadratic drag per length of rod are

$$f = -\zeta_\parallel w_\parallel - \zeta_\perp w_\perp, \qquad
  f = -\tfrac12\rho\, 2r\,[c_\perp |w_\perp| w_\perp + \pi c_\parallel |w_\parallel|
  w_\parallel],$$

and the couple of linear drag about the rod's axis is $-\zeta_\omega\omega_3$ per
length. This is resistive-force theory: the rod does not change the flow, and its parts
do not interact through it. `consistent()`, `planar()` and `torsion_free()` solve drag
together with the loads (`jaxrod.methods.drag_kick`), so it never limits the step.

PyElastica's slender-body drag is here for comparisons. On an element of current length
$\ell$ and radius $r$ of a rod of current length $L$,

$$F = -\frac{4\pi\eta\,\ell}{\ln(L/r)}\,(1 - \tfrac12 t t^T)\,v,$$

with $v$ the mass-weighted mean of its nodes' velocities; half of it acts on each node
(Gazzola et al., R. Soc. Open Sci. 5 (2018) 171628, eq. 4.13). It is a load, so it
limits the step.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.effects.base import Effect, Reach, StabilityBound
from jaxrod.effects.time import Timed, as_timed, at_clock, clock_at, is_schedule
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.drag import Drag, drag_loads
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static
from jaxrod.validation import (
    Numbers,
    as_array,
    check_kind,
    is_traced,
    numeric,
    with_parameters,
)


@pytree
class UniformFlow:
    """A flow with the same velocity everywhere.

    Example:
        >>> drag = fluids.stokes_drag(0.1, 0.2, flow=(0.0, 0.0, 1.0))
        >>> drag.flow.velocity.tolist()
        [0.0, 0.0, 1.0]
        >>> force = drag.loads(rod, motion).forces[2]
        >>> round(float(force.sum()), 3)  # the flow carries the rod along [N]
        0.2
    """

    velocity: Float[Array, "3"]
    """Velocity of the fluid, world frame [m/s]."""

    def at(self, points: Vec3) -> Vec3:
        """Velocity of the fluid at each point, world frame [m/s]."""
        x, y, z = (jnp.broadcast_to(v, points[0].shape) for v in self.velocity)
        return x, y, z


@pytree
class FlowField:
    """A flow given by a function of position.

    Example:
        >>> def shear(point, rate):
        ...     return jnp.array([rate * point[2], 0.0, 0.0])
        >>> flow = fluids.flow_field(shear, 3.0)
        >>> places = jnp.zeros(2), jnp.zeros(2), jnp.array([0.0, 0.5])
        >>> flow.at(places)[0].tolist()
        [0.0, 1.5]
    """

    parameters: Any
    """Traced numbers of the flow: any pytree of arrays and schedules."""
    function: Callable[[Any, Any], Any] = static()
    """Velocity of the fluid `(3,)` [m/s] at one point `(3,)` [m], world frame, as a
    function of the point and the parameters."""

    def at(self, points: Vec3) -> Vec3:
        """Velocity of the fluid at each point, world frame [m/s]."""
        at_each = jax.vmap(self.function, in_axes=(1, None), out_axes=1)
        found = at_each(jnp.stack(points), self.parameters)
        return found[0], found[1], found[2]


Flow = UniformFlow | FlowField


def flow_field(
    function: Callable[[Any, Any], ArrayLike], parameters: Any = ()
) -> FlowField:
    """A flow that varies in space, and in time if a parameter does.

    Args:
        function: Pure function from one point `(3,)` [m] and `parameters` to the
            velocity of the fluid there `(3,)`, world frame [m/s]. A program is compiled
            for each function, so reuse the same function.
        parameters: Traced numbers of the flow: any pytree of numbers and schedules,
            such as `jaxrod.schedules.time()`.

    Raises:
        ValueError: If the function does not give three numbers at a point, or a
            parameter is not a number that can be stored.
        TypeError: If `function` is not callable.

    Example:
        >>> def gust(point, size):
        ...     return jnp.array([0.0, size, 0.0])
        >>> growing = schedules.ramp(0.0, 2.0, duration=1.0)  # [m/s]
        >>> drag = fluids.stokes_drag(0.1, 0.2, flow=fluids.flow_field(gust, growing))
        >>> now = jaxrod.make_scene(rod, drag).at(0.5).effects[0]
        >>> round(float(now.loads(rod, motion).forces[1].sum()), 3)
        0.2
    """
    if not callable(function):
        raise TypeError(f"function must be callable, got {type(function).__name__}")

    def number(leaf: Any) -> Any:
        if is_schedule(leaf):
            return leaf
        return as_array("parameters", leaf, "", [np.shape(leaf)])

    dtype = jnp.result_type(float)
    numbers = jax.tree.map(number, parameters, is_leaf=is_schedule)
    point = jax.ShapeDtypeStruct((3,), dtype)
    now = at_clock(numbers, clock_at(0.0, dtype))
    got = jax.eval_shape(function, point, now)
    if getattr(got, "shape", None) != (3,):
        raise ValueError(
            "function must give one velocity of shape (3,) [m/s] at a point of shape "
            f"(3,), got {got}"
        )
    opened, held = with_parameters(function, jnp.zeros((3,), dtype), now)
    if opened is function:
        return FlowField(numbers, function)
    # Schedules stay schedules among the parameters.
    return FlowField((numbers, held[1]), opened)


def as_flow(flow: Flow | Timed | None) -> Flow | None:
    """Returns a flow or `None` unchanged, and a velocity [m/s] as a `UniformFlow`.

    Raises:
        ValueError: If the argument is none of these.
    """
    if flow is None or isinstance(flow, UniformFlow | FlowField):
        return flow
    return UniformFlow(as_timed("flow", flow, "m/s", (3,)))


@pytree
class FluidDrag(Effect):
    """Base class of drag in a fluid at rest or in a flow."""

    flow: Flow | None
    """Flow of the fluid; `None` for a fluid at rest."""

    reach: ClassVar[Reach] = "neighbours"

    @abstractmethod
    def drag(self, rod: Rod, motion: Motion) -> Drag:
        """Decay rates of velocity along and across the rod, relative to the fluid."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Drag as forces and couples, for methods that treat it as an explicit load."""
        return drag_loads(rod, motion, self.drag(rod, motion))

    def flow_at(self, motion: Motion) -> Vec3 | None:
        """Velocity of the fluid at the nodes [m/s]; `None` for a fluid at rest."""
        return None if self.flow is None else self.flow.at(motion.position)


@pytree
class StokesDrag(FluidDrag):
    """Drag in proportion to the speed; see `stokes_drag`.

    Example:
        >>> one, zero = jnp.ones(11), jnp.zeros(11)
        >>> moving = replace(motion, velocity=(one, zero, one))
        >>> drag = fluids.stokes_drag(along=0.1, across=0.2)
        >>> x, y, z = drag.loads(rod, moving).forces
        >>> round(float(x.sum()), 3), round(float(z.sum()), 3)  # 1 m/s, 1 m [N]
        (-0.1, -0.2)
    """

    along: Float[Array, "*n"]
    """Drag coefficient along the rod: force per length and speed [kg/(m s)]."""
    across: Float[Array, "*n"]
    """Drag coefficient across the rod: force per length and speed [kg/(m s)]."""
    turning: Float[Array, "*n"] | None
    """Drag coefficient about d3: couple per length and angular velocity [kg m/s];
    `None` if zero."""

    reach: ClassVar[Reach] = "neighbours"

    def drag(self, rod: Rod, motion: Motion) -> Drag:
        """Decay rates: drag coefficients over mass or inertia per length [1/s]."""
        masses, turning = rod.node_masses, None
        if self.turning is not None:
            about = self.turning / rod.rotary_inertia[-1]
            turning = about, jnp.zeros_like(about)
        return Drag(
            along=on_nodes(rod, self.along) / masses,
            across=on_nodes(rod, self.across) / masses,
            turning=turning,
            flow=self.flow_at(motion),
        )

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bounds of the drag on nodes and elements.

        They are the larger coefficient at each node and the rotational one of each
        element.
        """
        turning = self.turning
        return StabilityBound(
            node_drag=on_nodes(rod, jnp.maximum(self.along, self.across)),
            element_drag=None if turning is None else turning * rod.rest_lengths,
        )

    def resampled(self, rod: Rod, new_rod: Rod) -> StokesDrag:
        """The same drag, if its coefficients are uniform along the rod.

        Raises:
            ValueError: If a coefficient has one number per element.
        """
        if any(map(jnp.ndim, jax.tree.leaves(replace(self, flow=None)))):
            raise ValueError(
                "stokes_drag with numbers per element cannot be resampled to "
                "another number of elements"
            )
        return self


@pytree
class QuadraticDrag(FluidDrag):
    """Drag in proportion to the square of the speed; see `quadratic_drag`.

    Example:
        >>> water = fluids.quadratic_drag(1000.0, across=1.1)
        >>> water.drag(rod, motion).grows_with_speed
        True
    """

    density: Float[Array, ""]
    """Density of the fluid [kg/m^3]."""
    across: Float[Array, ""]
    """Drag coefficient across the rod, referred to its frontal area [1]."""
    along: Float[Array, ""]
    """Friction coefficient along the rod, referred to its surface [1]."""

    reach: ClassVar[Reach] = "neighbours"

    def drag(self, rod: Rod, motion: Motion) -> Drag:
        """Decay rates per speed: drag per squared speed over node masses [1/m]."""
        area = on_nodes(rod, self.density * rod.radii) / rod.node_masses
        still = jnp.zeros_like(self.density)
        return Drag(
            along=still,
            across=still,
            along_per_speed=jnp.pi * self.along * area,
            across_per_speed=self.across * area,
            flow=self.flow_at(motion),
        )


def on_nodes(rod: Rod, per_length: Array) -> Array:
    """Integrals of a quantity per length over elements, half on each of their nodes."""
    half = 0.5 * per_length * rod.rest_lengths
    return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)


# Factories that users call. They check their arguments and explain errors.


def stokes_drag(
    along: Numbers,
    across: Numbers,
    turning: Numbers = 0.0,
    *,
    flow: Flow | Timed | None = None,
) -> StokesDrag:
    """Drag in proportion to the speed, as in viscous fluid.

    `stokes_drag(*slender_cylinder(viscosity, length, radius))` is the drag of a thin
    rod in an unbounded fluid.

    Args:
        along: Force per length and speed along the rod, at least 0, one number or one
            per element `(n,)` [kg/(m s)].
        across: Force per length and speed across the rod, in the same form [kg/(m s)].
        turning: Couple per length and angular velocity about the axis [kg m/s]. If it
            is known to be 0 it is left out, as `torsion_free()` requires.
        flow: Velocity of the fluid, world frame `(3,)`, a schedule of it, or a
            `jaxrod.fluids.flow_field` [m/s]; at rest by default. Its vorticity is
            neglected in the couple.

    Returns:
        An effect to list in a scene; a scene may have one effect with drag.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> coefficients = fluids.slender_cylinder(1.0, length=1.0, radius=0.02)
        >>> drag = fluids.stokes_drag(*coefficients)
        >>> sinking = jaxrod.make_scene(rod, jaxrod.gravity(), drag)
        >>> bool(drag.across > drag.along)
        True
    """
    turns = _coefficient("turning", turning, "kg m/s")
    known_zero = not is_traced(turns) and not np.any(turns)
    return StokesDrag(
        flow=as_flow(flow),
        along=_coefficient("along", along, "kg/(m s)"),
        across=_coefficient("across", across, "kg/(m s)"),
        turning=None if known_zero else turns,
    )


def slender_cylinder(
    viscosity: Numbers, length: Numbers, radius: Numbers
) -> tuple[Array, Array, Array]:
    r"""Drag coefficients of a long straight cylinder in a viscous fluid.

    $$\zeta_\parallel = \frac{2\pi\eta}{\ln(L/r) - 0.807}, \quad
      \zeta_\perp = \frac{4\pi\eta}{\ln(L/r) + 0.193}, \quad
      \zeta_\omega = 4\pi\eta r^2,$$

    G. K. Batchelor, J. Fluid Mech. 44 (1970) 419, to first order in the inverse of the
    logarithm.

    Args:
        viscosity: Dynamic viscosity of the fluid [Pa s].
        length: Length of the cylinder, at least ten times its radius [m].
        radius: Radius of the cylinder [m].

    Returns:
        Coefficients along, across and of rotation, as `stokes_drag` takes them.

    Raises:
        ValueError: If a number is not positive, or the cylinder is not slender.

    Example:
        >>> size = dict(length=1.0, radius=0.01)
        >>> along, across, turning = fluids.slender_cylinder(viscosity=1.0, **size)
        >>> round(float(along), 3), round(float(across), 3), round(float(turning), 5)
        (1.654, 2.619, 0.00126)
    """
    eta = as_array("viscosity", viscosity, "Pa s", positive=True)
    long = as_array("length", length, "m", positive=True)
    thin = as_array("radius", radius, "m", positive=True)
    if not is_traced(long, thin) and not float(long) >= 10 * float(thin):
        raise ValueError(
            "length must be at least 10 times radius for a slender cylinder, got "
            f"{float(long):.3g} m and {float(thin):.3g} m"
        )
    slenderness = jnp.log(long / thin)
    turning = 4 * jnp.pi * eta * thin**2
    if not is_traced(turning) and not jnp.finfo(turning.dtype).tiny <= turning:
        raise ValueError(
            "radius must not be so small that the drag of turning is lost in "
            f"{turning.dtype}, got {float(thin):.3g} m"
        )
    return (
        2 * jnp.pi * eta / (slenderness - 0.807),
        4 * jnp.pi * eta / (slenderness + 0.193),
        turning,
    )


def quadratic_drag(
    density: Numbers,
    *,
    across: Numbers = 1.0,
    along: Numbers = 0.0,
    flow: Flow | Timed | None = None,
) -> QuadraticDrag:
    r"""Drag quadratic in the speed, as in water at higher Reynolds numbers.

    $$f = -\tfrac12\rho\,2r\,[c_\perp |w_\perp| w_\perp + \pi c_\parallel |w_\parallel|
      w_\parallel]$$

    per length of a round rod of radius $r$, the same in all directions across it. The
    radii are `rod.radii`.

    Args:
        density: Density of the fluid [kg/m^3].
        across: Drag coefficient across the rod, referred to its frontal area [1].
        along: Friction coefficient along the rod, referred to its surface [1]. A
            fiftieth of `across` fits the arm of an octopus (Yekutieli et al.,
            J. Neurophysiol. 94 (2005) 1443).
        flow: Velocity of the fluid, world frame `(3,)`, a schedule of it, or a
            `jaxrod.fluids.flow_field` [m/s]; at rest by default.

    Returns:
        An effect to list in a scene; a scene may have one effect with drag.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> zero = jnp.zeros(11)
        >>> rising = replace(motion, velocity=(zero, zero, zero + 1.0))
        >>> water = fluids.quadratic_drag(1000.0, across=1.1)
        >>> force = water.loads(rod, rising).forces[2]
        >>> round(float(force.sum()), 2)  # density, 1.1, radius, 1 m, (1 m/s)^2 [N]
        -22.0
    """
    return QuadraticDrag(
        flow=as_flow(flow),
        density=as_array("density", density, "kg/m^3", positive=True),
        across=as_array("across", across, "", non_negative=True),
        along=as_array("along", along, "", non_negative=True),
    )


def _coefficient(name: str, value: Numbers, unit: str) -> Array:
    """Validates a drag coefficient and returns it: one number, or one per element."""
    given = numeric(name, value, unit)
    if given.ndim > 1:
        raise ValueError(
            f"{name} must be one number or one per element, got shape {given.shape}"
        )
    return as_array(name, given, unit, [given.shape], non_negative=True)


@pytree
class SlenderBodyDrag(Effect):
    """PyElastica's `SlenderBodyTheory`; see `slender_body_drag`.

    Example:
        >>> one, zero = jnp.ones(11), jnp.zeros(11)
        >>> moving = replace(motion, velocity=(one, zero, one))
        >>> x, y, z = fluids.slender_body_drag(0.1).loads(rod, moving).forces
        >>> bool(z.sum() < x.sum() < 0)  # more drag across the rod than along it
        True
    """

    viscosity: Float[Array, ""]
    """Dynamic viscosity of the fluid [Pa s]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Drag of every element, half of it on each of its nodes."""
        lengths = motion.lengths
        radii = rod.radii * jnp.sqrt(rod.rest_lengths / lengths)
        tangent = vectors.scale(1 / lengths, motion.edges)
        masses = rod.node_masses
        x, y, z = (
            (masses[1:] * v[1:] + masses[:-1] * v[:-1]) / (masses[1:] + masses[:-1])
            for v in motion.velocity
        )
        along = vectors.scale(0.5 * vectors.dot(tangent, (x, y, z)), tangent)
        size = self._per_length(jnp.sum(lengths), radii) * lengths
        half = vectors.scale(-0.5 * size, vectors.subtract((x, y, z), along))
        return Loads(forces=vectors.pair_sum(half))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound of the drag on each node across the unstretched rod.

        The force of an element on a node of mass m1 is half the drag coefficient times
        the mean velocity, $(m_1 v_1 + m_2 v_2) / (m_1 + m_2)$. By Young's inequality
        the power of the forces on both nodes is at most half the drag coefficient times
        the sum of $(m_1 / (m_1 + m_2) + w / 2) v_1^2$ and
        $(m_2 / (m_1 + m_2) + 1 / (2 w)) v_2^2$. The weight $w$ distributes the mixed
        term in proportion to the masses, and equally among the elements at a node.
        """
        half = 0.5 * self._per_length(rod.length, rod.radii) * rod.rest_lengths
        masses = rod.node_masses
        both = masses[1:] + masses[:-1]
        met = vectors.pad(jnp.ones_like(half), 0, 1)
        met = met + vectors.pad(jnp.ones_like(half), 1, 0)
        root = jnp.sqrt(masses) / met
        weight = root[:-1] / root[1:]
        first = half * (masses[:-1] / both + 0.5 * weight)
        second = half * (masses[1:] / both + 0.5 / weight)
        return StabilityBound(
            node_drag=vectors.pad(first, 0, 1) + vectors.pad(second, 1, 0)
        )

    def _per_length(self, length: Array, radii: Array) -> Array:
        """Drag coefficient across, 4 pi viscosity / ln(length / radii) [kg/(m s)]."""
        return 4 * jnp.pi * self.viscosity / jnp.log(length / radii)


def slender_body_drag(viscosity: Numbers) -> SlenderBodyDrag:
    """PyElastica's `SlenderBodyTheory(dynamic_viscosity)`, for comparisons.

    `stokes_drag` has the same form, but its coefficients can be chosen and do not
    change when the rod stretches, and it does not limit the step.

    Args:
        viscosity: Dynamic viscosity of the fluid [Pa s].

    Raises:
        ValueError: If it is not positive.

    Example:
        >>> drag = fluids.slender_body_drag(viscosity=0.1)
        >>> in_fluid = jaxrod.make_scene(rod, drag, method=jaxrod.pyelastica())
        >>> round(float(in_fluid.effects[0].viscosity), 3)
        0.1
    """
    return SlenderBodyDrag(as_array("viscosity", viscosity, "Pa s", positive=True))


@pytree
class Buoyancy(Effect):
    """Buoyancy: upward force equal to the weight of the displaced fluid.

    Example:
        >>> lift = fluids.buoyancy(1000.0)
        >>> round(float(lift.loads(rod, motion).forces[2].sum()), 2)  # [N]
        12.32
    """

    density: Float[Array, ""]
    """Density of the fluid [kg/m^3]."""
    acceleration: Float[Array, "3"]
    """Gravitational acceleration, world frame [m/s^2]."""
    added_mass: Float[Array, ""]
    """Coefficient $C$ of the added mass that the rod's mass contains [1]."""

    def lifted(self, rod: Rod) -> Array:
        """Mass at each node whose weight buoyancy balances [kg].

        Per length it is `(1 + C) density pi radius^2`: the displaced fluid, and the
        added mass, which `gravity` pulls down although it has no weight.
        """
        displaced = self.density * jnp.pi * rod.radii**2
        return on_nodes(rod, (1 + self.added_mass) * displaced)

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Buoyant force on each node: minus its balanced mass times gravity."""
        masses, g = self.lifted(rod), self.acceleration
        return Loads(forces=(-masses * g[0], -masses * g[1], -masses * g[2]))

    def turning_tangent(self, rod: Rod, motion: Motion) -> None:
        """Returns `None`: there are no couples that change when elements rotate."""

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Potential energy: balanced mass times gravity times position [J]."""
        heights = jnp.sum(self.acceleration[:, None] * state.positions, axis=0)
        return jnp.sum(self.lifted(rod) * heights)


def buoyancy(
    density: Numbers,
    acceleration: Timed = (0.0, 0.0, -9.80665),
    *,
    added_mass: Numbers = 0.0,
) -> Buoyancy:
    """Buoyancy of a round rod under the surface of a fluid; list `gravity` as well.

    Args:
        density: Density of the fluid [kg/m^3].
        acceleration: Acceleration as for `gravity`, world frame `(3,)`, or a schedule
            of it [m/s^2].
        added_mass: Coefficient given to `with_added_mass`, if the rod has added mass
            [1]. That mass has inertia but no weight, and `gravity` does not know which
            part of the rod's mass it is.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> effects = jaxrod.gravity(), fluids.buoyancy(density=1000.0)
        >>> floating = jaxrod.make_scene(rod, *effects)
        >>> raised = replace(state, positions=state.positions + jnp.ones((3, 1)))
        >>> round(float(floating.potential_energy(raised)), 3)  # as dense as the fluid
        0.0
    """
    return Buoyancy(
        density=as_array("density", density, "kg/m^3", positive=True),
        acceleration=as_timed("acceleration", acceleration, "m/s^2", (3,)),
        added_mass=as_array("added_mass", added_mass, "", non_negative=True),
    )


def with_added_mass(rod: Rod, density: Numbers, coefficient: Numbers = 1.0) -> Rod:
    r"""The rod plus the mass of fluid that moves with it, $C\rho_f\pi r^2$ per length.

    The added mass is the same in all directions. That is right across the rod, where
    $C = 1$ for a circular section. It is wrong along the rod, where there is none:
    axial waves are slower by $\sqrt{1 + C\rho_f/\rho}$, which is seldom visible in
    slender rods. It is not a model of a rod that swims by the thrust of fluid that it
    pushes back (Lighthill's). The scene's momentum and kinetic energy count the added
    mass.

    Args:
        rod: The rod, of round section.
        density: Density of the fluid [kg/m^3].
        coefficient: $C$ [1].

    Raises:
        ValueError: If a number is out of range.
        TypeError: If `rod` is not a `Rod`.

    Example:
        >>> wet = fluids.with_added_mass(rod, density=1000.0)
        >>> round(float(wet.element_masses.sum() / rod.element_masses.sum()), 3)
        2.0
    """
    check_kind("rod", rod, Rod)
    dtype = rod.rest_lengths.dtype
    fluid = as_array("density", density, "kg/m^3", positive=True, dtype=dtype)
    share = as_array("coefficient", coefficient, "", non_negative=True, dtype=dtype)
    added = share * fluid * jnp.pi * rod.radii**2
    return replace(rod, linear_density=rod.linear_density + added)
