r"""Contact between rods, and of rods with themselves: the line law.

Contact points of one rod against the segments of another and the other way round, each
counting half. Over the segments $j$ of a rod and the nodes $v$ between them

$$E = \tfrac12 \sum_a w_a \Big[\sum_j \psi(p_{aj}) - \sum_v \psi(p_{av})\Big]
  + (\text{the rods exchanged}),$$

$p = r_a + r_b - d$ the penetration at the nearest point of a segment, or at a node,
$\psi$ the energy per length of `jaxrod.contacts.contact_law` and $w_a$ the rest length
of a point. Segments less the nodes between them count every contact once, also where
the nearest point passes from one segment to the next: parallel rods press on each other
with $k p$ per length, whatever their grids. Forces of a pair act at one common point
between the two surfaces, so that momentum and angular momentum are exact with damping
and friction too; friction makes both rods roll.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.contact_law import energy_density, friction_force, normal_force
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.centrelines import (
    Centrelines,
    Layout,
    Lines,
    at_points,
    centrelines,
    layout_of,
    lines_at,
    loads_on_members,
)
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling
from jaxrod.systems.places import Indices
from jaxrod.systems.rows import gathered_sum
from jaxrod.validation import Numbers, as_array, check_count, is_traced

_ROUNDED = 1e-7
"""Share of the radii within which distances are rounded off [1]."""
_PI = math.pi


@pytree
class RodContact(Coupling):
    """Contact between all rods of some members; see `rod_contact`."""

    stiffness: Float[Array, ""]
    """Force per length of contact and penetration [N/m^2]."""
    onset: Float[Array, ""]
    """Width of the smooth onset over the mean of the radii [1]."""
    damping: Float[Array, ""] | None = None
    """Force per length and speed along the normal [kg/(m s)]."""
    friction: Float[Array, ""] | None = None
    """Coefficient of Coulomb friction [1]."""
    friction_drag: Float[Array, ""] | None = None
    """Largest friction per length and speed of slip [kg/(m s)]."""
    lines: Centrelines | None = None
    """Constants of the members' points and segments, once prepared."""
    layout: Layout | None = static(default=None)
    """Numbering of points and segments, once fitted."""
    members: tuple[str, ...] = static(default=())
    """Names of the members."""
    itself: bool = static(default=False)
    """Whether rods touch themselves."""
    points_per_element: int | None = static(default=None)
    """Contact points per element; `None`: as many as the radii need."""
    partners: int = static(default=2)
    """Rods that may touch one place at a time, for the stability bound."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or is no rod."""
        for name in self.members:
            if name not in parts:
                raise ValueError(
                    f"no member is called {name!r}; there are "
                    + ", ".join(map(repr, parts))
                )
            if not parts[name].is_rod:
                raise ValueError(f"rod_contact is between rods, and {name!r} is rigid")

    def fitted(self, parts: AllParts) -> RodContact:
        """With points and segments numbered."""
        self.check(parts)
        rods = sum(parts[name].count for name in self.members)
        if rods < 2 and not self.itself:
            raise ValueError(
                "one rod has nothing to touch but itself: give itself=True, or more "
                "members"
            )
        per = [self.points_per_element or _needed(name, parts) for name in self.members]
        return replace(self, layout=layout_of(self.members, parts, per))

    def prepared(self, parts: AllParts) -> RodContact:
        """With radii and lengths of points and segments."""
        assert self.layout is not None
        return replace(self, lines=centrelines(self.layout, parts))

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on all members."""
        layout = self._layout()
        now = lines_at(layout, seen, spins=self.friction is not None)
        n_segments = len(layout.first_nodes)
        zero = jnp.zeros(n_segments, now.edge[0].dtype)
        first = following = couples = (zero, zero, zero)
        for block in self._blocks(layout):
            part = self._block_loads(now, block)
            first = vectors.add(first, part[0])
            following = vectors.add(following, part[1])
            couples = vectors.add(couples, part[2])
        return loads_on_members(layout, seen, first, following, couples)

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]."""
        layout = self._layout()
        now = lines_at(layout, seen, spins=False)
        total = jnp.zeros((), now.edge[0].dtype)
        for block in self._blocks(layout):
            for near in self._feet(now, block):
                density = energy_density(near.depth, near.width, self.stiffness)
                total = total + jnp.sum(near.weight * density)
        return total

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration over half the sum of the radii."""
        layout = self._layout()
        now = lines_at(layout, seen, spins=False)
        worst = jnp.zeros((), now.edge[0].dtype)
        for block in self._blocks(layout):
            near = next(iter(self._feet(now, block)))
            depth = jnp.where(near.weight > 0, near.depth, 0)
            worst = jnp.maximum(worst, jnp.max(depth / near.half_sum))
        return worst

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stiffness and drag as if all of every rod touched its partners."""
        lightest = jnp.min(
            jnp.stack([jnp.min(parts[m].node_masses[1:-1]) for m in self.members])
        )
        easiest = jnp.min(jnp.stack([jnp.min(parts[m].inertias) for m in self.members]))
        return {
            name: self._bound(parts[name], lightest, easiest) for name in self.members
        }

    def _bound(self, own: Any, lightest: Array, easiest: Array) -> StabilityBound:
        # A node stands for as much length as it has of the mass.
        density = own.linear_density
        lengths = own.node_masses / jnp.min(density)
        pair = self.partners * lengths * (1 + own.node_masses / lightest)
        drag = self.damping
        node_drag = None if drag is None else drag * pair
        if self.friction_drag is None:
            return StabilityBound(nodes=self.stiffness * pair, node_drag=node_drag)
        radius = jnp.max(own.radii)
        inertia = jnp.min(own.inertias, axis=0)
        # By Young's inequality, the slip's square is at most twice that of each.
        both = 2 * self.friction_drag
        largest = both if drag is None else jnp.maximum(drag, both)
        turning = self.partners * own.rest_lengths * radius * radius
        return StabilityBound(
            nodes=self.stiffness * pair,
            node_drag=largest * pair,
            element_drag=both * turning * (1 + inertia / easiest),
        )

    def _layout(self) -> Layout:
        assert self.layout is not None
        return self.layout

    def _blocks(self, layout: Layout) -> Iterator[_Block]:
        """Pairs of members whose points and segments meet."""
        rods = layout.rods.values
        ends = np.cumsum(layout.element_counts)
        slices = list(zip(ends - np.asarray(layout.element_counts), ends, strict=True))
        segment_of = layout.point_segments.values
        for begin, end in slices:
            chosen = np.flatnonzero((segment_of >= begin) & (segment_of < end))
            for other, stop in slices:
                several = rods[begin] != rods[end - 1]
                if begin == other and not (several or self.itself):
                    continue
                yield _Block(chosen, int(other), int(stop))

    def _weights(self, block: _Block) -> Array:
        """Half the length of each point, where it may touch a segment."""
        lines = self.lines
        assert lines is not None
        layout, part = self._layout(), slice(block.begin, block.end)
        rods = layout.rods.values
        same = (
            rods[part][:, None]
            == rods[layout.point_segments.values[block.points]][None, :]
        )
        half = 0.5 * lines.lengths[block.points][None, :]
        if not np.any(same):
            return jnp.broadcast_to(half, same.shape)
        if not self.itself:
            return jnp.where(same, 0, half)
        # Near along the rod nothing touches: bent to a curvature of one over the
        # radius it just would, half a turn away.
        place = lines.places[block.points][None, :]
        start = lines.starts[part][:, None]
        length = lines.rest_lengths[part][:, None]
        apart = jnp.maximum(start - place, place - start - length)
        share = (apart - _PI * lines.radii[part][:, None]) / length
        return jnp.where(same, half * jnp.clip(share, 0, 1), half)

    def _feet(self, now: Lines, block: _Block) -> Iterator[_Near]:
        """Points at their nearest places on segments, then at the segments' ends.

        The second count negative, and only where another segment follows.
        """
        lines = self.lines
        assert lines is not None
        layout, part = self._layout(), slice(block.begin, block.end)

        def of_segments(field: Vec3) -> Vec3:
            x, y, z = (component[part][:, None] for component in field)
            return x, y, z

        def of_points(field: Vec3) -> Vec3:
            x, y, z = (component[block.points][None, :] for component in field)
            return x, y, z

        place = of_points(at_points(layout, now.first, now.edge))
        first, edge = of_segments(now.first), of_segments(now.edge)
        apart = vectors.subtract(place, first)
        square = vectors.dot(edge, edge)
        share = jnp.clip(vectors.dot(apart, edge) / square, 0, 1)
        weight = self._weights(block)
        radii = lines.radii[part][:, None], lines.point_radii[block.points][None, :]
        follows = jnp.asarray(1 - layout.is_last.values[part])[:, None]
        ends = jnp.ones_like(share)
        for fraction, factor in ((share, weight), (ends, -follows * weight)):
            way = vectors.subtract(apart, vectors.scale(fraction, edge))
            yield _near(way, fraction, factor, radii, self.onset)

    def _block_loads(self, now: Lines, block: _Block) -> tuple[Vec3, Vec3, Vec3]:
        """Forces on first and next nodes of all segments, and couples on them."""
        layout, part = self._layout(), slice(block.begin, block.end)
        n_segments = len(layout.first_nodes)
        change = vectors.subtract(now.next_velocity, now.first_velocity)
        velocity = at_points(layout, now.first_velocity, change)
        segment = layout.point_segments.values[block.points]
        sums: list[Any] = []
        for near in self._feet(now, block):

            def of_segments(field: Vec3) -> Vec3:
                x, y, z = (component[part][:, None] for component in field)
                return x, y, z

            def of_points(field: Vec3, index: Any) -> Vec3:
                x, y, z = (component[index][None, :] for component in field)
                return x, y, z

            other = vectors.add(
                of_segments(now.first_velocity),
                vectors.scale(near.fraction, of_segments(change)),
            )
            rate = vectors.subtract(of_points(velocity, block.points), other)
            leaving = vectors.dot(rate, near.normal)
            push = normal_force(
                near.depth, leaving, near.width, self.stiffness, self.damping
            )
            force = vectors.scale(push, near.normal)
            turn: tuple[Vec3, Vec3] | None = None
            if self.friction is not None:
                assert self.friction_drag is not None
                arms = near.arms()
                slip = vectors.add(
                    rate, vectors.cross(of_points(now.spin, segment), arms[0])
                )
                slip = vectors.subtract(
                    slip, vectors.cross(of_segments(now.spin), arms[1])
                )
                along = vectors.subtract(
                    slip, vectors.scale(vectors.dot(slip, near.normal), near.normal)
                )
                rub = friction_force(push, along, self.friction, self.friction_drag)
                force = vectors.add(force, rub)
                turn = vectors.cross(arms[0], rub), vectors.cross(rub, arms[1])
            sums.append(_summed(near, force, turn))
        total = sums[0]
        for more in sums[1:]:
            total = [vectors.add(a, b) for a, b in zip(total, more, strict=True)]
        on_points, on_first, on_next, couple_points, couple_segments = total
        # From the points to their segments' nodes, by the lever rule.
        fraction = jnp.asarray(layout.point_fractions, push.dtype)[block.points]
        owners = Indices(segment)

        def gathered(field: Vec3) -> Vec3:
            x, y, z = (gathered_sum(c, owners, n_segments) for c in field)
            return x, y, z

        def spread(field: Vec3) -> Vec3:
            x, y, z = (jnp.pad(c, (block.begin, n_segments - block.end)) for c in field)
            return x, y, z

        later = vectors.scale(fraction, on_points)
        first = vectors.add(
            gathered(vectors.subtract(on_points, later)), spread(on_first)
        )
        following = vectors.add(gathered(later), spread(on_next))
        couples = vectors.add(gathered(couple_points), spread(couple_segments))
        return first, following, couples


