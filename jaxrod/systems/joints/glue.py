r"""Glue: rods side by side, joined along their whole length by a line of springs.

Each pair of elements shares a point midway between their surfaces, fixed in both
elements. With $g$ the gap between the two copies of this point and $\phi$ the relative
rotation of the two elements from rest, the line stores per length $\frac12 k |g|^2 +
\frac12 k_t |\phi|^2$. Forces of springs and dashpots act at one point, half on each
node of an element, with the couple of the lever arm. So momentum and angular momentum
are conserved exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import StabilityBound, added_bounds
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    directors_from_orientations,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, added
from jaxrod.rods.rod import Layout, RodState
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, Parts, Seen
from jaxrod.systems.joints.elastic_joints import ElasticJoint, elastic_joints
from jaxrod.systems.joints.places import (
    Indices,
    Points,
    gather,
    layouts_of,
    least_inertia,
    orientation_at,
    points_of,
    resolved,
    scatter_add,
    spin_at,
    sum_of_loads,
)
from jaxrod.validation import Numbers, as_array, check_count


@pytree
class GluedSide:
    """Glued elements of one rod or several, and the point of glue on each of them."""

    points: Points
    """The elements, and the first node of each."""
    offsets: Float[Array, "3 pairs"]
    """Vector from the middle of each element to its point of glue, in the frame of the
    element [m]."""
    nexts: Indices = static()
    """Second node of each element, the one after its node in `points`."""

    def middles(self, seen: Seen, field: Vec3) -> Vec3:
        """Mean of a nodal field over both nodes of each glued element."""
        x, y, z = (
            0.5 * (gather(c, self.points.nodes) + gather(c, self.nexts)) for c in field
        )
        return x, y, z

    def places(self, seen: Seen) -> Vec3:
        """Positions of the points of glue, world frame [m]."""
        frame = directors(orientation_at(seen, self.points))
        arms = to_world(frame, vectors.split(self.offsets))
        return vectors.add(self.middles(seen, seen.motion.position), arms)

    def velocities(self, seen: Seen, place: Vec3) -> Vec3:
        """Velocity of each element's material at a point `place`, v + w x r [m/s]."""
        arm = vectors.subtract(place, self.middles(seen, seen.motion.position))
        swing = vectors.cross(spin_at(seen, self.points), arm)
        return vectors.add(self.middles(seen, seen.motion.velocity), swing)

    def loads(self, seen: Seen, force: Vec3, place: Vec3) -> tuple[Any, Any]:
        """Loads of a force on each element at a point `place`, world frame.

        Each node gets half of the force, and the element the couple of the lever arm.

        Returns:
            Two pairs of places and loads: for the first nodes and the elements, and for
            the second nodes.
        """
        arm = vectors.subtract(place, self.middles(seen, seen.motion.position))
        frame = directors(orientation_at(seen, self.points))
        couple = to_material(frame, vectors.cross(arm, force))
        half = vectors.scale(0.5, force)
        others = Points(self.points.member, self.nexts, self.points.elements)
        return (self.points, Loads(half, couple)), (others, Loads(half))

    def mobility(self, parts: Parts) -> Array:
        """Upper bound on the velocity of each point of glue per unit impulse [1/kg].

        It is `1 / (4 m1) + 1 / (4 m2) + r^2 / I`, with the masses `m1` and `m2` of both
        nodes, the length `r` of the offset and the smallest moment of inertia `I` of
        the element.
        """
        first = parts.node_masses[self.points.nodes.values]
        following = parts.node_masses[self.nexts.values]
        arms = vectors.split(self.offsets)
        turning = vectors.dot(arms, arms) / least_inertia(parts, self.points)
        return 0.25 / first + 0.25 / following + turning

    def bound(self, parts: Parts, rate: Array, slow: Array | None) -> StabilityBound:
        """Stability bound of one side: the rates times masses and moments of inertia.

        Args:
            parts: Constants of the member.
            rate: Stiffness times the mobility of both sides [1/s^2].
            slow: Drag times the mobility of both sides [1/s].
        """
        first = parts.node_masses[self.points.nodes.values]
        following = parts.node_masses[self.nexts.values]
        least = least_inertia(parts, self.points)

        def on_nodes(rate: Array) -> Array:
            size = parts.n_nodes
            one = scatter_add(rate * first, self.points.nodes, size)
            return one + scatter_add(rate * following, self.nexts, size)

        def on_elements(rate: Array) -> Array:
            return scatter_add(
                rate * least, self.points.elements, parts.inertias.shape[1]
            )

        return StabilityBound(
            nodes=on_nodes(rate),
            elements=on_elements(rate),
            node_drag=None if slow is None else on_nodes(slow),
            element_drag=None if slow is None else on_elements(slow),
        )


