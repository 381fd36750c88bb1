"""Places on members of a system: names, indices, and reading and loading there.

A place is named, such as `("arm", "tip")`, and resolved to the indices of a node and an
element in the rows of its member, its flat arrays. `gather` reads entries of a row, and
`scatter_add` and `sum_of_loads` add to them.

There are no scatter operations: each entry of a row collects the values that go to it.
So sums are the same in every run, on every device. Stretches of consecutive indices are
sliced and inserted as a whole, at a cost in proportion to their length. A few other
indices are compared one by one. More of them are compared with all entries in one
operation, which fuses with the surrounding program and has the same form when it is
transposed. For a very large number of indices a table is used.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion, split_quaternion
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, added
from jaxrod.rods.rod import Layout
from jaxrod.structure import pytree, static, storable
from jaxrod.systems.coupling import AllParts, AllSeen, Parts, Seen, check_named
from jaxrod.validation import check_count, is_traced

Place = Sequence[Any]
"""Place on a member: `("arm", "tip")` or `("arm", 7)` on a rod, `("arms", 2, "base")`
on one of equal rods, `("ball",)` or `("balls", 3)` on bodies and points. A place on a
rod has the orientation of the element after the node; at the tip, of the last element.
"""
FEW = 8
"""Largest number of indices that are compared one by one."""
MOST_STRETCHES = 16
"""Largest number of stretches of consecutive indices that are sliced one by one."""
MOST_COMPARED = 2**22
"""Largest number of pairs of an index and an entry that one operation compares.

It is this large because in reverse mode XLA's CPU compiler (0.10.1, with the fusion
that `configure_cpu` asks for) gives up on some programs that gather entries."""


@storable
@dataclass(init=False, repr=False, eq=False)
class Indices:
    """Static array of integers: hashable, and compared by value."""

    values: np.ndarray
    """The integers, read-only."""

    def __init__(self, values: Any) -> None:
        """Stores a read-only copy of the integers."""
        self.values = np.array(values, np.int32, ndmin=1)
        self.values.flags.writeable = False
        self._hash = hash((self.values.shape, self.values.tobytes()))

    def __hash__(self) -> int:
        """Hash of the integers, computed once."""
        return self._hash

    def __eq__(self, other: object) -> bool:
        """Whether the other object has equal integers."""
        return (
            isinstance(other, Indices)
            and self._hash == other._hash
            and np.array_equal(self.values, other.values)
        )

    def __len__(self) -> int:
        """Number of integers."""
        return len(self.values)

    def __repr__(self) -> str:
        """Text such as `Indices([0, 1])`."""
        return f"Indices({self.values.tolist()})"


@pytree
class Points:
    """Nodes and elements of one member, by index over all its rods or bodies."""

    member: str = static()
    """Name of the member."""
    nodes: Indices = static()
    """Indices of nodes, over all rods of the member; or of bodies."""
    elements: Indices = static()
    """Indices of the elements that turn with these nodes; or of bodies."""

    def regridded(self, grids: Any) -> Points:
        """The same points on rods with other numbers of elements."""
        if not grids.changes(self.member):
            return self
        nodes = grids.nodes(self.member, self.nodes.values)
        elements = grids.elements(self.member, nodes)
        return Points(self.member, Indices(nodes), Indices(elements))

    def check(self, parts: AllParts) -> None:
        """Raises a `ValueError` if the member is missing or has too few nodes."""
        check_named(self.member, parts)
        largest = parts[self.member].n_nodes
        if np.any(self.nodes.values >= largest):
            raise ValueError(
                f"{self.member!r} has {largest} nodes, got node "
                f"{int(np.max(self.nodes.values))}"
            )


def layouts_of(state: Mapping[str, Any]) -> dict[str, Layout]:
    """Layouts (numbers of rods and elements) of all members, from a state.

    Raises:
        TypeError: If it is not a mapping from names to states of rods and bodies.
    """
    if not isinstance(state, Mapping):
        raise TypeError(
            "state must be a dict of the states of all members by name, got "
            f"{type(state).__name__}"
        )
    return {name: _layout(name, own) for name, own in state.items()}


def _layout(name: str, state: Any) -> Layout:
    """Layout of the state of the member `name`; a TypeError if it has none."""
    layout: Layout | None = getattr(state, "layout", None)
    if layout is None:
        raise TypeError(
            f"state of {name!r} must be a RodState, a BodyState or another with a "
            f"layout, got {type(state).__name__}"
        )
    return layout


def resolved(
    name: str, place: Place, layouts: Mapping[str, Layout]
) -> tuple[str, int, int]:
    """Name of the member of a place, and the indices of its node and its element.

    Indices count over all rods of the member.

    Args:
        name: Name of the argument, for messages.
        place: The place; see `Place`.
        layouts: Layouts of all members.

    Raises:
        ValueError: If there is no such place.
        TypeError: If `place` is not a sequence such as `("arm", "tip")`.
    """
    if isinstance(place, str) or not isinstance(place, Sequence) or not place:
        raise TypeError(f'{name} must be a place such as ("arm", "tip"), got {place!r}')
    member, *rest = place
    check_named(member, layouts, where=name)
    own = layouts[member]
    if not own.is_rod:
        if len(rest) > 1:
            raise ValueError(f"{name}: a body has no ends or nodes, got {place!r}")
        body = _of_many(name, f"of {member!r}", rest, own.count)
        return member, body, body
    if len(rest) not in (1, 2):
        raise ValueError(
            f'{name}: a place on a rod is an end ("base", "tip") or a node, '
            f"got {place!r}"
        )
    rod = _of_many(name, f"of {member!r}", rest[:-1], own.count)
    node = _node(name, member, rest[-1], own)
    element = min(node, own.n_elements - 1)
    per_rod = own.n_elements
    return member, rod * (per_rod + 1) + node, rod * per_rod + element


def _of_many(name: str, where: str, given: Sequence[Any], count: int) -> int:
    """Index of one of `count` rods or bodies; it may be omitted if `count` is one."""
    if not given:
        if count > 1:
            raise ValueError(f"{name}: there are {count} {where}, say which")
        return 0
    which = check_count(f"{name}: the number {where}", given[0], 0, count - 1)
    return int(which)


def _node(name: str, member: str, node: Any, layout: Layout) -> int:
    """Index of a node of one rod, from an end or a number, which may be negative."""
    last = layout.n_elements
    if node == "base":
        return 0
    if node == "tip":
        return last
    if isinstance(node, str):
        raise ValueError(
            f'{name}: an end is "base" or "tip", got {node!r} of {member!r}'
        )
    counted = node + last + 1 if isinstance(node, int) and node < 0 else node
    return check_count(f"{name}: node of {member!r}", counted, 0, last)


def pairs(
    a: Place | Sequence[Place], b: Place | Sequence[Place]
) -> tuple[list[Place], list[Place]]:
    """Two lists of places of equal length, from arguments of one place or several."""
    first, second = _listed("a", a), _listed("b", b)
    if len(first) != len(second):
        raise ValueError(
            "a and b must have the same number of places, got "
            f"{len(first)} and {len(second)}"
        )
    return first, second


def _listed(name: str, places: Any) -> list[Place]:
    """List of places, from one place or several; `name` is for messages."""
    if isinstance(places, Sequence) and places and not isinstance(places, str):
        if isinstance(places[0], str):
            return [places]
        return list(places)
    raise TypeError(
        f'{name} must be a place such as ("arm", "tip"), or several, got {places!r}'
    )


def points_of(name: str, places: Sequence[tuple[str, int, int]]) -> Points:
    """Points from places of one member, as `resolved` returns them.

    Raises:
        ValueError: If the places are of several members.
    """
    members = {member for member, _, _ in places}
    if len(members) != 1:
        raise ValueError(
            f"all places of {name} must be of one member, got {sorted(members)}: give "
            "a coupling for each"
        )
    return Points(
        members.pop(),
        Indices([node for _, node, _ in places]),
        Indices([element for _, _, element in places]),
    )


@pytree
class Pose:
    """Position and orientation of a place in a state."""

    place: Any
    """Position of the node, or of the body's origin [m]."""
    orientation: Quaternion
    """Orientation of the element that turns with the place, or of the body."""
    spacing: Any
    """Current length of that element [m]; infinite for a body."""


