"""Ends of rods that go on in other rods, for contact that counts every place once.

Contact counts segments less the nodes between two of them. Where the ends of rods are
tied, a node is between segments that are neighbours in no row: of a group of tied nodes
all but one are to be taken off besides. Of those this can be done for last nodes, which
are enough for rods welded end to end, and for closed ones.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxrod.systems.coupling import AllParts, TiedPair


def last_but_continued(
    member: str, parts: AllParts, tied: Sequence[TiedPair]
) -> tuple[int, ...]:
    """Last segments of rods of a member after which another rod goes on.

    Args:
        member: Name of the member.
        parts: Of all members.
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
        # One of a group stays: one that is no last node, or else the first by name.
        stays = others and all(map(is_last, others)) and here < min(others)
        if others and not stays:
            found.append(rod * n + n - 1)
    return tuple(found)
