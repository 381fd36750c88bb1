"""Gravity, loads on an end, uniform loads, and exponential damping.

All except damping may be schedules of time: see `jaxrod.schedules.ramp`, `sine` and
`table`.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, Reach, StabilityBound
from jaxrod.effects.ends import End, at_end, check_end, only_at_end, place
from jaxrod.effects.time import Timed, as_timed
from jaxrod.effects.unlikely import warn_of_weight
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array


@pytree
class Gravity(Effect):
    """Uniform gravity: force `m g` on every node.

    Example:
        >>> moon = jaxrod.gravity((0.0, 0.0, -1.62))
        >>> raised = replace(state, positions=state.positions + jnp.ones((3, 1)))
        >>> gained = moon.energy(rod, raised) - moon.energy(rod, state)
        >>> round(float(gained), 3)  # mass, 1.62 m/s^2, 1 m [J]
        2.036
    """

    acceleration: Float[Array, "3"]
    """Gravitational acceleration, world frame [m/s^2]."""

    @property
    def gravitational_field(self) -> Array:
        """Gravitational acceleration, world frame [m/s^2]."""
        return self.acceleration

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Weights of the nodes, m g."""
        masses = rod.node_masses
        g = self.acceleration
        return Loads(forces=(masses * g[0], masses * g[1], masses * g[2]))

    def check(self, rod: Rod) -> None:
        """Warns if the weight of the rod would stretch it tenfold."""
        warn_of_weight(rod, self.acceleration)

    def turning_tangent(self, rod: Rod, motion: Motion) -> None:
        """Returns `None`: there are no couples that change when elements rotate."""

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Potential energy, minus the sum of m g . x over the nodes [J]."""
        heights = jnp.sum(self.acceleration[:, None] * state.positions, axis=0)
        return -jnp.sum(rod.node_masses * heights)


@pytree
class EndLoad(Effect):
    """Force and couple on one end of the rod, constant in the world frame (dead loads).

    Example:
        >>> load = jaxrod.end_load((0.0, 0.0, -2.0), end="base")
        >>> load.end, load.force.tolist()
        ('base', [0.0, 0.0, -2.0])
    """

    force: Float[Array, "3"]
    """Force on the end node, world frame [N]."""
    couple: Float[Array, "3"]
    """Couple on the end element, world frame [N m]."""
    end: End = static(default="tip")
    """End of the rod that is loaded, "base" or "tip"."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Force on the end node and couple on the end element."""
        frame = directors(at_end(motion.orientation, self.end))
        couple = to_material(frame, vectors.split(self.couple))
        return self._at_end(rod, vectors.split(self.force), couple)

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Returns `None`: world-frame couples do not change when elements rotate."""
        return None

    def _at_end(self, rod: Rod, force: Vec3, couple: Vec3) -> Loads:
        """Loads of a world force [N] and a material couple [N m] on one end."""
        return Loads(
            forces=only_at_end(force, rod.n_elements + 1, self.end),
            couples=only_at_end(couple, rod.n_elements, self.end),
        )


@pytree
class FollowerEndLoad(EndLoad):
    """Force and couple on one end of the rod, constant in the frame of its end element.

    Both are components in that material frame. They have no potential.
    """

    reach: ClassVar[Reach] = "neighbours"

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Force on the end node, rotated with the end element, and couple."""
        frame = directors(at_end(motion.orientation, self.end))
        force = to_world(frame, vectors.split(self.force))
        return self._at_end(rod, force, vectors.split(self.couple))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness that the force adds because it turns with the end."""
        index = 0 if self.end == "base" else -1
        size = jnp.sqrt(jnp.sum(self.force**2))
        # The coupling is force times rotation times displacement. By Young's inequality
        # it is at most half of the sum of both squares, with a length as weight that
        # balances mass and rotary inertia.
        least = jnp.min(rod.inertias[:, index])
        scale = jnp.sqrt(least / rod.node_masses[index])
        return StabilityBound(
            nodes=place(size / scale, rod.n_elements + 1, self.end),
            elements=place(size * scale, rod.n_elements, self.end),
        )

    @property
    def twists(self) -> str | None:
        """Name of the option `follower`, for the error of methods without twist."""
        return "follower=True"


@pytree
class UniformLoad(Effect):
    """Force and couple per rest length, constant in the world frame (dead loads)."""

    force_per_length: Float[Array, "3"]
    """Force per rest length, world frame [N/m]."""
    couple_per_length: Float[Array, "3"]
    """Couple per rest length, world frame [N m/m]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Half the force on an element at each of its nodes; couples on elements."""
        forces, couples = self._on_elements(rod)
        return Loads(
            forces=vectors.pair_sum(forces),
            couples=to_material(directors(motion.orientation), couples),
        )

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Returns `None`: world-frame couples do not change when elements rotate."""
        return None

    def _on_elements(self, rod: Rod) -> tuple[Vec3, Vec3]:
        """Half of the force [N], and the couple [N m], on each element.

        Both are in the frame in which the loads are given.
        """
        lengths = rod.rest_lengths
        f, c = self.force_per_length, self.couple_per_length
        forces = (0.5 * lengths * f[0], 0.5 * lengths * f[1], 0.5 * lengths * f[2])
        return forces, (lengths * c[0], lengths * c[1], lengths * c[2])


