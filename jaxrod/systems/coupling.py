"""The interface of a coupling: what it sees of members, and its hooks.

All nodes of a member are in one flat array, called a row, and so are its elements.
Equal rods follow one another: first all entries of the first rod, then those of the
second, and so on. A rigid body is one node and one element.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.contacts.bodies import Body
from jaxrod.effects.base import Reaction, StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import MassMatrix
from jaxrod.structure import pytree, static


@pytree
class Parts:
    """Constants of a member, one entry per node or element.

    Example:
        >>> parts = scene.as_member().parts()
        >>> parts.node_masses.shape, parts.is_rod, parts.n_nodes
        ((11,), True, 11)
    """

    node_masses: Float[Array, " nodes"]
    """Mass of each node, or of each body [kg]."""
    inertias: Float[Array, "rows elements"]
    """Moments of inertia [kg m^2]: transverse and polar for round rods (2 rows), else
    about all three axes (3 rows)."""
    rest_lengths: Float[Array, " elements"] | None = None
    """Rest lengths of the elements of rods [m]; `None` for other members."""
    radii: Float[Array, " elements"] | None = None
    """Radii of the elements of rods [m]; `None` for other members."""
    bend_twist_stiffness: Float[Array, "3 elements"] | None = None
    """Bending stiffness about d1 and d2 and twisting stiffness about d3 of the elements
    of rods [N m^2]; `None` for other members."""
    linear_density: Float[Array, " elements"] | None = None
    """Mass per rest length of the elements of rods [kg/m]; `None` for other members."""
    shape: Body | None = None
    """Surface of rigid bodies in their own frame; `None` for other members."""
    held: Vec3 | None = None
    """Flags per node and world axis: 1 where a support holds the node, else 0; `None`
    if no node is held, or if they are not known."""
    count: int = static(default=1)
    """Number of rods, bodies or points."""
    mass_matrix: MassMatrix = static(default="lumped")
    """Whether masses of rods are at the nodes alone, or coupled along elements."""
    n_elements: int = static(default=1)
    """Number of elements of each rod; 1 for bodies and points, whose nodes are also
    elements."""
    is_rod: bool = static(default=True)
    """Whether the member consists of rods, with one more node than elements."""
    is_rigid: bool = static(default=False)
    """Whether the member consists of rigid bodies, to which nodes of rods can be
    attached."""

    # `Motion.angular_velocities` uses these attributes of a rod.
    @property
    def is_round(self) -> bool:
        """Whether each element has the same moment of inertia about d1 and d2."""
        return self.inertias.shape[0] == 2

    @property
    def principal_inertias(self) -> Array:
        """Moments of inertia about d1, d2 and d3, for non-round elements [kg m^2]."""
        return self.inertias

    @property
    def n_nodes(self) -> int:
        """Number of nodes of all rods, bodies or points together."""
        return self.count * (self.n_elements + 1 if self.is_rod else 1)


@pytree
class Seen:
    """A member at one moment: its constants and its motion.

    Example:
        >>> seen = extend.Seen(scene.as_member().parts(), motion)
        >>> [float(abs(part).max()) for part in seen.angular_velocities]
        [0.0, 0.0, 0.0]
    """

    parts: Parts
    """Constants of the member."""
    motion: Motion
    """Positions and rates, with the nodes of all rods in one array, and the elements in
    another. For bodies they are those of the origins of their frames."""
    inverse_inertia: Matrix | None = None
    """Inverse inertia of bodies that carry attached masses, in their own frames [1/(kg
    m^2)]; `None` for other members."""

    @property
    def angular_velocities(self) -> Vec3:
        """Angular velocities of the elements, world frame [rad/s]."""
        if self.parts.is_rod:
            # `Motion` uses only the inertias of the rod.
            rod: Any = self.parts
            return self.motion.angular_velocities(rod)
        frame = directors(self.motion.orientation)
        own = to_material(frame, self.motion.spin)
        if self.inverse_inertia is None:
            a, b, c = self.parts.inertias
            return to_world(frame, (own[0] / a, own[1] / b, own[2] / c))
        x, y, z = (vectors.dot(row, own) for row in self.inverse_inertia)
        return to_world(frame, (x, y, z))


@pytree
class Carried:
    """Mass and moments of mass of the nodes attached to each body."""

    mass: Array
    """Sum of the masses [kg]."""
    moment: Vec3
    """Sum of m p, with the mass m of a node and its position p in the body's frame [kg
    m]."""
    second: Matrix
    """Sum of the matrices m p p^T, with the mass m of a node and its position p in the
    body's frame [kg m^2]."""


AllSeen = Mapping[str, Seen]
"""Constants and motion of the members of a system at one moment, by name."""
AllParts = Mapping[str, Parts]
"""Constants of the members of a system, by name."""
TiedPair = tuple[str, int, str, int]
"""Two tied nodes: member and node of the first, member and node of the second."""