class _Block:
    """Points of one member and segments of one, which may be the same."""

    def __init__(self, points: np.ndarray, begin: int, end: int) -> None:
        self.points, self.begin, self.end = points, begin, end


@pytree
class _Near:
    """Points near segments, `(segments, points)`."""

    normal: Vec3
    fraction: Array
    weight: Array
    depth: Array
    width: Array
    radii: tuple[Array, Array]

    @property
    def half_sum(self) -> Array:
        """Mean of both radii [m]."""
        return 0.5 * (self.radii[0] + self.radii[1])

    def arms(self) -> tuple[Vec3, Vec3]:
        """From the axes of the points and of the segments to the common point [m]."""
        overlap = 0.5 * self.depth
        return (
            vectors.scale(overlap - self.radii[1], self.normal),
            vectors.scale(self.radii[0] - overlap, self.normal),
        )


def _near(
    way: Vec3,
    fraction: Array,
    weight: Array,
    radii: tuple[Array, Array],
    onset: Array,
) -> _Near:
    """Distance and normal, rounded off where centrelines meet."""
    together = radii[0] + radii[1]
    rounded = (_ROUNDED * together) * (_ROUNDED * together)
    distance = jnp.sqrt(vectors.dot(way, way) + rounded)
    return _Near(
        normal=vectors.scale(1 / distance, way),
        fraction=fraction,
        weight=weight,
        depth=together - distance,
        width=0.5 * onset * together,
        radii=radii,
    )