@pytree
class FollowerLoad(UniformLoad):
    """Force and couple per rest length, constant in the frames of the elements.

    Both are components in the material frame. They have no potential.
    """

    reach: ClassVar[Reach] = "neighbours"

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces rotated with the elements, half at each of their nodes; couples."""
        forces, couples = self._on_elements(rod)
        turned = to_world(directors(motion.orientation), forces)
        return Loads(forces=vectors.pair_sum(turned), couples=couples)

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness that forces add because they turn with elements."""
        size = jnp.sqrt(jnp.sum(self.force_per_length**2)) * rod.rest_lengths
        # The coupling is force times rotation times displacement. By Young's inequality
        # it is at most half of the sum of both squares, with lengths as weights that
        # balance mass and rotary inertia.
        least = jnp.min(rod.inertias, axis=0)
        scale = jnp.sqrt(least / rod.element_masses)
        across = 0.5 * size / scale
        turning = size * scale
        nodes = vectors.pad(across, 0, 1) + vectors.pad(across, 1, 0)
        return StabilityBound(nodes=nodes, elements=turning)

    @property
    def twists(self) -> str | None:
        """Name of the option `follower`, for the error of methods without twist."""
        return "follower=True"


@pytree
class ExponentialDamping(Effect):
    r"""Linear damping: without loads, velocities and spins decay exponentially.

    $\dot v = f/m - g_t v$ and $\dot P = c - g_r P$, for velocities $v$ under forces $f$
    and angular momenta $P$ under couples $c$. `consistent()`, `planar()` and
    `torsion_free()` solve these equations exactly in each step, with loads held
    constant. That is second order, stable, and gives the right terminal velocity
    however large the decay rates are. `pyelastica()` multiplies velocities and angular
    velocities by $e^{-g h}$ after the loads have changed them, with $g$ the decay rate
    and $h$ the step size, as PyElastica's `AnalyticalLinearDamper` does.
    """

    translational_rate: Float[Array, ""]
    """Decay rate $g_t$ of velocities [1/s]."""
    rotational_rate: Float[Array, ""]
    """Decay rate $g_r$ of spins: angular momenta, or angular velocities with
    `pyelastica()` [1/s]."""

    def damping_rates(self, rod: Rod) -> tuple[Array, Array]:
        """Decay rates of velocities and of spins [1/s]."""
        return self.translational_rate, self.rotational_rate


# Factories that users call. They check their arguments and explain errors.


def gravity(acceleration: Timed = (0.0, 0.0, -9.80665)) -> Gravity:
    """Uniform gravity.

    Args:
        acceleration: Acceleration, world frame `(3,)`, or a schedule of it [m/s^2].

    Raises:
        ValueError: If the acceleration is not three finite numbers.

    Example:
        >>> moon = jaxrod.gravity((0.0, 0.0, -1.62))
        >>> scene = jaxrod.make_scene(rod, jaxrod.clamp(state), moon)
        >>> round(float(scene.effects[1].acceleration[2]), 3)
        -1.62
    """
    return Gravity(as_timed("acceleration", acceleration, "m/s^2", (3,)))


