r"""Ties: nodes of rods that always share one position, exactly.

After every kick, tied nodes with masses $m_i$ get one velocity, $\sum m_i v_i / \sum
m_i$. The constraint is linear in the positions, so this projection is the constrained
Verlet step itself. It conserves momentum, angular momentum and energy. It does not
limit the time step, because added inertia only lowers frequencies. Along axes that a
support holds, the nodes get the support's velocity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.rods.motion import Loads, Motion
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import AllParts, AllSeen, Coupling, TiedPair
from jaxrod.systems.joints.places import (
    Indices,
    Place,
    Points,
    gather,
    layouts_of,
    pairs,
    position_of,
    resolved,
    scatter_add,
    scatter_set,
    sum_of_loads,
)
from jaxrod.validation import is_traced

_APART = 1e-3
"""Largest initial distance of tied nodes divided by the distance to the next node
[1]."""


@pytree
class Tie(Coupling):
    """Groups of nodes; all nodes of a group move as one. See `tie`."""

    points: tuple[Points, ...]
    """Tied nodes; one entry for each member."""
    groups: tuple[Indices, ...] = static()
    """Index of the group of each tied node; one array for each member."""
    n_groups: int = static(default=1)
    """Number of groups of nodes that are tied together."""

    def check(self, parts: AllParts) -> None:
        """Raises ValueError if a member is missing, rigid or has too few nodes."""
        for points in self.points:
            points.check(parts)
            if not parts[points.member].is_rod:
                raise ValueError(
                    f"a tie joins nodes of rods, and {points.member!r} is rigid: use "
                    "jaxrod.systems.attach"
                )

    def constrain(self, seen: AllSeen) -> dict[str, Motion]:
        """Gives all nodes of a group one position, which removes drift by round-off."""
        return self._together(seen, "position")

    def constrain_rates(self, seen: AllSeen) -> dict[str, Motion]:
        """Gives all nodes of a group one velocity, the mean weighted by mass.

        Along an axis on which supports hold some of the nodes, it is the plain mean of
        the held ones.
        """
        return self._together(seen, "velocity")

    def _together(self, seen: AllSeen, field: str) -> dict[str, Motion]:
        """Motions of members with a field made equal at all nodes of each group.

        The field is "position" or "velocity".
        """
        shared = [self._shared(seen, field, k) for k in range(3)]
        changed = {}
        for number, points in enumerate(self.points):
            motion = seen[points.member].motion
            x, y, z = (
                scatter_set(component, points.nodes, shared[k][number])
                for k, component in enumerate(getattr(motion, field))
            )
            kept: dict[str, Any] = {field: (x, y, z)}
            if field == "position" and motion.remainder is not None:
                u, v, w = (
                    scatter_set(c, points.nodes, jnp.zeros(len(points.nodes), c.dtype))
                    for c in motion.remainder
                )
                kept["remainder"] = (u, v, w)
            changed[points.member] = replace(motion, **kept)
        return changed

    @property
    def tied_pairs(self) -> tuple[TiedPair, ...]:
        """All pairs of tied nodes, each in both orders."""
        nodes = [
            (points.member, int(node), int(group))
            for points, groups in zip(self.points, self.groups, strict=True)
            for node, group in zip(points.nodes.values, groups.values, strict=True)
        ]
        return tuple(
            (a, i, b, j)
            for k, (a, i, g) in enumerate(nodes)
            for m, (b, j, h) in enumerate(nodes)
            if g == h and k != m
        )

    def merged(self, others: Sequence[Any]) -> Tie:
        """Merges this tie and others; groups that share a node become one."""
        return _merged([self, *others])

    def joined_nodes(self) -> list[tuple[str, int]]:
        """All tied nodes, as pairs of a member and a node."""
        return [
            (points.member, int(i))
            for points in self.points
            for i in points.nodes.values
        ]

    def _shared(self, seen: AllSeen, field: str, axis: int) -> Any:
        """Value that tied nodes share, for component `axis` of a field of `Motion`.

        Nodes tied to each other form a group. Their value is the mean over the group,
        weighted by mass; if supports hold some of these nodes, it is the plain mean of
        the held ones. Returns an array over the tied nodes for each entry of `points`.
        """
        masses, speeds, held = [], [], []
        for points in self.points:
            own = seen[points.member]
            masses.append(gather(own.parts.node_masses, points.nodes))
            values = getattr(own.motion, field)[axis]
            speeds.append(gather(values, points.nodes))
            if own.parts.held is None:
                held.append(jnp.zeros_like(masses[-1]))
            else:
                held.append(gather(own.parts.held[axis], points.nodes))
        fields = map(jnp.concatenate, (masses, speeds, held))
        shared = _means(*fields, group=self._group(), n_groups=self.n_groups)
        return [gather(shared, groups) for groups in self.groups]

    def constraint_loads(
        self, seen: AllSeen, rates: Mapping[str, Motion]
    ) -> dict[str, Loads]:
        """Forces that give the nodes of a group one acceleration; their sum is zero.

        Held nodes of a group share what balances the forces on the others.
        """
        moving = {
            points.member: replace(
                seen[points.member],
                motion=replace(
                    seen[points.member].motion, velocity=rates[points.member].velocity
                ),
            )
            for points in self.points
        }
        group = self._group()
        masses = [
            gather(seen[p.member].parts.node_masses, p.nodes) for p in self.points
        ]
        mass = jnp.concatenate(masses)
        sizes = np.cumsum([len(points.nodes) for points in self.points])[:-1]
        pulls = []
        for axis in range(3):
            shared = jnp.concatenate(self._shared(moving, "velocity", axis))
            own, held = [], []
            for points in self.points:
                at = moving[points.member]
                own.append(gather(at.motion.velocity[axis], points.nodes))
                flags = at.parts.held
                none = jnp.zeros_like(own[-1])
                held.append(
                    none if flags is None else gather(flags[axis], points.nodes)
                )
            is_held = jnp.concatenate(held) > 0
            free = jnp.where(is_held, 0, mass * (shared - jnp.concatenate(own)))
            left = gather(scatter_add(free, group, self.n_groups), group)
            count = gather(
                scatter_add(is_held.astype(free.dtype), group, self.n_groups), group
            )
            pull = jnp.where(is_held, -left / jnp.where(count > 0, count, 1), free)
            pulls.append(jnp.split(pull, sizes))
        return sum_of_loads(
            *(
                (points, Loads((pulls[0][k], pulls[1][k], pulls[2][k])))
                for k, points in enumerate(self.points)
            ),
            seen=seen,
        )

    def _group(self) -> Indices:
        """Index of the group of every tied node, with all members concatenated."""
        return Indices(np.concatenate([groups.values for groups in self.groups]))

    def violation(self, seen: AllSeen) -> Array:
        """Largest distance of a tied node from its group's mean, in rod radii [1].

        The radius is the smallest of the tied rods.
        """
        places, radii = [], []
        for points in self.points:
            own = seen[points.member]
            places.append([gather(c, points.nodes) for c in own.motion.position])
            assert own.parts.radii is not None
            radii.append(jnp.min(own.parts.radii))
        group = self._group()
        count = np.bincount(group.values, minlength=self.n_groups)
        squares = []
        for axis in range(3):
            place = jnp.concatenate([own[axis] for own in places])
            mean = scatter_add(place, group, self.n_groups) / count
            squares.append((place - gather(mean, group)) ** 2)
        apart = jnp.sqrt(squares[0] + squares[1] + squares[2])
        return jnp.max(apart) / jnp.min(jnp.stack(radii))


@partial(jax.jit, static_argnames=("group", "n_groups"))
def _means(
    mass: Array, value: Array, held: Array, *, group: Indices, n_groups: int
) -> Array:
    """Mean of a value over each group of nodes: see `Tie._shared`.

    It is compiled so that it is traced once for all axes, fields and moments.
    """

    def total(field: Array) -> Array:
        return scatter_add(field, group, n_groups)

    free = total(mass * value) / total(mass)
    count = total(held)
    led = total(held * value) / jnp.where(count > 0, count, 1)
    return jnp.where(count > 0, led, free)


def tie(
    a: Place | Sequence[Place], b: Place | Sequence[Place], state: Mapping[str, Any]
) -> Tie:
    """Ties nodes of rods together exactly: a ball joint without compliance.

    Elements turn freely about the shared node; see `weld` for an elastic joint.

    Args:
        a: A place, `("arm", "tip")`, `("arm", 7)` or `("arms", 2, "base")`; or
            several.
        b: The place to which `a` is tied; or one for each place of `a`.
        state: State of the system, in which tied nodes are at one place.

    Returns:
        A coupling for `make_system`.

    Raises:
        ValueError: If there is no such place, or two tied nodes are apart.
        TypeError: If a place is not a sequence such as `("arm", "tip")`.

    Example:
        >>> states = {"left": state, "right": state}
        >>> tips = systems.tie(("left", "tip"), ("right", "tip"), states)
        >>> system = jaxrod.make_system({"left": scene, "right": scene}, tips)
        >>> system.couplings[0].joined_nodes()
        [('right', 10), ('left', 10)]
    """
    first, second = pairs(a, b)
    layouts = layouts_of(state)
    found: dict[tuple[str, int], int] = {}
    elements: dict[tuple[str, int], int] = {}
    parent: list[int] = []

    def number(name: str, place: Place) -> int:
        member, node, element = resolved(name, place, layouts)
        key = (member, node)
        if key not in found:
            found[key] = len(parent)
            elements[key] = element
            parent.append(len(parent))
        return found[key]

    def root(k: int) -> int:
        while parent[k] != k:
            k = parent[k]
        return k

    for one, two in zip(first, second, strict=True):
        check_together(one, two, state)
        parent[root(number("a", one))] = root(number("b", two))
    return _tie_of(found, elements, [root(k) for k in range(len(parent))])


def _merged(ties: Sequence[Tie]) -> Tie:
    """One tie for several ties; groups that share a node become one."""
    if len(ties) == 1:
        return ties[0]
    found: dict[tuple[str, int], int] = {}
    elements: dict[tuple[str, int], int] = {}
    parent: list[int] = []

    def root(k: int) -> int:
        while parent[k] != k:
            k = parent[k]
        return k

    for one in ties:
        first_of: dict[int, int] = {}
        for points, groups in zip(one.points, one.groups, strict=True):
            for node, element, group in zip(
                points.nodes.values, points.elements.values, groups.values, strict=True
            ):
                key = (points.member, int(node))
                if key not in found:
                    found[key] = len(parent)
                    elements[key] = int(element)
                    parent.append(len(parent))
                leader = first_of.setdefault(int(group), found[key])
                parent[root(found[key])] = root(leader)
    return _tie_of(found, elements, [root(k) for k in range(len(parent))])


def _tie_of(
    found: Mapping[tuple[str, int], int],
    elements: Mapping[tuple[str, int], int],
    roots: Sequence[int],
) -> Tie:
    """Builds a tie from groups of nodes.

    Args:
        found: Number of each tied node, by member and node.
        elements: Element of each tied node, by member and node.
        roots: For each number, a number that all nodes of its group share.
    """
    _, group = np.unique(roots, return_inverse=True)
    points, groups = [], []
    for member in dict.fromkeys(member for member, _ in found):
        keys = [key for key in found if key[0] == member]
        points.append(
            Points(
                member,
                Indices([node for _, node in keys]),
                Indices([elements[key] for key in keys]),
            )
        )
        groups.append(Indices([group[found[key]] for key in keys]))
    return Tie(tuple(points), tuple(groups), int(np.max(group)) + 1)


def check_together(a: Place, b: Place, state: Mapping[str, Any]) -> None:
    """Raises a `ValueError` if two places do not coincide in a concrete state."""
    one, two = position_of("a", a, state), position_of("b", b, state)
    if is_traced(one, two):
        return
    apart = float(np.linalg.norm(np.asarray(one.place) - np.asarray(two.place)))
    nearest = min(float(one.spacing), float(two.spacing))
    if apart > _APART * nearest:
        raise ValueError(
            f"{tuple(a)} and {tuple(b)} must be at one place, but are {apart:.3g} m "
            "apart"
        )
