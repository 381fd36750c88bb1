"""Ends of rods that go on in other rods, for contact that counts every place once.

Contact counts segments less the nodes between two of them. Where the ends of rods are
tied, a node is between segments that are neighbours in no row: of a group of tied nodes
all but one are to be taken off besides. Of those this can be done for last nodes, which
are enough for rods welded end to end, and for closed ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from jaxrod.systems.coupling import TiedPair


def ends_alone(
    member: str,
    count: int,
    n_elements: Mapping[str, int],
    tied: Sequence[TiedPair],
) -> np.ndarray:
    """Whether each segment of a member is a rod's last, and nothing follows.

    Args:
        member: Name of the member.
        count: Its rods.
        n_elements: Elements of the rods of all members.
        tied: Pairs of nodes that are tied together, in both orders.
    """
    n = n_elements[member]

    def is_last(place: tuple[str, int]) -> bool:
        return place[1] % (n_elements[place[0]] + 1) == n_elements[place[0]]

    fellows: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for one, i, other, j in tied:
        fellows.setdefault((one, i), []).append((other, j))
    alone = np.arange(count * n) % n == n - 1
    for rod in range(count):
        here = (member, rod * (n + 1) + n)
        others = fellows.get(here, [])
        # One of a group stays: one that is no last node, or else the first by name.
        stays = others and all(map(is_last, others)) and here < min(others)
        if others and not stays:
            alone[rod * n + n - 1] = False
    return alone