def _summed(near: _Near, force: Vec3, turn: tuple[Vec3, Vec3] | None) -> list[Vec3]:
    """Sums over segments on the points, and over points on the segments.

    Forces on points; on first nodes; on next nodes; couples on points' segments; on
    segments.
    """
    weighted = vectors.scale(near.weight, force)
    back = vectors.scale(-1.0, weighted)
    later = vectors.scale(near.fraction, back)
    zero = jnp.zeros_like(near.depth)
    none = (zero, zero, zero)
    twist = (none, none) if turn is None else turn

    def total(field: Vec3, axis: int) -> Vec3:
        x, y, z = (jnp.sum(component, axis=axis) for component in field)
        return x, y, z

    return [
        total(weighted, 0),
        total(vectors.subtract(back, later), 1),
        total(later, 1),
        total(vectors.scale(near.weight, twist[0]), 0),
        total(vectors.scale(near.weight, twist[1]), 1),
    ]


def _needed(name: str, parts: AllParts) -> int:
    """Points per element such that neighbours are half a radius apart at most."""
    own = parts[name]
    if is_traced(own.rest_lengths, own.radii):
        raise ValueError(
            f"rod_contact: of {name!r} the lengths or radii are traced: give "
            "points_per_element"
        )
    ratio = np.asarray(own.rest_lengths) / np.asarray(own.radii)
    return max(1, math.ceil(2 * float(np.max(ratio)) - 1e-6))