def between_surfaces(
    a: GluedSide, b: GluedSide, thicker: Array
) -> tuple[GluedSide, GluedSide]:
    """Moves glue from midway between two axes to midway between the surfaces.

    Args:
        a: Glued elements of the first member.
        b: Glued elements of the second member.
        thicker: Radii of `a` minus radii of `b` [m].
    """
    half = vectors.safe_norm(vectors.split(a.offsets))
    # If both axes coincide there is no direction in which to move it.
    apart = half > 0
    more = jnp.clip(0.5 * thicker / jnp.where(apart, half, 1), -1, 1)
    share = jnp.where(apart, more, 0)
    return (
        replace(a, offsets=(1 + share)[None, :] * a.offsets),
        replace(b, offsets=(1 - share)[None, :] * b.offsets),
    )


@pytree
class Glue(Coupling):
    """Glue between elements of two rods; see `glue`.

    Example:
        >>> beside = replace(state, positions=state.positions.at[1].add(0.04))
        >>> states = {"left": state, "right": beside}
        >>> glued = systems.glue("left", "right", states, stiffness=1e4)
        >>> glued.turning_stiffness is None  # elements turn freely
        True
    """

    a: GluedSide
    """Glued elements of the first member."""
    b: GluedSide
    """Glued elements of the second member, or of the same member."""
    joint: ElasticJoint
    """Elastic joints that resist relative rotation of glued elements."""
    stiffness: Float[Array, ""] | Float[Array, " pairs"]
    """Force per length of glue and per gap, one for all pairs or one for each [N/m^2].
    """
    turning_stiffness: Float[Array, ""] | Float[Array, " pairs"] | None = None
    """Couple per length of glue and per relative angle [N]; if `None`, glued elements
    turn freely."""
    damping: Float[Array, ""] | Float[Array, " pairs"] | None = None
    """Force per length of glue and per relative velocity [kg/(m s)]; if `None`, there
    is no damping."""
    turning_damping: Float[Array, ""] | Float[Array, " pairs"] | None = None
    """Couple per length of glue and per relative angular velocity [N s]; if `None`,
    there is no damping."""
    lengths: Float[Array, " pairs"] | None = None
    """Length of glue of each pair, the mean rest length of both elements [m]; `None`
    before `prepared`."""

    def regridded(self, grids: Any) -> Glue:
        """Raises a ValueError: glue is between certain elements."""
        for side in (self.a, self.b):
            if grids.changes(side.points.member):
                raise ValueError(
                    f"glue joins certain elements of {side.points.member!r}, which "
                    "cannot get another number of elements: glue the new rods again"
                )
        return self

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing, rigid or has too few nodes."""
        for side in (self.a, self.b):
            side.points.check(parts)
            if not parts[side.points.member].is_rod:
                raise ValueError(
                    f"glue joins rods, and {side.points.member!r} is rigid: use "
                    "jaxrod.systems.attach or fixed_joint"
                )

    def prepared(self, parts: AllParts) -> Glue:
        """Copy with constants computed from the rods.

        They are the points of glue between the surfaces, the lengths of glue, and the
        stiffness and damping of the joints.
        """
        if self.lengths is not None:
            return self
        each, radii = [], []
        for side in (self.a, self.b):
            own = parts[side.points.member]
            assert own.rest_lengths is not None and own.radii is not None
            each.append(own.rest_lengths[side.points.elements.values])
            radii.append(own.radii[side.points.elements.values])
        lengths = 0.5 * (each[0] + each[1])
        a, b = between_surfaces(self.a, self.b, radii[0] - radii[1])
        joint = self.joint
        if self.turning_stiffness is not None:
            row = self.turning_stiffness * lengths
            joint = replace(joint, stiffness=jnp.stack([row, row, row]))
        if self.turning_damping is not None:
            joint = replace(joint, damping=self.turning_damping * lengths)
        return replace(self, a=a, b=b, lengths=lengths, joint=joint)

    def _gap(self, seen: AllSeen) -> tuple[Vec3, Vec3]:
        """Vectors from the glue on `a` to that on `b`, and the points midway [m]."""
        first = self.a.places(seen[self.a.points.member])
        second = self.b.places(seen[self.b.points.member])
        gap = vectors.subtract(second, first)
        return gap, vectors.scale(0.5, vectors.add(first, second))

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Loads on both rods: forces `l (k g + c u)`, and the couples of the joints.

        `l` is the length of glue of a pair, `k` the stiffness, `g` the gap, `c` the
        damping and `u` the relative velocity.
        """
        one, two = seen[self.a.points.member], seen[self.b.points.member]
        gap, middle = self._gap(seen)
        pull = vectors.scale(self.stiffness, gap)
        if self.damping is not None:
            rate = vectors.subtract(
                self.b.velocities(two, middle), self.a.velocities(one, middle)
            )
            pull = vectors.add(pull, vectors.scale(self.damping, rate))
        assert self.lengths is not None
        pull = vectors.scale(self.lengths, pull)
        back = vectors.scale(-1.0, pull)
        total = sum_of_loads(
            *self.a.loads(one, pull, middle),
            *self.b.loads(two, back, middle),
            seen=seen,
        )
        if self.turning_stiffness is None:
            return total
        for name, loads in self.joint.loads(seen).items():
            total[name] = added(total[name], loads)
        return total

    def energy(self, seen: AllSeen) -> Array:
        """Elastic energy, `l (k |gap|^2 + k_t angle^2) / 2` for each pair [J]."""
        gap, _ = self._gap(seen)
        assert self.lengths is not None
        squares = self.lengths * vectors.dot(gap, gap)
        stored = 0.5 * jnp.sum(self.stiffness * squares)
        if self.turning_stiffness is None:
            return stored
        return stored + self.joint.energy(seen)

    def gap(self, seen: AllSeen) -> Array:
        """Largest gap of the glue, divided by the smallest radius of both rods [1]."""
        way, _ = self._gap(seen)
        radii = [seen[side.points.member].parts.radii for side in (self.a, self.b)]
        thin = jnp.min(jnp.stack([jnp.min(r) for r in radii if r is not None]))
        return jnp.max(vectors.safe_norm(way)) / thin

    def joint_angle(self, seen: AllSeen) -> Array | None:
        """Largest rotation of glued elements from rest [rad]; `None` if they turn."""
        return None if self.turning_stiffness is None else self.joint.joint_angle(seen)

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stability bounds on nodes and elements of both rods, by member."""
        assert self.lengths is not None
        one, two = parts[self.a.points.member], parts[self.b.points.member]
        ease = self.lengths * (self.a.mobility(one) + self.b.mobility(two))
        rate = self.stiffness * ease
        slow = None if self.damping is None else self.damping * ease
        total: dict[str, StabilityBound] = {}
        for side, own in ((self.a, one), (self.b, two)):
            name = side.points.member
            total[name] = added_bounds(total.get(name), side.bound(own, rate, slow))
        if self.turning_stiffness is not None:
            for name, bound in self.joint.stability_bounds(parts).items():
                total[name] = added_bounds(total[name], bound)
        return total


Rods = str | tuple[str, int]
"""Name of a rod, or name and number of one of equal rods."""
Glued = tuple[Sequence[int], Sequence[int]]
"""Elements of a first rod, and the elements of a second rod glued to them."""


def glue(
    a: Rods | Sequence[Rods],
    b: Rods | Sequence[Rods],
    state: Mapping[str, Any],
    *,
    stiffness: Numbers,
    turning_stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    turning_damping: Numbers | None = None,
    elements: Glued | Sequence[Glued] | None = None,
) -> Glue:
    """Rods glued side by side, free of force in `state`.

    Args:
        a: Name of a rod, or name and number of one of equal rods such as `("rods", 2)`.
            Or several rods of one member, each glued to one of `b`.
        b: Name of the second rod, or of one rod for each rod of `a`.
        state: State of the system at rest.
        stiffness: Force per length of glue and distance, in all directions [N/m^2].
            This argument and the next three are one number for all pairs of glued
            elements, or an array with one number for each pair, rod by rod.
        turning_stiffness: Couple per length and angle between the elements [N].
        damping: Force per length and relative speed [kg/(m s)].
        turning_damping: Couple per length and relative angular velocity [N s]; needs a
            `turning_stiffness`.
        elements: List of element numbers of `a`, and an equally long list of the
            elements of `b` glued to them; by default elements of the same number are
            glued together. With several rods, one such pair of lists for all, or a list
            of such pairs, one for each rod of `a`.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If there are no such rods or elements, `a` and `b` have different
            numbers of them, a number is out of range, or a turning damping is given
            without a turning stiffness.
        TypeError: If a rod is not given by its name.

    Example:
        >>> beside = replace(state, positions=state.positions.at[1].add(0.04))
        >>> states = {"left": state, "right": beside}
        >>> glued = systems.glue("left", "right", states, stiffness=1e4)
        >>> system = jaxrod.make_system({"left": scene, "right": scene}, glued)
        >>> apart = replace(state, positions=state.positions.at[1].add(0.05))  # 1 cm
        >>> energy = system.potential_energy({"left": state, "right": apart})
        >>> round(float(energy), 3)  # [J]
        0.5
    """
    if turning_damping is not None and turning_stiffness is None:
        raise ValueError(
            "turning_stiffness [N] is needed with turning_damping: without it glued "
            "elements turn freely"
        )
    layouts = layouts_of(state)
    names = [_rods("a", a), _rods("b", b)]
    if len(names[0]) != len(names[1]):
        raise ValueError(
            f"a and b must have the same number of rods, got {len(names[0])} and "
            f"{len(names[1])}"
        )
    pairs: list[list[tuple[Any, ...]]] = [[], []]
    listed = _listed(elements, len(names[0]))
    for one, two, chosen in zip(*names, listed, strict=True):
        for side, found in enumerate(_glued(one, two, chosen, layouts)):
            pairs[side].extend(found)
    same = sorted({p for p, q in zip(*pairs, strict=True) if p == q})
    if same:
        raise ValueError(f"an element is glued to itself: {same[0]}")
    points = [
        points_of(side, [resolved(side, place, layouts) for place in places])
        for side, places in zip("ab", pairs, strict=True)
    ]
    # All pairs are of the same two members, so there is one `ElasticJoint`.
    (joint,) = elastic_joints(pairs[0], pairs[1], state)
    middles = [_middles(state[own.member], own) for own in points]
    midway = 0.5 * (middles[0][0] + middles[1][0])
    sides = []
    for own, (middle, frame) in zip(points, middles, strict=True):
        offsets = np.sum(frame * (midway - middle)[None], axis=1)
        following = Indices(own.nodes.values + 1)
        sides.append(GluedSide(own, jnp.asarray(offsets), following))
    shapes = ((), (len(pairs[0]),))

    def number(name: str, value: Any, unit: str, *, positive: bool = False) -> Any:
        if value is None:
            return None
        given = {"positive": positive, "non_negative": True}
        return as_array(name, value, unit, shapes, **given)

    return Glue(
        a=sides[0],
        b=sides[1],
        joint=joint,
        stiffness=number("stiffness", stiffness, "N/m^2", positive=True),
        turning_stiffness=number(
            "turning_stiffness", turning_stiffness, "N", positive=True
        ),
        damping=number("damping", damping, "kg/(m s)"),
        turning_damping=number("turning_damping", turning_damping, "N s"),
    )


def _listed(elements: Any, count: int) -> list[Any]:
    """Lists of the glued elements of `a` and of `b`, for each of `count` pairs of rods.

    `elements` is the argument of `glue`. An entry `None` stands for all elements of
    both rods.
    """
    if elements is None:
        return [None] * count
    words = (
        "elements must be a list of those of a and one of those of b, or such a pair "
        f"for each of {count} rods, got {elements!r}"
    )
    try:
        listed = [list(pair) for pair in elements]
        given = [[np.asarray(side) for side in pair] for pair in listed]
    except (TypeError, ValueError) as error:
        raise ValueError(words) from error
    deep = any(side.ndim for pair in given for side in pair)
    if not deep:
        given = [[np.asarray(side) for side in listed]]
    if any(len(pair) != 2 or {side.ndim for side in pair} != {1} for pair in given):
        raise ValueError(words)
    if deep and len(given) != count:
        raise ValueError(words)
    rows = [[side.tolist() for side in pair] for pair in given]
    return rows if deep else rows * count


def _rods(name: str, given: Any) -> list[tuple[Any, ...]]:
    """List of rods as tuples: `(name,)`, or `(name, number)` for one of equal rods.

    `given` is the argument of `glue` called `name`.
    """
    if isinstance(given, str):
        return [(given,)]
    if not isinstance(given, Sequence) or not given:
        raise TypeError(
            f'{name} must be a rod such as "arm" or ("arms", 2), got {given!r}'
        )
    if len(given) == 2 and isinstance(given[0], str) and not isinstance(given[1], str):
        return [tuple(given)]
    return [(one,) if isinstance(one, str) else tuple(one) for one in given]


def _glued(
    one: tuple[Any, ...],
    two: tuple[Any, ...],
    elements: Any,
    layouts: Mapping[str, Layout],
) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    """Places of the glued elements on the first rod, and on the second rod.

    `elements` lists those of rod `one` and of rod `two`; `None` for all. A place is
    `(name, element)`, or `(name, number, element)` for one of equal rods.
    """
    counts = []
    for side, name in zip("ab", (one, two), strict=True):
        if name[0] in layouts and not layouts[name[0]].is_rod:
            raise ValueError(f"{side}: glue joins rods, and {name[0]!r} is rigid")
        member, _, _ = resolved(side, (*name, "base"), layouts)
        counts.append(layouts[member].n_elements)
    chosen = elements
    if chosen is None:
        if counts[0] != counts[1]:
            raise ValueError(
                f"{one} and {two} have {counts[0]} and {counts[1]} elements: say which "
                "are glued together, elements=([...], [...])"
            )
        chosen = (range(counts[0]), range(counts[0]))
    first, second = (
        [(*name, check_count(f"elements of {name}", k, 0, n - 1)) for k in listed]
        for name, n, listed in zip((one, two), counts, chosen, strict=True)
    )
    if not first or len(first) != len(second):
        raise ValueError(
            f"elements must have the same number for both rods, got {len(first)} and "
            f"{len(second)}"
        )
    return first, second


def _middles(state: RodState, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints `(3, k)` [m] and directors `(3, 3, k)` of the elements `points`."""
    first, listed = points.nodes.values, points.elements.values
    # The state is concrete even while other numbers are traced.
    with jax.ensure_compile_time_eval():
        positions, orientations = (
            np.asarray(state.layout.row(field))
            for field in (state.positions, state.orientations)
        )
        middles = 0.5 * (positions[:, first] + positions[:, first + 1])
        frames = directors_from_orientations(jnp.asarray(orientations[:, listed]))
        return middles, np.asarray(frames)
