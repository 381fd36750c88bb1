r"""Contact per pair of elements: PyElastica's law, for comparisons.

Every pair of elements has one spring and one dashpot between their closest points, as
in `RodRodContact` and `RodSelfContact` of PyElastica 1.0. With $n$ from the first
element to the second, $\gamma = r_1 + r_2 - d$ and the mean velocity of the nodes of
each element,

$$F = \tfrac12\,(k \gamma + \nu\,(v_1 - v_2)\cdot n)\,n \quad (\gamma > 0)$$

acts on each of the four nodes. For an element at the end of a rod, two thirds of it act
on the end node and four thirds on the other. Sections become thinner as elements
stretch.

The law depends on the discretisation: rods side by side have several springs for each
element, and a crossing near a node has up to four. Forces act at the middles of
elements wherever they touch, so angular momentum is lost and there is no energy. The
dashpot pulls, and the force jumps at first touch. `rod_contact` and `crossing_contact`
are without these faults.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.contact.segment_distance import Products, between, products
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, Seen, check_named
from jaxrod.validation import Numbers, as_array, check_count

_PARALLEL = 1e-6
"""Squared sine of the angle below which PyElastica takes elements for parallel [1]."""
_NEAR = 0.8 * math.pi
"""Distance along a rod within which its elements do not touch, over the radius [1]."""


@pytree
class ElementContact(Coupling):
    """PyElastica's contact of two rods, or of one with itself."""

    stiffness: Float[Array, ""]
    """Stiffness of every pair of elements [N/m]."""
    damping: Float[Array, ""]
    """Damping of every pair of elements [kg/s]."""
    members: tuple[str, ...] = static(default=())
    """Names of two rods, or of one that touches itself."""
    pairs: int = static(default=4)
    """Elements that touch one element at a time, for the stability bound."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing, rigid, or several rods."""
        for name in self.members:
            check_named(name, parts)
            if not parts[name].is_rod or parts[name].count > 1:
                raise ValueError(
                    "element_contact is between single rods, but "
                    f"{name!r} is {'rigid' if not parts[name].is_rod else 'several'}"
                )

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces on the nodes of both rods."""
        one, two = (_Row(seen[self.members[k]]) for k in (0, -1))
        near = _Near(one, two, self_contact=len(self.members) == 1)
        closing = vectors.subtract(_upright(one.velocity), _beside(two.velocity))
        damped = self.damping * vectors.dot(closing, near.normal)
        size = 0.5 * (self.stiffness * near.depth + damped)
        force = vectors.scale(jnp.where(near.touch, size, 0), near.normal)
        on_one = one.on_nodes(vectors.scale(-1.0, _summed(force, axis=1)))
        on_two = two.on_nodes(_summed(force, axis=0))
        if len(self.members) == 1:
            return {self.members[0]: Loads(vectors.add(on_one, on_two))}
        return {self.members[0]: Loads(on_one), self.members[1]: Loads(on_two)}

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration over half the sum of the radii."""
        one, two = (_Row(seen[self.members[k]]) for k in (0, -1))
        near = _Near(one, two, self_contact=len(self.members) == 1)
        return jnp.max(jnp.where(near.touch, 2 * near.depth / near.radii, 0))

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stiffness and drag as if every element touched `pairs` others.

        A node has two elements. Each brings up to four thirds of half a spring's force,
        which changes with the displacements of both rods.
        """
        share = 2 * (4 / 3) * self.pairs
        return {
            name: StabilityBound(
                nodes=share * self.stiffness, node_drag=share * self.damping
            )
            for name in self.members
        }


class _Row:
    """Elements of a rod in its current state, with radii thinned by stretch."""

    def __init__(self, seen: Seen) -> None:
        motion, parts = seen.motion, seen.parts
        assert parts.radii is not None and parts.rest_lengths is not None
        x, y, z = (component[:-1] for component in motion.position)
        self.first: Vec3 = (x, y, z)
        self.edge = motion.edges
        self.lengths = motion.lengths
        self.radii = parts.radii * jnp.sqrt(parts.rest_lengths / self.lengths)
        u, v, w = (0.5 * (each[1:] + each[:-1]) for each in motion.velocity)
        self.velocity: Vec3 = (u, v, w)

    def on_nodes(self, forces: Vec3) -> Vec3:
        """Forces on nodes, from the forces of elements on each of their two nodes."""
        n = self.lengths.shape[0]
        earlier, later = np.ones(n), np.ones(n)
        earlier[-1], later[-1] = 4 / 3, 2 / 3
        earlier[0], later[0] = 2 / 3, 4 / 3
        x, y, z = (
            jnp.pad(earlier * force, (0, 1)) + jnp.pad(later * force, (1, 0))
            for force in forces
        )
        return x, y, z


class _Near:
    """Normals and penetrations of all pairs of elements at their closest points."""

    touch: Bool[Array, "one two"]
    """Whether pairs touch."""

    def __init__(self, one: _Row, two: _Row, *, self_contact: bool) -> None:
        way = vectors.subtract(_upright(one.first), _beside(two.first))
        own, other = _upright(one.edge), _beside(two.edge)
        apart = between(way, own, other, _places(way, own, other))
        distance = vectors.safe_norm(apart)
        self.normal = vectors.scale(-1 / jnp.where(distance > 0, distance, 1), apart)
        self.radii = one.radii[:, None] + two.radii[None, :]
        self.depth = self.radii - distance
        self.touch = (self.depth > 0) & (distance > 0)
        if self_contact:
            number = np.arange(one.lengths.shape[0])
            skipped = 1 + jnp.ceil(_NEAR * one.radii / one.lengths)
            self.touch &= (number[:, None] - number[None, :]) >= skipped[:, None]


def _places(way: Vec3, own: Vec3, other: Vec3) -> tuple[Array, Array]:
    """Closest points of both elements as PyElastica finds them [1].

    Parallel elements have many. The one taken on the first element is closest to the
    start of the second.
    """
    have = products(way, own, other)
    beginning = have.on_own(0.0)
    determinant = have.own * have.other - have.mixed * have.mixed
    parallel = jnp.abs(determinant / (have.own * have.other)) < _PARALLEL
    across = have.own * have.other_way - have.mixed * have.own_way
    t = across / jnp.where(parallel, 1, determinant)
    s = (have.mixed * t - have.own_way) / have.own
    outside = (s < 0) | (s > 1) | (t < 0) | (t > 1)
    s, t = _at_border(have, way, own, other, outside, (s, t))
    s = jnp.where(parallel, beginning, s)
    return s, jnp.where(parallel, have.on_other(beginning), t)


def _at_border(
    have: Products,
    way: Vec3,
    own: Vec3,
    other: Vec3,
    outside: Array,
    inside: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Closest points at one of the four ends, if those of the lines are outside."""
    zero, one = jnp.zeros_like(inside[0]), jnp.ones_like(inside[0])
    s, t = have.on_own(0.0), zero
    least = _square(between(way, own, other, (s, t)))
    for at in (
        (have.on_own(1.0), one),
        (zero, have.on_other(0.0)),
        (one, have.on_other(1.0)),
    ):
        found = _square(between(way, own, other, at))
        nearer = found < least
        s, t = jnp.where(nearer, at[0], s), jnp.where(nearer, at[1], t)
        least = jnp.where(nearer, found, least)
    return jnp.where(outside, s, inside[0]), jnp.where(outside, t, inside[1])


