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

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.contact_law import energy_density, friction_force, normal_force
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.continued import ends_alone
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, TiedPair
from jaxrod.systems.near_segments import Nearness, nearnesses
from jaxrod.systems.parts import Parts
from jaxrod.systems.strands import (
    ContactPoints,
    Segments,
    StrandLoads,
    Strands,
    loads_on_member,
    points_at,
    segments_at,
    strands,
)
from jaxrod.validation import Numbers, as_array, check_count, is_traced


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
    strands: tuple[Strands, ...] = ()
    """Points and segments of each member, once prepared."""
    members: tuple[str, ...] = static(default=())
    """Names of the members."""
    itself: bool = static(default=False)
    """Whether rods touch themselves."""
    points_per_element: tuple[int, ...] = static(default=())
    """Contact points per element of each member, once fitted; or one number for all."""
    tied: tuple[TiedPair, ...] = static(default=())
    """Pairs of nodes that are tied together, near which nothing touches."""
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

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> RodContact:
        """With the number of points, and what is tied and so does not touch."""
        self.check(parts)
        rods = sum(parts[name].count for name in self.members)
        if rods < 2 and not self.itself:
            raise ValueError(
                "one rod has nothing to touch but itself: give itself=True, or more "
                "members"
            )
        given = self.points_per_element * len(self.members)
        per = given or tuple(_needed(name, parts) for name in self.members)
        near = tuple(pair for pair in tied if {pair[0], pair[2]} <= set(self.members))
        return replace(self, points_per_element=per, tied=near)

    def prepared(self, parts: AllParts) -> RodContact:
        """With radii and lengths of points and segments."""
        made = tuple(
            strands(parts[name], per)
            for name, per in zip(self.members, self.points_per_element, strict=True)
        )
        return replace(self, strands=made)

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces and couples on all members."""
        rubs = self.friction is not None
        total: dict[int, StrandLoads] = {}
        for a, b, weights in self._pairs():
            points = points_at(self.strands[a], seen[self.members[a]], spins=rubs)
            segments = segments_at(self.strands[b], seen[self.members[b]], spins=rubs)
            for near in self._near(a, b, weights, points, segments):
                on_a, on_b = self._pair_loads(near, points, segments)
                total[a] = total.get(a, StrandLoads()).added(on_a)
                total[b] = total.get(b, StrandLoads()).added(on_b)
        return {
            self.members[k]: loads_on_member(
                self.strands[k], seen[self.members[k]], loads
            )
            for k, loads in total.items()
        }

    def energy(self, seen: AllSeen) -> Array:
        """Energy of all contacts [J]."""
        total = jnp.zeros((), self.stiffness.dtype)
        for near in self._all(seen):
            density = energy_density(near.depth, near.width, self.stiffness)
            total = total + jnp.sum(near.weight * density)
        return total

    def violation(self, seen: AllSeen) -> Array:
        """Deepest penetration over half the sum of the radii."""
        worst = jnp.zeros((), self.stiffness.dtype)
        for near in self._all(seen):
            depth = jnp.where(near.weight > 0, near.depth, 0)
            worst = jnp.maximum(worst, jnp.max(depth / near.half_sum))
        return worst

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stiffness and drag as if all of every rod touched its partners.

        The square of what a spring sees of both rods is at most twice the sum of the
        squares of either; of the four parts of a slip, four times.
        """
        return {name: self._bound(parts[name]) for name in self.members}

    def _bound(self, own: Parts) -> StabilityBound:
        assert own.linear_density is not None and own.rest_lengths is not None
        assert own.radii is not None
        # A node stands for as much length as it has of the mass.
        lengths = self.partners * own.node_masses / jnp.min(own.linear_density)
        drag, sides, turning = self.damping, 2, None
        if self.friction_drag is not None:
            rub = self.friction_drag
            drag, sides = rub if drag is None else jnp.maximum(drag, rub), 4
            turning = 4 * self.partners * drag * own.rest_lengths * own.radii**2
        return StabilityBound(
            nodes=2 * self.stiffness * lengths,
            node_drag=None if drag is None else sides * drag * lengths,
            element_drag=turning,
        )

    def _pairs(self) -> Iterator[tuple[int, int, Array]]:
        """Members whose points and segments meet, and half the lengths that count."""
        for a in range(len(self.members)):
            for b in range(len(self.members)):
                points, segments = self.strands[a], self.strands[b]
                half = 0.5 * points.lengths[None, :]
                if a == b and not (points.count > 1 or self.itself):
                    continue
                if a == b:
                    half = self._within(points, segments, half)
                for one, i, other, j in self.tied:
                    if (one, other) == (self.members[a], self.members[b]):
                        half = half * _away(points, i, segments, j)
                yield a, b, half

    def _within(self, points: Strands, segments: Strands, half: Array) -> Array:
        """Half the lengths of points, for segments of the same member."""
        same = segments.segment_rods[:, None] == points.point_rods[None, :]
        if not self.itself:
            return jnp.where(same, 0, half)
        # Near along the rod nothing touches: bent to a curvature of one over the
        # radius it just would, half a turn away.
        place, start = points.places[None, :], segments.starts[:, None]
        length = segments.rest_lengths[:, None]
        apart = jnp.maximum(start - place, place - start - length)
        share = (apart - math.pi * segments.radii[:, None]) / length
        return jnp.where(same, half * jnp.clip(share, 0, 1), half)

    def _near(
        self,
        a: int,
        b: int,
        weights: Array,
        points: ContactPoints,
        segments: Segments,
    ) -> Iterator[Nearness]:
        sizes = {
            k: s.n_elements for k, s in zip(self.members, self.strands, strict=True)
        }
        last = ends_alone(self.members[b], self.strands[b].count, sizes, self.tied)
        radii = self.strands[b].radii, self.strands[a].point_radii
        return nearnesses(points, segments, weights, last, radii, self.onset)

    def _all(self, seen: AllSeen) -> Iterator[Nearness]:
        for a, b, weights in self._pairs():
            points = points_at(self.strands[a], seen[self.members[a]], spins=False)
            segments = segments_at(self.strands[b], seen[self.members[b]], spins=False)
            yield from self._near(a, b, weights, points, segments)

    def _pair_loads(
        self, near: Nearness, points: ContactPoints, segments: Segments
    ) -> tuple[StrandLoads, StrandLoads]:
        """Loads of one kind of nearness on the points' member and the segments'."""
        rate = near.rates(points, segments)
        leaving = vectors.dot(rate, near.normal)
        push = normal_force(
            near.depth, leaving, near.width, self.stiffness, self.damping
        )
        force = vectors.scale(push, near.normal)
        turns: tuple[Vec3, Vec3] | None = None
        if self.friction is not None:
            assert self.friction_drag is not None
            arms = near.arms()
            slip = near.slip(rate, leaving, arms, points, segments)
            rub = friction_force(push, slip, self.friction, self.friction_drag)
            force = vectors.add(force, rub)
            turns = vectors.cross(arms[0], rub), vectors.cross(rub, arms[1])
        return near.summed(force, turns)