class Coupling:
    """Base class of all couplings: by default every hook does nothing.

    A subclass is a pytree. Hooks are pure. Members are identified by name; a member
    that a hook does not return is unchanged. All nodes of a member are in one flat
    array, and so are its elements.

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

    misplaced: ClassVar[str] = (
        ": a coupling acts in a system, so give it to jaxrod.make_system"
    )
    """Advice in the error of a scene that got a coupling as an effect."""

    def check(self, parts: AllParts) -> None:
        """Raises a `ValueError` if the coupling does not fit the members."""

    def fitted(self, parts: AllParts, tied: tuple[TiedPair, ...]) -> Coupling:
        """Copy with the static structure that depends on the members.

        `make_system` calls it.

        Args:
            parts: Constants of the members.
            tied: Pairs of nodes that are tied together, or held together by springs.
        """
        return self

    def regridded(self, grids: Any) -> Coupling:
        """Copy for rods with other numbers of elements; `jaxrod.resample` calls it.

        By default every field with a method `regridded`, such as `Anchors`, is moved. A
        coupling with other numbers per node or element must override this.

        Args:
            grids: The rods before and after, a `Regridding`.
        """
        moved = {
            field.name: _regridded(getattr(self, field.name), grids)
            # A coupling is a dataclass by its decorator.
            for field in fields(self)  # type: ignore[arg-type]
        }
        return replace(self, **moved)  # type: ignore[type-var]

    def softened(self, share: ArrayLike) -> Coupling:
        """Copy, if it is contact with a share of its stiffness, for `tune`.

        Dashpots and friction get the square root of the share, so that what collides
        bounces as before.
        """
        return self

    def thinned(self, share: float) -> Coupling:
        """Copy, if it is contact with a share of its points, for `tune`."""
        return self

    def joined_nodes(self) -> Iterable[tuple[str, int]]:
        """Nodes tied to other nodes or attached to bodies, as `(member, node)`."""
        return ()

    @property
    def is_exact(self) -> bool:
        """Whether it holds nodes exactly, by impulses in proportion to their masses."""
        own = type(self)
        return (
            own.constrain is not Coupling.constrain
            or own.constrain_rates is not Coupling.constrain_rates
            or own.exchange is not Coupling.exchange
        )

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

    def adjacent_pairs(self, parts: AllParts) -> tuple[TiedPair, ...]:
        """Pairs of nodes of rods that springs hold at one place, each in both orders.

        Contact between rods leaves out the elements near them, as near tied nodes.

        Args:
            parts: Constants of the members.
        """
        return self.tied_pairs

    def merged(self, others: Sequence[Any]) -> Coupling:
        """Merges this coupling and `others`, which all have `tied_pairs`, into one."""
        # Not abstract: it is never called for couplings without tied pairs.
        raise NotImplementedError(f"{type(self).__name__} cannot be merged")

    @property
    def twists(self) -> str | None:
        """Name, for messages, of loads that twist rods or turn with their elements.

        Members without twist refuse a coupling with such a name, whatever its numbers
        are. `None` by default: the loads are then tested numerically.
        """
        return None

    @property
    def is_symmetric(self) -> bool:
        """Whether loads lie in any plane in which all its members are and move.

        Systems with planar members test the loads of other couplings numerically.
        """
        return False

    @property
    def is_contact(self) -> bool:
        """Whether its forces are contact forces, which a replay can show."""
        return False

    @property
    def acts_from_outside(self) -> bool:
        """Whether its forces are not in pairs: it holds or drives the system."""
        return False

    @property
    def kept_apart(self) -> tuple[tuple[str, str, bool], ...]:
        """Pairs of members whose rods it keeps from passing through each other.

        The third entry, for a member with itself, says whether each rod is also kept
        from passing through itself. `prepared` has been called.
        """
        return ()

    @property
    def lists(self) -> Any:
        """Settings of its neighbour lists, `NeighbourLists`; `None` without lists."""
        return None

    def reaction(self, seen: AllSeen) -> Reaction | None:
        """Force, couple and power that an external drive supplies to the system.

        Returns `None` for a coupling without a drive.
        """
        return None

    def with_free_ends(self, free: Mapping[str, Array]) -> Coupling:
        """Copy that stores which ends of rods are free.

        Args:
            free: For each member, flags of the first and the last end of each of its
                rods `(rods, 2)`: 1 if the end is free, 0 if it is tied to a node or
                attached to a body.
        """
        return self

    def carried(self, parts: AllParts) -> dict[str, Carried]:
        """Mass and moments of nodes attached to bodies, by name of the bodies."""
        return {}

    @property
    def lacks_numbers(self) -> bool:
        """Whether `make_system` must choose some of its numbers."""
        return False

    def with_numbers(self, parts: AllParts, step: Array) -> Coupling:
        """Copy with the numbers that it lacks.

        Args:
            parts: Constants of the members.
            step: Largest stable step of the system without such couplings [s].
        """
        return self

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
        `jaxrod.systems.contact.neighbour_search`.
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

    def constraint_loads(
        self, seen: AllSeen, rates: Mapping[str, Motion]
    ) -> dict[str, Loads]:
        """Loads that keep tied or attached nodes together at this moment.

        Args:
            seen: The members.
            rates: For each rod the accelerations of its nodes if nothing were tied or
                attached, as velocities. For bodies that carry nodes, their actual
                accelerations, and angular accelerations as spins.
        """
        return {}

    def stability_bounds(self, parts: AllParts) -> dict[str, StabilityBound]:
        """Bounds on the stiffness and drag of `loads`, by name of the member.

        For a spring of stiffness `k` on an elongation that changes by the sum of
        `g_i . u_i`, with displacements `u_i` of nodes, the bound
        `k (sum_j |g_j|^2 / m_j) m_i` on each node `i` of mass `m_i` is sufficient.
        """
        return {}

    def violation(self, seen: AllSeen) -> Array | None:
        """Violation of the coupling in a state [1]; `None` if it cannot be violated.

        `health` flags it above a limit, which is one by default.
        """
        return None

    def passages(self, before: AllSeen, after: AllSeen) -> Array | None:
        """Number of points of rods that went through a body between two states.

        `None` for a coupling without bodies. `health` calls it with an earlier state.
        """
        return None

    def gap(self, seen: AllSeen) -> Array | None:
        """Largest distance of points that springs of a joint hold together [1].

        It is divided by the radius of the rods. `None` for a coupling that is no such
        joint. `health` flags it above `HealthLimits.largest_gap`.
        """
        return None

    def joint_angle(self, seen: AllSeen) -> Array | None:
        """Largest rotation of an elastic joint from its rest orientation [rad].

        It is the length of a rotation vector, at most about pi. `None` for a coupling
        without such joints. `health` flags it above `HealthLimits.largest_joint_angle`.
        """
        return None


def _regridded(value: Any, grids: Any) -> Any:
    """The value of a field of a coupling for other grids, if it knows its points."""
    if isinstance(value, tuple):
        return tuple(_regridded(one, grids) for one in value)
    move = getattr(value, "regridded", None)
    return value if move is None else move(grids)


def refresh_every(couplings: Sequence[Coupling]) -> int | None:
    """Steps between searches: the smallest of all couplings; `None` if none has any."""
    asked = [c.refresh_every for c in couplings if c.refresh_every is not None]
    return min(asked) if asked else None


def searched(couplings: Sequence[Coupling], seen: Any) -> tuple[Any, ...]:
    """Results of the search of every coupling that searches for neighbours."""
    return tuple(c.search(seen) for c in couplings if c.refresh_every is not None)


def with_found(
    couplings: Sequence[Coupling], found: Sequence[Any]
) -> tuple[Coupling, ...]:
    """Couplings with the results `found` of their searches in the field `found`."""
    left = iter(found)
    # A coupling that searches is a dataclass, by its decorator, with a field `found`.
    return tuple(
        c if c.refresh_every is None else replace(c, found=next(left))  # type: ignore[type-var]
        for c in couplings
    )


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


def turning_mobility(
    inertias: Float[Array, "3 *k"], arm: Vec3, around: Array | float = 0.0
) -> Array:
    r"""Largest velocity of a point per unit impulse there, by rotation alone [1/kg].

    An impulse $f$ at the lever arm $r$ gives the point the velocity $(r\times f)\cdot
    I^{-1}(r\times f)$ along $f$. For unit vectors $f$ this is at most $\lambda |r|^2$,
    with $\lambda$ the larger eigenvalue of $I^{-1}$ in the plane perpendicular to $r$.
    Within a distance $d$ of the end of $r$ it is at most $(\sqrt\lambda\,|r| +
    d/\sqrt{I_{min}})^2$.

    Args:
        inertias: Moments of inertia about the axes of the body [kg m^2].
        arm: Lever arms from the centre of mass, in the frame of the body [m].
        around: Distance d from the ends of the arms [m].
    """
    least = jnp.min(inertias, axis=0)
    length = vectors.safe_norm(arm)
    x, y, z = (c * c for c in vectors.scale(1 / length, arm))
    a, b, c = least[None] / inertias
    slow = jnp.minimum(jnp.minimum(a, b), c)
    # The eigenvalues above the least one: exact for equal moments.
    a, b, c = a - slow, b - slow, c - slow
    total = a * (y + z) + b * (z + x) + c * (x + y)
    product = b * c * x + c * a * y + a * b * z
    square = total * total - 4 * product
    apart = square > 0
    root = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)
    ease = length * jnp.sqrt((slow + 0.5 * (total + root)) / least)
    ease = ease + around / jnp.sqrt(least)
    return ease * ease
