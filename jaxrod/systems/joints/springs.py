r"""Springs between members, and ball joints, which are springs of zero rest length.

A spring between anchors at $x_a$ and $x_b$ stores $\frac12 k (|x_b - x_a| - d)^2$. Its
force and the force of its dashpot act on both members at the point halfway between the
anchors. So force and reaction together have no moment, for any gap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.default_law import affordable_stiffness, largest_rates
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, TiedPair
from jaxrod.systems.joints.anchors import Anchors, anchors, spring_bounds
from jaxrod.systems.joints.places import Place, Points, pairs, position_of, sum_of_loads
from jaxrod.validation import Numbers, as_array, is_traced, optional_number


@pytree
class Springs(Coupling):
    """Springs with dashpots between anchors of two members, or of one."""

    a: Anchors
    """Anchors on the first member, one for each spring."""
    b: Anchors
    """Anchors on the second member, one for each spring."""
    stiffness: Float[Array, ""]
    """Force per elongation of a spring [N/m]."""
    damping: Float[Array, ""] | None = None
    """Force of a dashpot per relative velocity [kg/s]; if `None`, there are no
    dashpots."""
    rest_lengths: Float[Array, " springs"] | None = None
    """Distances at which springs exert no force [m]; if `None`, they are zero and the
    springs are isotropic."""
    left_out: bool = static(default=False)
    """Whether `make_system` chooses the stiffness; until then it is NaN."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing or has too few nodes.

        Raises:
            ValueError: Also if the stiffness is left out between two rigid bodies.
        """
        self.a.check(parts)
        self.b.check(parts)
        if self.left_out:
            check_limited("stiffness", "N/m", self.a.points, self.b.points, parts)

    @property
    def lacks_numbers(self) -> bool:
        """Whether its stiffness is left out."""
        return self.left_out

    def with_numbers(self, parts: AllParts, step: Array) -> Springs:
        """Copy with a stiffness that makes the stable step at most a fifth shorter.

        Args:
            parts: Constants of the members.
            step: Largest stable step of the system without these springs [s].
        """
        bare = replace(self, damping=None)
        return replace(self, stiffness=chosen(bare, parts, step), left_out=False)

    def adjacent_pairs(self, parts: AllParts) -> tuple[TiedPair, ...]:
        """Pairs of nodes whose springs have no length; see `Coupling.adjacent_pairs`.

        An anchor that is known to be more than a radius away from its node is no pair.
        """
        ends = self.a, self.b
        rods = all(parts[own.points.member].is_rod for own in ends)
        if self.rest_lengths is not None or not rods:
            return ()
        near = np.ones(len(self.a.points.nodes), bool)
        for own in ends:
            if not is_traced(own, parts):
                away = np.linalg.norm(np.asarray(own.offsets), axis=0)
                near &= away <= np.asarray(own.sizes(parts[own.points.member]))
        one, two = (
            [(own.points.member, int(node)) for node in own.points.nodes.values[near]]
            for own in ends
        )
        found = [(*a, *b) for a, b in zip(one, two, strict=True) if a != b]
        return tuple(found + [(*pair[2:], *pair[:2]) for pair in found])

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Loads of springs and dashpots, which act halfway between both anchors.

        The force on the first member is `k (1 - d / |g|) g + c u`. Here `g` is the
        vector from the first anchor to the second, and `u` the velocity of the second
        member relative to the first at the point halfway between them.
        """
        one, two = seen[self.a.points.member], seen[self.b.points.member]
        first, second = self.a.positions(one), self.b.positions(two)
        gap = vectors.subtract(second, first)
        middle = vectors.scale(0.5, vectors.add(first, second))
        pull = vectors.scale(self.stiffness, gap)
        if self.rest_lengths is not None:
            length = vectors.safe_norm(gap)
            pull = vectors.scale(1 - self.rest_lengths / length, pull)
        if self.damping is not None:
            rate = vectors.subtract(
                self.b.velocities(two, middle), self.a.velocities(one, middle)
            )
            pull = vectors.add(pull, vectors.scale(self.damping, rate))
        back = vectors.scale(-1.0, pull)
        return sum_of_loads(
            (self.a.points, self.a.loads(one, pull, middle)),
            (self.b.points, self.b.loads(two, back, middle)),
            seen=seen,
        )

    def energy(self, seen: AllSeen) -> Array:
        """Elastic energy, 1/2 k (length - rest length)^2 for each spring [J]."""
        one, two = seen[self.a.points.member], seen[self.b.points.member]
        gap = vectors.subtract(self.b.positions(two), self.a.positions(one))
        if self.rest_lengths is None:
            return 0.5 * self.stiffness * jnp.sum(vectors.dot(gap, gap))
        longer = vectors.safe_norm(gap) - self.rest_lengths
        return 0.5 * self.stiffness * jnp.sum(longer * longer)

    def gap(self, seen: AllSeen) -> Array | None:
        """Largest distance of two anchors, in radii; `None` for springs of a length."""
        if self.rest_lengths is not None:
            return None
        one, two = seen[self.a.points.member], seen[self.b.points.member]
        way = vectors.subtract(self.b.positions(two), self.a.positions(one))
        size = jnp.minimum(self.a.sizes(one.parts), self.b.sizes(two.parts))
        return jnp.max(vectors.safe_norm(way) / size)

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Stability bounds on nodes and elements at both ends, by member."""
        # Dashpots act halfway between the anchors.
        reach = 0.0 if self.rest_lengths is None else 0.5 * self.rest_lengths
        return spring_bounds(
            self.a, self.b, parts, self.stiffness, self.damping, reach=reach
        )


def spring(
    a: Place | Sequence[Place],
    b: Place | Sequence[Place],
    state: Mapping[str, Any],
    *,
    stiffness: Numbers,
    damping: Numbers | None = None,
    at: tuple[Numbers, Numbers] | None = None,
) -> Springs:
    """Springs between points of two members, free of force in `state`.

    Args:
        a: A place on the first member, or several.
        b: A place on the second member, or one for each place of `a`.
        state: State of the system at rest.
        stiffness: Force per change of distance [N/m].
        damping: Force per relative velocity of the two members [kg/s], both taken at
            the point halfway between the ends.
        at: Ends of the spring in `state`, world frame: a pair of points `(3,)` [m]; by
            default the nodes, or the origins of the bodies.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If there is no such place, a number is out of range, or the ends
            coincide: then use `ball_joint`.

    Example:
        >>> ends = ("left", "base"), ("right", "tip")
        >>> states = {"left": state, "right": state}
        >>> band = systems.spring(*ends, states, stiffness=100.0)
        >>> print(band.rest_lengths.round(3))  # free of force where it is [m]
        [1.]
    """
    ends: tuple[Any, Any] = (None, None)
    if at is not None:
        if not isinstance(at, tuple | list) or len(at) != 2:
            raise ValueError(f"at must be a pair of points (3,) in m, got {at!r}")
        ends = _point("at[0]", at[0]), _point("at[1]", at[1])
    rigidity = as_array("stiffness", stiffness, "N/m", positive=True)
    made = _springs(a, b, state, rigidity, damping, ends)
    one = jnp.stack([position.place for position in _poses(a, state)], axis=1)
    two = jnp.stack([position.place for position in _poses(b, state)], axis=1)
    if at is not None:
        one, two = (point[:, None] for point in ends)
    way = two - one
    if not is_traced(way) and not np.all(np.any(np.asarray(way) != 0, axis=0)):
        raise ValueError(
            "a and b must be at two places, got a spring of length 0 m: use ball_joint"
        )
    rest = vectors.safe_norm(vectors.split(way))
    return replace(made, rest_lengths=rest)


def ball_joint(
    a: Place | Sequence[Place],
    b: Place | Sequence[Place],
    state: Mapping[str, Any],
    *,
    stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    at: Numbers | None = None,
) -> Springs:
    """Points of two members held together by springs; both turn freely.

    `tie` does the same for nodes of rods, without compliance and without a limit on the
    time step. This joint has a stiffness, and also works for points on rigid bodies.
    Contact between two rods leaves out the elements near it, as near ties.

    Args:
        a: A place on the first member, or several.
        b: A place on the second member, or one for each place of `a`.
        state: State of the system at rest.
        stiffness: Force per distance between the two points [N/m]. If it is left out,
            `make_system` takes one that makes the stable time step at most a fifth
            shorter.
        damping: Force per relative speed [kg/s].
        at: Position of the joint in `state`, world frame `(3,)` [m]; by default the
            places of `a`.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If there is no such place, a number is out of range, or `at` is not
            given and two nodes of rods are further apart than the longer element there.
            `make_system` also raises it if the stiffness is left out between two rigid
            bodies.

    Example:
        >>> states = {"left": state, "right": state}
        >>> tips = ("left", "tip"), ("right", "tip")
        >>> joint = systems.ball_joint(*tips, states, stiffness=100.0)
        >>> system = jaxrod.make_system({"left": scene, "right": scene}, joint)
        >>> apart = replace(state, positions=state.positions.at[1].add(0.1))  # 10 cm
        >>> energy = system.potential_energy({"left": state, "right": apart})
        >>> round(float(energy), 3)  # [J]
        0.5
    """
    point = None if at is None else _point("at", at)
    if point is None:
        for one, other in zip(*pairs(a, b), strict=True):
            _check_near(one, other, state)
        ends: tuple[Any, Any] = None, [pose.place for pose in _poses(a, state)]
    else:
        ends = point, point
    rigidity = number_or_nan("stiffness", stiffness, "N/m")
    made = _springs(a, b, state, rigidity, damping, ends)
    return replace(made, left_out=stiffness is None)


def _springs(
    a: Any,
    b: Any,
    state: Mapping[str, Any],
    stiffness: Array,
    damping: Numbers | None,
    at: tuple[Any, Any],
) -> Springs:
    first, second = pairs(a, b)

    def listed(point: Any, count: int) -> list[Any]:
        if point is None:
            return [None] * count
        return list(point) if isinstance(point, list) else [jnp.asarray(point)] * count

    return Springs(
        a=anchors(first, state, at=listed(at[0], len(first)), name="a"),
        b=anchors(second, state, at=listed(at[1], len(second)), name="b"),
        stiffness=stiffness,
        damping=optional_number("damping", damping, "kg/s"),
    )


def number_or_nan(name: str, given: Numbers | None, unit: str) -> Array:
    """A positive number, or NaN for one that `make_system` chooses."""
    if given is None:
        return jnp.asarray(jnp.nan)
    return as_array(name, given, unit, positive=True)


def chosen(bare: Any, parts: AllParts, step: Array) -> Array:
    """Stiffness of springs that is left out, from the step that others allow.

    Args:
        bare: The springs, without dashpots and motors.
        parts: Constants of the members.
        step: Largest stable step of the system without these springs [s].
    """
    one = jnp.ones_like(bare.stiffness)
    bounds = replace(bare, stiffness=one).stability_bounds(parts)
    square, _ = largest_rates(bounds, parts)
    return affordable_stiffness(step, square).astype(one.dtype)


def check_limited(name: str, unit: str, a: Points, b: Points, parts: AllParts) -> None:
    """Raises unless a rod is joined, whose time step determines a stiffness.

    Raises:
        ValueError: If both members are rigid bodies.
    """
    if not (parts[a.member].is_rod or parts[b.member].is_rod):
        raise ValueError(
            f"a joint between rigid bodies {a.member!r} and {b.member!r} needs the "
            f"number {name} [{unit}]"
        )


def _check_near(a: Place, b: Place, state: Mapping[str, Any]) -> None:
    """Raises a `ValueError` if two nodes are further apart than an element is long.

    Nodes of a traced state, and bodies, are not checked.
    """
    one, two = position_of("a", a, state), position_of("b", b, state)
    spacings = one.spacing, two.spacing
    if is_traced(one, two) or not all(np.isfinite(spacings)):
        return
    apart = float(np.linalg.norm(np.asarray(one.place) - np.asarray(two.place)))
    if apart > max(spacings):
        raise ValueError(
            f"{tuple(a)} and {tuple(b)} are {apart:.3g} m apart, further than their "
            f"elements are long ({max(spacings):.3g} m): give at, where the joint is"
        )


def _point(name: str, value: Numbers) -> Array:
    return as_array(name, value, "m", [(3,)])


def _poses(places: Any, state: Mapping[str, Any]) -> list[Any]:
    return [position_of("a", place, state) for place in pairs(places, places)[0]]