def _away(points: Strands, node: int, segments: Strands, other: int) -> Array:
    """Zero for points and segments near nodes that are tied, along their rods."""
    rod = node // (points.n_elements + 1)
    fellow = other // (segments.n_elements + 1)
    along = jnp.abs(points.places - points.node_places[node])
    ends = segments.starts + segments.rest_lengths
    mark = segments.node_places[other]
    beside = jnp.maximum(jnp.maximum(segments.starts - mark, mark - ends), 0)
    apart = along[None, :] + beside[:, None]
    reach = 0.5 * math.pi * (segments.radii[:, None] + points.point_radii[None, :])
    share = jnp.clip((apart - reach) / segments.rest_lengths[:, None], 0, 1)
    concerned = (segments.segment_rods == fellow)[:, None] & (points.point_rods == rod)[
        None, :
    ]
    return jnp.where(concerned, share, 1)


def _needed(name: str, parts: AllParts) -> int:
    """Points per element such that neighbours are a third of a radius apart at most."""
    own = parts[name]
    if is_traced(own.rest_lengths, own.radii):
        raise ValueError(
            f"rod_contact: of {name!r} the lengths or radii are traced: give "
            "points_per_element"
        )
    ratio = np.asarray(own.rest_lengths) / np.asarray(own.radii)
    return max(1, math.ceil(3 * float(np.max(ratio)) - 1e-6))


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
            are a third of a radius apart, which makes the energy of rods that cross
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
        points_per_element=() if points_per_element is None else (points_per_element,),
        partners=check_count("partners", partners, 1, 1000),
    )