def end_load(
    force: Timed = (0.0, 0.0, 0.0),
    couple: Timed = (0.0, 0.0, 0.0),
    *,
    end: End = "tip",
    follower: bool = False,
) -> EndLoad:
    """Force and couple on one end of a rod.

    Args:
        force: Force on the end node `(3,)`, or a schedule of it [N]; in the world
            frame, or in the material frame of the end element if `follower`.
        couple: Couple on the end element `(3,)`, or a schedule of it, in the same frame
            [N m].
        end: "base" or "tip".
        follower: Whether force and couple turn with the end element. Then a force
            along d3 stays along the rod, and one along d1 or d2 stays across it. If
            only one of them is to turn, list two loads.

    Raises:
        ValueError: If there is no such end, or a load is not three finite numbers.

    Example:
        >>> pull = schedules.ramp((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), duration=4.0)
        >>> scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.end_load(pull))
        >>> scene.at(1.0).effects[1].force.tolist()
        [0.5, 0.0, 0.0]
    """
    kind = FollowerEndLoad if follower else EndLoad
    return kind(
        force=as_timed("force", force, "N", (3,)),
        couple=as_timed("couple", couple, "N m", (3,)),
        end=check_end(end),
    )


def uniform_load(
    force_per_length: Timed = (0.0, 0.0, 0.0),
    couple_per_length: Timed = (0.0, 0.0, 0.0),
    *,
    follower: bool = False,
) -> UniformLoad:
    """Force and couple per rest length, uniform along a rod.

    Args:
        force_per_length: Force per rest length `(3,)`, or a schedule of it [N/m]; in
            the world frame, or in the material frame if `follower`.
        couple_per_length: Couple per rest length `(3,)`, or a schedule of it, in the
            same frame [N m/m].
        follower: Whether force and couple turn with the elements.

    Raises:
        ValueError: If a load is not three finite numbers.

    Example:
        >>> wind = jaxrod.uniform_load((0.0, 0.5, 0.0))  # [N/m]
        >>> scene = jaxrod.make_scene(rod, wind)
        >>> after = jaxrod.step(scene, state, 1e-4)
        >>> round(float(scene.momentum(after)[1] / 1e-4), 3)  # on 1 m of rod [N]
        0.5
    """
    kind = FollowerLoad if follower else UniformLoad
    return kind(
        as_timed("force_per_length", force_per_length, "N/m", (3,)),
        as_timed("couple_per_length", couple_per_length, "N m/m", (3,)),
    )


def exponential_damping(
    translational_rate: Numbers, rotational_rate: Numbers | None = None
) -> ExponentialDamping:
    """Exponential decay of velocities and spins.

    Args:
        translational_rate: Decay rate of velocities, at least 0 [1/s].
        rotational_rate: Decay rate of spins, at least 0 [1/s]; that of velocities by
            default.

    Raises:
        ValueError: If a rate is negative, or not one finite number.

    Example:
        >>> moving = replace(state, velocities=jnp.ones_like(state.velocities))
        >>> scene = jaxrod.make_scene(rod, jaxrod.exponential_damping(200.0))
        >>> after = jaxrod.step(scene, moving, 5e-4)
        >>> round(float(after.velocities[0, 0]), 3)  # exp(-200 * 5e-4)
        0.905
    """
    if rotational_rate is None:
        rotational_rate = translational_rate
    return ExponentialDamping(
        as_array("translational_rate", translational_rate, "1/s", non_negative=True),
        as_array("rotational_rate", rotational_rate, "1/s", non_negative=True),
    )


@pytree
class GivenLoads(Effect):
    """Loads on one rod that do not depend on its state."""

    forces: Float[Array, "3 n+1"]
    """Forces on nodes, world frame [N]."""
    couples: Float[Array, "3 n"]
    """Couples on elements, material frame [N m]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """The given loads, for any motion."""
        return Loads(vectors.split(self.forces), vectors.split(self.couples))