def rod_contact(
    *members: str,
    stiffness: Numbers,
    damping: Numbers | None = None,
    friction: Numbers | None = None,
    friction_drag: Numbers | None = None,
    itself: bool = False,
    onset: Numbers = 0.01,
    points_per_element: int | None = None,
    partners: int = 2,
) -> RodContact:
    """Contact between all rods of the named members.

    Args:
        *members: Names of members, one rod each or equal rods together.
        stiffness: Force per length of contact and penetration [N/m^2].
        damping: Force per length and normal speed [kg/(m s)].
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per length and speed of slip [kg/(m s)]; by
            default as much as `damping`.
        itself: Whether each rod touches itself too. Of places nearer to each other
            along the rod than pi times its radius nothing is seen.
        onset: Width of the smooth onset of contact over the mean of the radii [1].
        points_per_element: Contact points per element; by default so many that they
            are half a radius apart, which makes the force of two rods that cross
            the same to 3 % wherever they do.
        partners: Rods that may touch one place at the same time, for `stable_dt`: 2
            for a few rods, 6 in a bundle.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If a number is out of range, or friction has no drag.
        TypeError: If a name is none.
    """
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if not members or len(set(members)) < len(members):
        raise ValueError(f"members must be named once each, got {list(members)}")
    drag = damping if friction_drag is None else friction_drag
    if friction is not None and drag is None:
        raise ValueError(
            "friction needs friction_drag > 0 kg/(m s), what it resists per length "
            "and speed at the onset of slip (by default the damping), got none"
        )

    def number(name: str, value: Numbers | None, unit: str) -> Array | None:
        return None if value is None else as_array(name, value, unit, positive=True)

    if points_per_element is not None:
        check_count("points_per_element", points_per_element, 1, 1000)
    return RodContact(
        stiffness=as_array("stiffness", stiffness, "N/m^2", positive=True),
        onset=as_array("onset", onset, "", positive=True),
        damping=number("damping", damping, "kg/(m s)"),
        friction=number("friction", friction, ""),
        friction_drag=(
            None if friction is None else number("friction_drag", drag, "kg/(m s)")
        ),
        members=members,
        itself=bool(itself),
        points_per_element=points_per_element,
        partners=check_count("partners", partners, 1, 1000),
    )
