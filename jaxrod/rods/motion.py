"""State of a rod as tuples of component arrays, which steps and effects use."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    join_quaternion,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import (
    Vec3,
    add,
    add_optional,
    dot,
    inner_difference,
    join,
    join_optional,
    safe_norm,
    scale,
    split,
    split_optional,
    subtract,
)
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static


@pytree
class Sections:
    """Frames and strains of a rod that are known otherwise than from quaternions."""

    of: Quaternion
    """Orientations that have these frames, the very arrays of a motion."""
    frame: tuple[Vec3, Vec3, Vec3]
    """Directors of the elements, world frame."""
    edges: Vec3
    """Vectors from each node to the next, in the frames of the elements [m]."""
    rotations: Vec3
    """Rotation vectors of the inner joints, material frame [rad]."""


@pytree
class Motion:
    """State of a rod as tuples of component arrays, for integrators and effects.

    The state is unpacked into components once per call instead of once per step. This
    keeps stacking and slicing of arrays out of the compiled loop.

    Example:
        >>> x, y, z = motion.position
        >>> x.shape, round(float(x[-1]), 3), round(float(motion.lengths[0]), 3)
        ((11,), 1.0, 0.1)
    """

    position: Vec3
    """Node positions, world frame [m]."""
    orientation: Quaternion
    """Orientations of the elements, unit quaternions, material to world."""
    velocity: Vec3
    """Node velocities, world frame [m/s]."""
    spin: Vec3
    """Rotation of the elements, in the variable that the law integrates.

    Consistent mode: angular momentum, world frame [kg m^2/s]. PyElastica mode: angular
    velocity, material frame [rad/s].
    """
    remainder: Vec3 | None = None
    """Accumulated round-off of the positions (Kahan) [m]; `None` without
    compensation."""
    spin_is_velocity: bool = static(default=False)
    """Whether `spin` is angular velocity (PyElastica mode) or angular momentum."""
    known: Sections | None = None
    """Frames and strains of a rod in a plane, for loads; see `sections`."""

    @property
    def sections(self) -> Sections | None:
        """Frames and strains, if they are known for this very orientation.

        A copy with another orientation has none.
        """
        if self.known is None:
            return None
        pairs = zip(self.known.of, self.orientation, strict=True)
        return self.known if all(a is b for a, b in pairs) else None

    @property
    def edges(self) -> Vec3:
        """Vectors from each node to the next, world frame [m]."""
        edges = inner_difference(self.position)
        if self.remainder is None:
            return edges
        return subtract(edges, inner_difference(self.remainder))

    @property
    def lengths(self) -> Array:
        """Current element lengths [m]."""
        return safe_norm(self.edges)

    def angular_velocities(self, rod: Rod) -> Vec3:
        """Angular velocity of the elements, world frame [rad/s]."""
        frame = directors(self.orientation)
        if self.spin_is_velocity:
            return to_world(frame, self.spin)
        if not rod.is_round:
            a, b, c = to_material(frame, self.spin)
            one, two, three = split(rod.principal_inertias)
            return to_world(frame, (a / one, b / two, c / three))
        transverse, polar = rod.inertias
        axial = (1 / polar - 1 / transverse) * dot(frame[2], self.spin)
        return add(scale(1 / transverse, self.spin), scale(axial, frame[2]))

    @property
    def at_rest(self) -> Motion:
        """The same configuration with zero velocities and spins."""
        still = jax.tree.map(jnp.zeros_like, (self.velocity, self.spin))
        return replace(self, velocity=still[0], spin=still[1])

    def moved(self, dt: Array) -> Motion:
        """Motion with the nodes moved at their velocities for a time `dt` [s].

        With a remainder this is Kahan's compensated sum.
        """
        step = scale(dt, self.velocity)
        if self.remainder is None:
            return replace(self, position=add(self.position, step))
        step = subtract(step, self.remainder)
        position = add(self.position, step)
        remainder = subtract(subtract(position, self.position), step)
        return replace(self, position=position, remainder=remainder)


def motion_of(state: RodState) -> Motion:
    """Unpacks a state into a motion whose spin is the angular momentum."""
    return Motion(
        position=split(state.positions),
        orientation=split_quaternion(state.orientations),
        velocity=split(state.velocities),
        spin=split(state.angular_momenta),
        remainder=split_optional(state.remainders),
    )


def state_of(motion: Motion) -> RodState:
    """Packs a motion whose spin is angular momentum into a state."""
    return RodState(
        positions=join(motion.position),
        orientations=join_quaternion(motion.orientation),
        velocities=join(motion.velocity),
        angular_momenta=join(motion.spin),
        remainders=join_optional(motion.remainder),
    )


@pytree
class Loads:
    """Forces on nodes and couples on elements of a rod.

    Example:
        >>> weight = jaxrod.gravity().loads(rod, motion)
        >>> round(float(weight.forces[2].sum()), 2), weight.couples is None
        (-12.32, True)
    """

    forces: Vec3 | None = None
    """Forces on the `n + 1` nodes, world frame [N]; `None` if there are none."""
    couples: Vec3 | None = None
    """Couples on the `n` elements, material frame [N m]; `None` if there are none."""

    if TYPE_CHECKING:
        # Only for type checkers, which do not count the entries of `tuple(...)`.
        def __init__(
            self,
            forces: tuple[Array, ...] | None = None,
            couples: tuple[Array, ...] | None = None,
        ) -> None:
            """Makes loads of forces (x, y, z) and couples (x, y, z); `None` is zero."""


def added(a: Loads, b: Loads) -> Loads:
    """Sum of two loads; either may lack forces or couples, which count as zero."""
    return Loads(add_optional(a.forces, b.forces), add_optional(a.couples, b.couples))


def accumulate(total: Vec3, part: Vec3 | None) -> Vec3:
    """Sum `total` + `part` of two vector fields; a `part` of `None` counts as zero."""
    if part is None:
        return total
    return total[0] + part[0], total[1] + part[1], total[2] + part[2]