def _upright(row: Vec3) -> Vec3:
    x, y, z = (component[:, None] for component in row)
    return x, y, z


def _beside(row: Vec3) -> Vec3:
    x, y, z = (component[None, :] for component in row)
    return x, y, z


def _summed(pairs: Vec3, axis: int) -> Vec3:
    x, y, z = (jnp.sum(component, axis=axis) for component in pairs)
    return x, y, z


def _square(vector: Vec3) -> Array:
    return vectors.dot(vector, vector)


def element_contact(
    *members: str, stiffness: Numbers, damping: Numbers = 0.0, pairs: int = 4
) -> ElementContact:
    """PyElastica's contact of two rods, or of one with itself, for comparisons.

    It is `RodRodContact`, without the part that responds to the force pressing the rods
    together, and `RodSelfContact`. It depends on the number of elements, and angular
    momentum is lost: use `rod_contact` and `crossing_contact` for everything else.

    Args:
        *members: Names of two rods, or of one that touches itself.
        stiffness: `k`, of every pair of elements [N/m].
        damping: `nu`, of every pair of elements [kg/s].
        pairs: Elements that touch one element at a time, for `stable_dt`.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or there are not one or two members.
        TypeError: If a name is not a string.
    """
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if len(members) not in (1, 2) or len(set(members)) < len(members):
        raise ValueError(f"members must be one rod or two, got {list(members)}")
    return ElementContact(
        stiffness=as_array("stiffness", stiffness, "N/m", positive=True),
        damping=as_array("damping", damping, "kg/s", non_negative=True),
        members=members,
        pairs=check_count("pairs", pairs, 1, 1000),
    )