def position_of(name: str, place: Place, state: Mapping[str, Any]) -> Pose:
    """Pose of a place in a state.

    Args:
        name: Name of the argument, for messages.
        place: The place; see `Place`.
        state: State of a system.
    """
    layouts = layouts_of(state)
    member, node, element = resolved(name, place, layouts)
    own, layout = state[member], layouts[member]
    positions, orientations = own.positions, own.orientations
    if not is_traced(positions, orientations):
        # On the host: this is little work, but it would take long to compile.
        positions, orientations = map(np.asarray, (positions, orientations))
    positions, orientations = layout.row(positions), layout.row(orientations)
    x = positions[:, node]
    w = split_quaternion(orientations[:, element])
    if not layout.is_rod:
        return Pose(x, w, np.inf)
    # Each rod has one node more than elements.
    start = element + element // layout.n_elements
    edge = positions[:, start + 1] - positions[:, start]
    return Pose(x, w, (edge[0] ** 2 + edge[1] ** 2 + edge[2] ** 2) ** 0.5)


def orientation_at(seen: Seen, points: Points) -> Quaternion:
    """Orientation of the element of each point, a quaternion, material to world."""
    w, x, y, z = (gather(c, points.elements) for c in seen.motion.orientation)
    return w, x, y, z


def spin_at(seen: Seen, points: Points) -> Vec3:
    """Angular velocity of the element of each point, world frame [rad/s]."""
    x, y, z = (gather(c, points.elements) for c in seen.angular_velocities)
    return x, y, z


def least_inertia(parts: Parts, points: Points) -> Array:
    """Smallest moment of inertia of the element of each point [kg m^2]."""
    return jnp.min(parts.inertias, axis=0)[points.elements.values]


