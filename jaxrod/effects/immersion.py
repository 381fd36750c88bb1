"""Immersion in a fluid at rest: buoyancy, and added mass of fluid moved by a rod."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.effects.fluids import on_nodes
from jaxrod.effects.time import Timed, as_timed
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, check_kind


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
        """None: there are no couples that could change when elements rotate."""

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
            [m/s^2].
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
