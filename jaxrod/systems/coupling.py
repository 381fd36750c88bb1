"""The base of all that members of a system do to each other, and its hooks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from jaxtyping import Array

from jaxrod.effects.base import StabilityBound
from jaxrod.rods.motion import Loads, Motion
from jaxrod.systems.parts import Parts, Seen

AllSeen = Mapping[str, Seen]
"""Members of a system at a moment, by name."""
AllParts = Mapping[str, Parts]
"""Constants of the members of a system, by name."""
TiedPair = tuple[str, int, str, int]
"""Member and node of the one and of the other."""


class Coupling:
    """Base of all couplings: every hook does nothing. A subclass is a pytree.

    Hooks are pure. Members are named; a member that a hook does not return is left as
    it is. Nodes and elements of a member lie in one row (`jaxrod.systems.parts`).

    Forces come in pairs: all loads of a coupling together have no force, and no couple
    about any point. Ties (`constrain`, `exchange`, `constrain_rates`) hold exactly.
    """

    def check(self, parts: AllParts) -> None:
        """Raises a `ValueError` where the coupling does not fit the members."""

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> Coupling:
        """Itself with structure that follows from the members; for `make_system`.

        Args:
            parts: Constants of the members.
            tied: Pairs of nodes that are tied together.
        """
        return self

    def joined_nodes(self) -> Iterable[tuple[str, int]]:
        """Nodes of members that are one with other nodes, or part of a body."""
        return ()

    def with_free_ends(self, free: Mapping[str, Array]) -> Coupling:
        """The same coupling of rods with ends that may go on in other members.

        Args:
            free: By member, one for the first and the last end of each of its rods that
                is free, zero where it is tied to a node or attached to a body,
                `(rods, 2)`.
        """
        return self

    def prepared(self, parts: AllParts) -> Coupling:
        """Itself with constants worked out once, before the first step."""
        return self

    @property
    def refresh_every(self) -> int | None:
        """Steps after which what `search` found is looked for anew; `None`: nothing."""
        return None

    @property
    def is_sized(self) -> bool:
        """Whether there is room for what `search` finds."""
        return True

    def sized(self, seen: AllSeen) -> Coupling:
        """Itself with room for what `search` finds in a state; for `make_system`."""
        return self

    def search(self, seen: AllSeen) -> Any:
        """What it looks for once in a while, as arrays; with `refresh_every`.

        With fields `missed`, `used` and the coupling's field `found`, in which it is
        until the next search: see `jaxrod.systems.neighbour_lists`.
        """
        # Not abstract: couplings without `refresh_every` are never asked.
        raise NotImplementedError(f"{type(self).__name__} has no search")

    def moved(self, seen: AllSeen) -> Array:
        """How far members are from where `search` was, over how far they may be."""
        # As above.
        raise NotImplementedError(f"{type(self).__name__} has no moved")

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces on nodes, world frame [N], and couples on elements, own frames [N m].

        Called where the loads of effects are.
        """
        return {}

    def energy(self, seen: AllSeen) -> Array | float:
        """Potential energy [J]."""
        return 0.0

    def constrain(self, seen: AllSeen) -> dict[str, Motion]:
        """Motions with what follows another member where that one has it."""
        return {}

    def exchange(self, before: AllSeen, after: AllSeen) -> dict[str, Loads]:
        """Impulses that pass from member to member in a kick.

        Args:
            before: Before the kick.
            after: After it; every member was kicked by its own loads.

        Returns:
            Forces times time on nodes, world frame [N s], and couples times time on
            elements, world frame [N m s].
        """
        return {}

    def constrain_rates(self, seen: AllSeen) -> dict[str, Motion]:
        """Motions with the rates of what is tied, after kicks and exchanges."""
        return {}

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Bounds on how steeply `loads` change, member by member.

        For a spring of stiffness `k` on an elongation that changes by `g_i . u_i`,
        `k (sum_j |g_j|^2 / m_j) m_i` on each node `i` is enough: see `shared_bound`.
        """
        return {}

    def violation(self, seen: AllSeen) -> Array | None:
        """How far a state is from what is tied [1]; above one `health` flags it."""
        return None