def gather(row: Array, index: Indices) -> Array:
    """Entries of a row at the given indices (gather)."""
    size = row.shape[0]
    stretches = _stretches(index)
    if stretches is not None:
        cut = [row[k : k + last - first] for k, first, last in stretches]
        return cut[0] if len(cut) == 1 else jnp.concatenate(cut)
    if len(index) <= FEW:
        return jnp.stack([row[int(k)] for k in index.values])
    if len(index) * size <= MOST_COMPARED:
        return jnp.sum(jnp.where(_same(index, size), row[None, :], 0), axis=1)
    return row[index.values]


def scatter_set(row: Array, index: Indices, values: Array) -> Array:
    """Copy of a row with `values` at the indices `index`, which must be distinct."""
    size = row.shape[0]
    if _stretches(index) is None and len(index) <= FEW:
        numbers = np.arange(size)
        for k, place in enumerate(index.values):
            row = jnp.where(numbers == place, values[k], row)
        return row
    there = np.zeros(size, bool)
    there[index.values] = True
    return jnp.where(there, scatter_add(values, index, size), row)


def scatter_add(values: Array, index: Indices, size: int) -> Array:
    """Row of `size` zeros plus `values`, each added at its `index` (scatter-add)."""
    stretches = _stretches(index)
    if stretches is not None:
        zero = jnp.zeros((), values.dtype)
        widened = [
            jax.lax.pad(values[first:last], zero, [(k, size - k - last + first, 0)])
            for k, first, last in stretches
        ]
        return functools.reduce(jnp.add, widened)
    if len(index) <= FEW:
        numbers = np.arange(size)
        total = jnp.zeros(size, values.dtype)
        for k, place in enumerate(index.values):
            total = total + jnp.where(numbers == place, values[k], 0)
        return total
    if len(index) * size <= MOST_COMPARED:
        return jnp.sum(jnp.where(_same(index, size), values[:, None], 0), axis=0)
    padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
    return functools.reduce(
        jnp.add, [padded[entries] for entries in _table(index, size)]
    )


@functools.lru_cache(maxsize=256)
def _stretches(index: Indices) -> tuple[tuple[int, int, int], ...] | None:
    """Stretches of consecutive indices: `(first index, begin, end)` each.

    Begin and end are positions in the list of indices. `None` if there are too many
    stretches, or more than half as many as indices.
    """
    cuts = np.flatnonzero(np.diff(index.values) != 1) + 1
    bounds = [0, *cuts.tolist(), len(index)]
    if len(bounds) - 1 > MOST_STRETCHES or 2 * (len(bounds) - 1) > max(len(index), 2):
        return None
    return tuple(
        (int(index.values[first]), first, last)
        for first, last in itertools.pairwise(bounds)
    )


@functools.lru_cache(maxsize=256)
def _same(index: Indices, size: int) -> np.ndarray:
    """Mask `(indices, size)`: true at (i, j) where the index number i equals j."""
    return index.values[:, None] == np.arange(size)[None, :]


@functools.lru_cache(maxsize=256)
def _table(index: Indices, size: int) -> np.ndarray:
    """Table `(most, size)`: in column j the positions of the values added to entry j.

    `most` is the largest number of values for one entry. Columns are padded with the
    number of all values, which is the position of an appended zero.
    """
    counts = np.bincount(index.values, minlength=size)
    table = np.full((max(int(np.max(counts)), 1), size), len(index), np.int32)
    filled = np.zeros(size, np.int32)
    for k, place in enumerate(index.values):
        table[filled[place], place] = k
        filled[place] += 1
    return table


def sum_of_loads(*given: tuple[Points, Loads], seen: AllSeen) -> dict[str, Loads]:
    """Loads on whole members, from loads at places.

    Args:
        *given: Pairs of places on one member, such as `Anchors.points`, and loads
            there: forces [N] and couples [N m], one entry for each place.
        seen: The members by name, as the hooks of couplings get them.

    Returns:
        Loads by member, with an entry for each of its nodes and elements.

    Example:
        >>> seen = {"arm": extend.Seen(scene.as_member().parts(), motion)}
        >>> tip = extend.anchors([("arm", "tip")], {"arm": state})
        >>> push = extend.Loads((jnp.ones(1), jnp.zeros(1), jnp.zeros(1)))
        >>> total = extend.sum_of_loads((tip.points, push), seen=seen)
        >>> total["arm"].forces[0].shape, float(total["arm"].forces[0][-1])
        ((11,), 1.0)
    """
    total: dict[str, Loads] = {}
    for points, loads in given:
        parts = seen[points.member].parts
        size = parts.n_nodes, parts.inertias.shape[1]
        forces = _spread(loads.forces, points.nodes, size[0])
        couples = _spread(loads.couples, points.elements, size[1])
        earlier = total.get(points.member, Loads())
        total[points.member] = added(earlier, Loads(forces, couples))
    return total


def _spread(vector: Vec3 | None, index: Indices, size: int) -> Vec3 | None:
    """Vector field on a row of `size` entries: sums of the values with each index."""
    if vector is None:
        return None
    return vectors.mapped(lambda component: scatter_add(component, index, size), vector)
