"""Ends of rods: free, tied to another rod, or closed to a ring.

A free end has an end face in contact; an end that is tied to another node has none.

Contact of rods with rods sums over segments and subtracts the nodes between them
(inclusion-exclusion), so that each contact counts once. Where ends of rods are tied, a
node lies between segments of different rods. So all nodes but one of a group of tied
nodes are subtracted, too. Only the last node of a rod can be subtracted, which is
enough for rods welded end to end and for closed rods.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from jaxrod.systems.sites.coupling import AllParts, TiedPair


def last_but_continued(
    member: str, parts: AllParts, tied: Sequence[TiedPair]
) -> tuple[int, ...]:
    """Indices of last segments of rods that continue: their last nodes are subtracted.

    Args:
        member: Name of the member.
        parts: Constants of all members.
        tied: Pairs of nodes that are tied together, in both orders.
    """

    def elements(name: str) -> int:
        return parts[name].n_elements

    def is_last(place: tuple[str, int]) -> bool:
        n = elements(place[0])
        return place[1] % (n + 1) == n

    fellows: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for one, i, other, j in tied:
        fellows.setdefault((one, i), []).append((other, j))
    n, found = elements(member), []
    for rod in range(parts[member].count):
        here = (member, rod * (n + 1) + n)
        others = fellows.get(here, [])
        # One node of a group is not subtracted: one that is not a last node, or else
        # the first by name.
        stays = others and all(map(is_last, others)) and here < min(others)
        if others and not stays:
            found.append(rod * n + n - 1)
    return tuple(found)


def free_ends(
    member: str, parts: AllParts, held: Iterable[tuple[str, int]]
) -> np.ndarray:
    """Flags of the first and last end of a member's rods: 1 if free, 0 otherwise.

    Args:
        member: Name of the member.
        parts: Constants of all members.
        held: Members and indices of nodes that are tied to other nodes or attached to
            bodies.

    Returns:
        Flags `(rods, 2)`.
    """
    own = parts[member]
    last = own.n_elements
    free = np.ones((own.count, 2))
    for name, node in held:
        rod, place = divmod(node, last + 1)
        if name == member and place in (0, last):
            free[rod, int(place == last)] = 0.0
    return free


def closed_rods(
    member: str, parts: AllParts, tied: Sequence[TiedPair]
) -> tuple[int, ...]:
    """Indices of a member's rods whose last node is tied to its first and to no other.

    Args:
        member: Name of the member.
        parts: Constants of all members.
        tied: Pairs of nodes that are tied together, in both orders.
    """
    n, found = parts[member].n_elements, []
    for rod in range(parts[member].count):
        ends = (member, rod * (n + 1)), (member, rod * (n + 1) + n)
        fellows = [{(p[2], p[3]) for p in tied if p[:2] == end} for end in ends]
        if n > 1 and fellows == [{ends[1]}, {ends[0]}]:
            found.append(rod)
    return tuple(found)
