"""Parts: the constants of the nodes and elements of a member, for couplings.

All nodes of a member are in one flat array, called a row, and so are its elements.
Equal rods follow one another: first all entries of the first rod, then those of the
second, and so on. A rigid body is one node and one element.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree, static


@pytree
class Parts:
    """Constants of a member, one entry per node or element.

    Example:
        >>> parts = scene.as_member().parts()
        >>> parts.node_masses.shape, parts.is_rod, parts.n_nodes
        ((11,), True, 11)
    """

    node_masses: Float[Array, " nodes"]
    """Mass of each node, or of each body [kg]."""
    inertias: Float[Array, "rows elements"]
    """Moments of inertia [kg m^2]: transverse and polar for round rods (2 rows), else
    about all three axes (3 rows)."""
    rest_lengths: Float[Array, " elements"] | None = None
    """Rest lengths of the elements of rods [m]; `None` for other members."""
    radii: Float[Array, " elements"] | None = None
    """Radii of the elements of rods [m]; `None` for other members."""
    bend_twist_stiffness: Float[Array, "3 elements"] | None = None
    """Bending stiffness about d1 and d2 and twisting stiffness about d3 of the elements
    of rods [N m^2]; `None` for other members."""
    linear_density: Float[Array, " elements"] | None = None
    """Mass per rest length of the elements of rods [kg/m]; `None` for other members."""
    shape: Body | None = None
    """Surface of rigid bodies in their own frame; `None` for other members."""
    held: Vec3 | None = None
    """Flags per node and world axis: 1 where a support holds the node, else 0; `None`
    if they are not known."""
    count: int = static(default=1)
    """Number of rods, bodies or points."""
    n_elements: int = static(default=1)
    """Number of elements of each rod; 1 for bodies and points, whose nodes are also
    elements."""
    is_rod: bool = static(default=True)
    """Whether the member consists of rods, with one more node than elements."""
    is_rigid: bool = static(default=False)
    """Whether the member consists of rigid bodies, to which nodes of rods can be
    attached."""
    joint_mean: str = static(default="arithmetic")
    """Mean by which a joint of a rod gets its stiffness from its two elements:
    "arithmetic" or "series"."""

    # `Motion.angular_velocities` uses these attributes of a rod.
    @property
    def is_round(self) -> bool:
        """Whether each element has the same moment of inertia about d1 and d2."""
        return self.inertias.shape[0] == 2

    @property
    def principal_inertias(self) -> Array:
        """Moments of inertia about d1, d2 and d3, for non-round elements [kg m^2]."""
        return self.inertias

    @property
    def n_nodes(self) -> int:
        """Number of nodes of all rods, bodies or points together."""
        return self.count * (self.n_elements + 1 if self.is_rod else 1)


def parts_of(rod: Rod) -> Parts:
    """Constants of one rod, for couplings."""
    return Parts(
        node_masses=rod.node_masses,
        inertias=rod.inertias if rod.is_round else rod.principal_inertias,
        rest_lengths=rod.rest_lengths,
        radii=rod.radii,
        bend_twist_stiffness=rod.bend_twist_stiffness,
        linear_density=rod.linear_density,
        n_elements=rod.n_elements,
        joint_mean=rod.joint_mean,
    )


def flatten_rods(tree: Any) -> Any:
    """Concatenates k rods along the last axis: `(k, ..., n)` becomes `(..., k n)`."""

    def one(leaf: Array) -> Array:
        moved = jnp.moveaxis(leaf, 0, -2)
        return moved.reshape(*moved.shape[:-2], -1)

    return jax.tree.map(one, tree)


def unflatten_rods(tree: Any, count: int) -> Any:
    """Splits the last axis into k rods: leaves `(..., k n)` become `(k, ..., n)`.

    Single numbers are repeated for each rod, `(k,)`.
    """

    def one(leaf: Array) -> Array:
        if jnp.ndim(leaf) == 0:
            return jnp.broadcast_to(leaf, (count,))
        return jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], count, -1), -2, 0)

    return jax.tree.map(one, tree)


@pytree
class Seen:
    """A member at one moment: its constants and its motion.

    Example:
        >>> seen = extend.Seen(scene.as_member().parts(), motion)
        >>> [float(abs(part).max()) for part in seen.angular_velocities]
        [0.0, 0.0, 0.0]
    """

    parts: Parts
    """Constants of the member."""
    motion: Motion
    """Positions and rates, with the nodes of all rods in one array, and the elements in
    another. For bodies they are those of the origins of their frames."""
    inverse_inertia: Matrix | None = None
    """Inverse inertia of bodies that carry attached masses, in their own frames [1/(kg
    m^2)]; `None` for other members."""

    @property
    def angular_velocities(self) -> Vec3:
        """Angular velocities of the elements, world frame [rad/s]."""
        if self.parts.is_rod:
            # `Motion` uses only the inertias of the rod.
            rod: Any = self.parts
            return self.motion.angular_velocities(rod)
        frame = directors(self.motion.orientation)
        own = to_material(frame, self.motion.spin)
        if self.inverse_inertia is None:
            a, b, c = self.parts.inertias
            return to_world(frame, (own[0] / a, own[1] / b, own[2] / c))
        x, y, z = (vectors.dot(row, own) for row in self.inverse_inertia)
        return to_world(frame, (x, y, z))


def mapped(function: Callable[[Array], Array], vector: Vec3) -> Vec3:
    """Applies a function to each of the three components of a vector field."""
    return function(vector[0]), function(vector[1]), function(vector[2])


def turning_mobility(
    inertias: Float[Array, "3 *k"], arm: Vec3, around: Array | float = 0.0
) -> Array:
    r"""Largest velocity of a point per impulse there, by turning alone [1/kg].

    An impulse $f$ at the lever arm $r$ moves the point by $(r\times f)\cdot
    I^{-1}(r\times f)$ along $f$. For unit vectors $f$ this is at most $r^2$ times the
    larger eigenvalue of $I^{-1}$ in the plane across $r$. Points within a distance $d$
    of it have at most $(\sqrt\lambda + d/\sqrt{I_{min}})^2$.

    Args:
        inertias: Moments of inertia about the axes of the body [kg m^2].
        arm: Lever arms from the centre of mass, in the frame of the body [m].
        around: Distance d from the ends of the arms [m].
    """
    least = jnp.min(inertias, axis=0)
    length = vectors.safe_norm(arm)
    x, y, z = (c * c for c in vectors.scale(1 / length, arm))
    a, b, c = least[None] / inertias
    slow = jnp.minimum(jnp.minimum(a, b), c)
    # The eigenvalues above the least one: exact for equal moments.
    a, b, c = a - slow, b - slow, c - slow
    total = a * (y + z) + b * (z + x) + c * (x + y)
    product = b * c * x + c * a * y + a * b * z
    square = total * total - 4 * product
    apart = square > 0
    root = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)
    ease = length * jnp.sqrt((slow + 0.5 * (total + root)) / least)
    ease = ease + around / jnp.sqrt(least)
    return ease * ease
