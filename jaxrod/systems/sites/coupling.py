"""The base of all couplings between members of a system, and its hooks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from jaxtyping import Array

from jaxrod.effects.base import Reaction, StabilityBound
from jaxrod.rods.motion import Loads, Motion
from jaxrod.systems.members.parts import Parts, Seen
from jaxrod.systems.members.rigid_stepper import Carried

AllSeen = Mapping[str, Seen]
"""Constants and motion of the members of a system at one moment, by name."""
AllParts = Mapping[str, Parts]
"""Constants of the members of a system, by name."""
TiedPair = tuple[str, int, str, int]
"""Two tied nodes: member and node of the first, member and node of the second."""


class Coupling:
    """Base of all couplings, whose hooks do nothing by default. A subclass is a pytree.

    Hooks are pure. Members are identified by name; a member that a hook does not return
    is unchanged. All nodes of a member are in one flat array, and so are its elements
    (`jaxrod.systems.members.parts`).

    Unless a coupling acts from outside, as a pose spring does, its forces come in pairs
    without a total force or moment. Nothing checks this. Ties (`constrain`, `exchange`,
    `constrain_rates`) hold exactly.

    Example:
        >>> @extend.pytree
        ... class Wind(extend.Coupling):
        ...     force: extend.Leaf  # on the tip of the arm, along x [N]
        ...     tip: extend.Anchors
        ...
        ...     def loads(self, seen):
        ...         arm, zero = seen["arm"], jnp.zeros(1)
        ...         force = (zero + self.force, zero, zero)
        ...         there = self.tip.positions(arm)
        ...         acting = self.tip.points, self.tip.loads(arm, force, there)
        ...         return extend.sum_of_loads(acting, seen=seen)
        >>> tip = extend.anchors([("arm", "tip")], {"arm": state})
        >>> system = jaxrod.make_system({"arm": scene}, Wind(0.5, tip))
        >>> len(system.couplings)
        1
    """

    def check(self, parts: AllParts) -> None:
        """Raises a `ValueError` if the coupling does not fit the members."""

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> Coupling:
        """Copy with the static structure that depends on the members.

        `make_system` calls it.

        Args:
            parts: Constants of the members.
            tied: Pairs of nodes that are tied together.
        """
        return self

    def joined_nodes(self) -> Iterable[tuple[str, int]]:
        """Nodes tied to other nodes or attached to bodies, as `(member, node)`."""
        return ()

    @property
    def followed(self) -> str | None:
        """Name of the bodies to which `joined_nodes` are attached; else `None`."""
        return None

    @property
    def tied_pairs(self) -> tuple[TiedPair, ...]:
        """Pairs of nodes kept at exactly one position, each pair in both orders.

        Couplings with such pairs are merged into one, which is applied last.
        """
        return ()

    def merged(self, others: Sequence[Any]) -> Coupling:
        """One coupling that replaces this one and others; all have `tied_pairs`."""
        # Not abstract: it is never called for couplings without tied pairs.
        raise NotImplementedError(f"{type(self).__name__} cannot be merged")

    @property
    def is_contact(self) -> bool:
        """Whether its forces are contact forces, which a replay can show."""
        return False

    @property
    def lists(self) -> Any:
        """Settings of its neighbour lists, `NeighbourLists`; `None` without lists."""
        return None

    def reaction(self, seen: AllSeen) -> Reaction | None:
        """Force, couple and power of an external drive; `None` without a drive."""
        return None

    def with_free_ends(self, free: Mapping[str, Array]) -> Coupling:
        """Copy that knows which ends of rods are free, and which continue.

        Args:
            free: For each member, flags of the first and the last end of each of its
                rods `(rods, 2)`: 1 if the end is free, 0 if it is tied to a node or
                attached to a body.
        """
        return self

    def carried(self, parts: AllParts) -> dict[str, Carried]:
        """Mass and moments of nodes attached to bodies, by name of the bodies."""
        return {}

    def prepared(self, parts: AllParts) -> Coupling:
        """Copy with constants computed once, before the first step."""
        return self

    @property
    def refresh_every(self) -> int | None:
        """Steps between calls of `search`; `None` for couplings without a search."""
        return None

    @property
    def is_sized(self) -> bool:
        """Whether the sizes of the arrays that `search` returns are known."""
        return True

    def sized(self, seen: AllSeen) -> Coupling:
        """Copy with sizes for the arrays that `search` returns in a state.

        `make_system` calls it.
        """
        return self

    def search(self, seen: AllSeen) -> Any:
        """Searches for neighbours, every `refresh_every` steps.

        The result is a pytree of arrays with fields `missed` and `used`. It stays in
        the coupling's field `found` until the next search: see
        `jaxrod.systems.contact.neighbour_lists`.
        """
        # Not abstract: it is never called for couplings without `refresh_every`.
        raise NotImplementedError(f"{type(self).__name__} has no search")

    def moved(self, seen: AllSeen) -> Array:
        """Largest displacement of a node since the search, divided by the limit [1].

        Above one, the results of the search may be out of date.
        """
        # Not abstract, for the same reason.
        raise NotImplementedError(f"{type(self).__name__} has no moved")

    def loads(self, seen: AllSeen) -> dict[str, Loads]:
        """Forces on nodes, world frame [N], and couples on elements [N m].

        Couples are in the material frames of the elements. Loads are computed at the
        same moment as the loads of effects.
        """
        return {}

    def energy(self, seen: AllSeen) -> Array | float:
        """Potential energy of the coupling [J]."""
        return 0.0

    def constrain(self, seen: AllSeen) -> dict[str, Motion]:
        """Motions in which nodes that are tied or attached have exact positions."""
        return {}

    def exchange(self, before: AllSeen, after: AllSeen) -> dict[str, Loads]:
        """Impulses that act between members as a result of a kick.

        Args:
            before: Members before the kick.
            after: Members after the kick; each was kicked by its own loads.

        Returns:
            Forces times time on nodes, world frame [N s], and couples times time on
            elements, world frame [N m s].
        """
        return {}

    def constrain_rates(self, seen: AllSeen) -> dict[str, Motion]:
        """Motions in which the velocities of tied or attached nodes are made exact.

        It is called after kicks and the exchange of impulses.
        """
        return {}

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Bounds on the stiffness and drag of `loads`, by name of the member.

        For a spring of stiffness `k` on an elongation that changes by the sum of
        `g_i . u_i`, with displacements `u_i` of nodes, the bound
        `k (sum_j |g_j|^2 / m_j) m_i` on each node `i` is enough.
        """
        return {}

    def violation(self, seen: AllSeen) -> Array | None:
        """Violation of the coupling in a state [1]; `None` if it cannot be violated.

        `health` flags it above a limit, which is one by default.
        """
        return None


def check_named(name: str, members: Iterable[str], where: str = "") -> None:
    """Raises a `ValueError` if no member has the given name.

    Args:
        name: The name.
        members: Names of all members.
        where: Name of the argument or caller, for the message.
    """
    known = list(members)
    if name not in known:
        raise ValueError(
            f"{where and where + ': '}no member is called {name!r}; there are "
            + ", ".join(map(repr, known))
        )
