r"""Tendons: cables through eyelets on a rod, pulled with a force or to a length.

An eyelet is fixed to the middle of an element, at $x = \bar x + R p$. A cable through
eyelets has the length $\Lambda = \sum_j |x_{j+1} - x_j|$. Its energy is $T\Lambda$ if
it is pulled with a force $T$, and $\tfrac k2 \langle\Lambda - \Lambda_c\rangle^2$ if it
is elastic and wound up to a length $\Lambda_c$. Here $\langle\ \rangle$ is a smooth
positive part, zero while the cable is slack. Each straight piece pulls its two eyelets
towards each other.

With friction, tension falls at an eyelet where the cable turns by $\theta_j$ and slips
(Euler-Eytelwein),

$$T_j = T_{j-1} \exp(-\mu\,\theta_j\,\phi_j), \qquad
  \phi_j = \frac{s + \tanh(v_j/v_s)}{1 + s \tanh(v_j/v_s)},$$

with the speed $v_j$ at which the cable slips towards its base, where it is pulled. The
share $s$ of friction remains at rest: one after the cable was pulled in, minus one
after it was let out. Loads at zero speed are those of `equilibrium`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.actuation.section_load import at_nodes
from jaxrod.effects.base import Effect, Reach, StabilityBound
from jaxrod.effects.time import Scheduled, Timed, as_timed
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_count, check_kind, numeric

_TURN = 0.25
"""Turning angle of a cable at an eyelet up to which the stability bound holds [rad]."""


@pytree
class Tendon(Effect):
    """One or several cables through eyelets on the same elements; see `tendon`.

    Example:
        >>> tendon = actuation.tendon(rod, (0.01, 0.0), tension=5.0)
        >>> tendon.cable_tensions(motion).tolist()
        [5.0]
        >>> round(float(tendon.cable_lengths(motion)[0]), 3)  # first eyelet to last [m]
        0.9
    """

    eyelets: Float[Array, "k 2 m"]
    """Offsets of the `m` eyelets of each cable from the centreline, along d1 and d2
    [m]."""
    tension: Scheduled
    """Tension at the base [N], one number or one per cable `(k,)`; `None` if a length
    is given."""
    length: Scheduled
    """Length to which cables are wound up [m], one number or one per cable `(k,)`;
    `None` if a tension is given."""
    stiffness: Float[Array, ""] | None
    """Stiffness of a cable that is wound up to a length [N/m]; otherwise `None`."""
    onset: Float[Array, ""] | None
    """Elongation over which a cable wound up to a length becomes taut [m]; otherwise
    `None`."""
    anchors: Float[Array, "3 k"] | None = None
    """Points in space from which the cables come, world frame [m]. If `None`, cables
    begin at their first eyelets."""
    friction: Float[Array, ""] | None = None
    """Coefficient of friction at the eyelets [1]; `None` without friction."""
    slip_speed: Float[Array, ""] | None = None
    """Speed of slip at which friction is 0.76 (tanh 1) of its full size [m/s]; `None`
    without friction."""
    friction_at_rest: Float[Array, "..."] | None = None
    """Share $s$ of friction that remains at rest, one number or one per cable `(k,)`
    [1]. It is positive after the cable was pulled in, negative after it was let out;
    `None` is zero."""
    first: int = static(default=0)
    """Index of the element with the first eyelet."""

    @property
    def actual_reach(self) -> Reach:
        """Range of the loads along the rod.

        It is "any" if a cable's tension depends on its length or on friction, otherwise
        "second neighbours".
        """
        decided_here = self.length is None and self.friction is None
        return "second neighbours" if decided_here else "any"

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces on nodes and couples on elements, from the pulls at the eyelets."""
        levers, points = self._points(motion)
        pieces, lengths = _pieces(points)
        along = vectors.scale(1 / lengths, pieces)
        tension = self._tension(jnp.sum(lengths, axis=1))[:, None]
        if self.friction is not None:
            tension = tension * self._held_back(rod, motion, levers, along)
        pulls = vectors.scale(jnp.broadcast_to(tension, lengths.shape), along)
        x, y, z = (_net(part) for part in pulls)
        if self.anchors is not None:
            x, y, z = x[:, 1:], y[:, 1:], z[:, 1:]
        couple = vectors.cross(levers, (x, y, z))
        force = _placed((x, y, z), self.first, rod.n_elements)
        turning = _placed(couple, self.first, rod.n_elements)
        a, b, c = force
        return Loads(
            forces=(at_nodes(a), at_nodes(b), at_nodes(c)),
            couples=to_material(directors(motion.orientation), turning),
        )

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Energy of the cables [J].

        It is elastic energy for a given length, and tension times length for a given
        tension.
        """
        lengths = self.cable_lengths(motion_of(state))
        if self.length is None:
            return jnp.sum(self._tension(lengths) * lengths)
        taut, _ = self._taut(lengths)
        assert self.stiffness is not None
        return 0.5 * self.stiffness * jnp.sum(taut**2)

    def cable_lengths(self, motion: Motion) -> Float[Array, "k"]:
        """Length of each cable, from anchor or first eyelet to last eyelet [m].

        Example:
            >>> tendon = actuation.tendon(rod, (0.01, 0.0), tension=5.0)
            >>> [round(float(length), 3) for length in tendon.cable_lengths(motion)]
            [0.9]
        """
        return jnp.sum(_pieces(self._points(motion)[1])[1], axis=1)

    def cable_tensions(self, motion: Motion) -> Float[Array, "k"]:
        """Tension of each cable at its base [N].

        Example:
            >>> tendon = actuation.tendon(rod, (0.01, 0.0), tension=5.0)
            >>> tendon.cable_tensions(motion).tolist()
            [5.0]
        """
        return self._tension(self.cable_lengths(motion))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness of turning and stretched cables, and on friction.

        It holds for turns of the cable of up to a quarter of a radian at an eyelet, and
        for the pull of a cable that is as long as the rod.
        """
        lever = jnp.max(jnp.sqrt(jnp.sum(self.eyelets**2, axis=1)))
        count, held = self.eyelets.shape[0], self.eyelets.shape[2]
        last = self.first + held - 1
        masses, inertia = rod.node_masses, jnp.min(rod.inertias, axis=0)
        node_share, element_share = (jnp.zeros_like(a) for a in (masses, inertia))
        node_share = node_share.at[self.first : last + 2].set(1.0)
        element_share = element_share.at[self.first : last + 1].set(1.0)
        pull = self._largest_pull(rod)
        shortest = jnp.min(rod.rest_lengths)
        # Each piece: its ends are means of two nodes and rotate with their elements.
        light = jnp.min(jnp.where(node_share > 0, masses, jnp.inf))
        slight = jnp.min(jnp.where(element_share > 0, inertia, jnp.inf))
        turning = pull / shortest
        nodes = 6 * turning * (masses / light) * 0.5
        elements = 8 * turning * lever**2 * (inertia / slight) + 2 * pull * lever
        # A cable as a whole: see `section_load`.
        free = (0.5 * _TURN) ** 2
        moved = free * jnp.sum(node_share / masses) + 0.5 / light
        turned = _TURN**2 * jnp.sum(element_share / inertia) + 2 / slight
        whole = count * (moved + lever**2 * turned)
        drag = None
        if self.stiffness is not None:
            nodes = nodes + 1.5 * self.stiffness * whole * masses
            elements = elements + 1.5 * self.stiffness * whole * inertia
        if self.friction is not None:
            assert self.slip_speed is not None
            drag = pull * self.friction * jnp.pi / self.slip_speed * whole
        return StabilityBound(
            nodes=node_share * nodes,
            elements=element_share * elements,
            node_drag=None if drag is None else drag * node_share * masses,
            element_drag=None if drag is None else drag * element_share * inertia,
        )

    @property
    def twists(self) -> str:
        """Description of the eyelets, for errors of methods that cannot twist."""
        return "eyelets off the centreline"

    def resampled(self, rod: Rod, new_rod: Rod) -> Tendon:
        """Raises ValueError: eyelets belong to certain elements of one rod."""
        raise ValueError(
            "a tendon cannot be resampled to another number of elements, because its "
            "eyelets belong to certain elements"
        )

    def _points(self, motion: Motion) -> tuple[Vec3, Vec3]:
        """Levers of the eyelets, and positions of anchors and eyelets, world frame [m].

        A lever is the vector from the middle of an element to its eyelet. Levers have
        the shape `(k, m)`; positions have `(k, m + 1)` if there are anchors.
        """
        held = slice(self.first, self.first + self.eyelets.shape[2])
        d1, d2, _ = directors(motion.orientation)
        p1, p2 = self.eyelets[:, 0], self.eyelets[:, 1]
        levers, points = [], []
        for axis in range(3):
            lever = p1 * d1[axis][None, held] + p2 * d2[axis][None, held]
            node = motion.position[axis]
            point = (0.5 * (node[1:] + node[:-1]))[None, held] + lever
            if self.anchors is not None:
                point = jnp.concatenate([self.anchors[axis][:, None], point], axis=1)
            levers.append(lever)
            points.append(point)
        return (levers[0], levers[1], levers[2]), (points[0], points[1], points[2])

    def _tension(self, lengths: Array) -> Array:
        """Tension at the base of each cable, given or from elongation `(k,)` [N]."""
        if self.length is None:
            return jnp.broadcast_to(self.tension, lengths.shape)
        taut, share = self._taut(lengths)
        assert self.stiffness is not None
        return self.stiffness * taut * share

    def _taut(self, lengths: Array) -> tuple[Array, Array]:
        """Elongation of each cable, zero if slack [m], and its derivative [1].

        The derivative is with respect to the length of the cable.
        """
        assert self.onset is not None
        width = self.onset
        past = jnp.maximum(lengths - self.length + 0.5 * width, 0)
        full = past >= width
        taut = jnp.where(full, past - 0.5 * width, past * past / (2 * width))
        return taut, jnp.where(full, 1, past / width)

    def _largest_pull(self, rod: Rod) -> Array:
        """Upper bound of the sum of the tensions of all cables [N]."""
        if self.length is None:
            return jnp.sum(jnp.abs(self._tension(self.eyelets[:, 0, 0])))
        assert self.stiffness is not None and self.onset is not None
        short = jnp.maximum(rod.length - self.length, 0)
        longest = jnp.broadcast_to(short, self.eyelets.shape[:1])
        return jnp.sum(self.stiffness * (longest + 0.5 * self.onset))

    def _held_back(self, rod: Rod, motion: Motion, levers: Vec3, along: Vec3) -> Array:
        """Tension of each piece of cable, divided by that at the base `(k, pieces)`.

        A piece is the straight cable between two neighbouring eyelets. Friction at each
        eyelet multiplies the tension by `exp(-friction * turn * share)`, see
        `_slip_share`. `levers` lead from elements to their eyelets [m], `along` are
        unit vectors of pieces.
        """
        assert self.friction is not None and self.slip_speed is not None
        held = slice(self.first, self.first + self.eyelets.shape[2])
        x, y, z = (part[None, held] for part in motion.angular_velocities(rod))
        turning = vectors.cross((x, y, z), levers)
        rates = jnp.zeros_like(along[0])
        for axis in range(3):
            node = motion.velocity[axis]
            speed = (0.5 * (node[1:] + node[:-1]))[None, held] + turning[axis]
            if self.anchors is not None:
                speed = jnp.pad(speed, ((0, 0), (1, 0)))
            rates = rates + along[axis] * (speed[:, 1:] - speed[:, :-1])
        # The last eyelet holds the cable, which therefore slips at an eyelet by the
        # shortening of the pieces after it.
        beyond = jnp.cumsum(rates[:, ::-1], axis=1)[:, ::-1][:, 1:]
        before = along[0][:, :-1], along[1][:, :-1], along[2][:, :-1]
        after = along[0][:, 1:], along[1][:, 1:], along[2][:, 1:]
        sine = vectors.safe_norm(vectors.cross(before, after))
        turn = jnp.arctan2(sine, vectors.dot(before, after))
        lost = self.friction * turn * self._slip_share(-beyond / self.slip_speed)
        return jnp.exp(-jnp.pad(jnp.cumsum(lost, axis=1), ((0, 0), (1, 0))))

    def _slip_share(self, slip: Array) -> Array:
        """Fraction of full friction at each eyelet, (s + tanh x) / (1 + s tanh x) [1].

        `slip` is x, the speed of slip divided by `slip_speed`; s is `friction_at_rest`.
        """
        moving = jnp.tanh(slip)
        if self.friction_at_rest is None:
            return moving
        still = self.friction_at_rest.reshape(-1, 1)
        # If both are one with opposite signs, the limit is the share at rest.
        tiny = jnp.finfo(moving.dtype).eps
        weight = jnp.maximum(1 + still * moving, tiny)
        return still + moving * (1 - still**2) / weight


def _pieces(points: Vec3) -> tuple[Vec3, Array]:
    """Vectors between neighbouring points of each cable, and their lengths [m]."""
    x, y, z = (part[:, 1:] - part[:, :-1] for part in points)
    return (x, y, z), vectors.safe_norm((x, y, z))


def _net(pull: Array) -> Array:
    """Net pull at each point of a cable: of the piece after it minus that before it."""
    return jnp.pad(pull, ((0, 0), (0, 1))) - jnp.pad(pull, ((0, 0), (1, 0)))


def _placed(of_eyelets: Vec3, first: int, n: int) -> Vec3:
    """Sums over all cables of vectors at eyelets, as a field over `n` elements.

    The eyelets are on elements `first`, `first + 1` and so on; other elements have
    zero.
    """

    def one(part: Array) -> Array:
        total = jnp.sum(part, axis=0)
        return vectors.pad(total, first, n - first - total.shape[0])

    return one(of_eyelets[0]), one(of_eyelets[1]), one(of_eyelets[2])


def tendon(
    rod: Rod,
    offsets: Numbers,
    *,
    tension: Timed | None = None,
    length: Timed | None = None,
    stiffness: Numbers | None = None,
    onset: Numbers | None = None,
    elements: tuple[int, int] | None = None,
    anchor: Numbers | None = None,
    friction: Numbers | None = None,
    slip_speed: Numbers = 1e-2,
    friction_at_rest: Numbers | None = None,
) -> Tendon:
    """Cables through eyelets on a rod, each fixed at its last eyelet.

    Args:
        rod: The rod.
        offsets: Offsets of the eyelets from the centreline along d1 and d2 `(2,)`; one
            per cable `(k, 2)`; or also per eyelet `(k, 2, m)` [m].
        tension: Tension with which cables are pulled at the base: one number, one per
            cable `(k,)`, or a schedule of either, at least 0 [N].
        length: Length to which cables are wound up instead, in the same form [m]; it
            needs `stiffness`.
        stiffness: Force per elongation of a whole cable, above 0 [N/m].
        onset: Elongation over which a cable changes from slack to taut, above 0 [m]; a
            thousandth of the rod by default.
        elements: The first and the last element with an eyelet; all by default.
        anchor: Point in space from which cables come `(3,)`, or one per cable `(k, 3)`
            [m]. Without one they begin at the first eyelet, to which their actuator is
            fixed.
        friction: Coefficient of friction at the eyelets, at least 0 [1].
        slip_speed: Speed at which friction is 0.76 of its full size, above 0 [m/s].
        friction_at_rest: Share of friction that remains while the cable rests, one
            number or one per cable `(k,)` from -1 to 1 [1]: 1 after it was pulled in,
            -1 after it was let out. `equilibrium` takes it into account. Zero by
            default, as if vibration had released the cable.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape, or not exactly
            one of tension and length is given.
        TypeError: If `rod` is not a `Rod`.

    Example:
        >>> pull = schedules.ramp(0.0, 5.0, duration=1.0)
        >>> tendon = actuation.tendon(rod, (0.01, 0.0), tension=pull)
        >>> arm = jaxrod.make_scene(rod, jaxrod.clamp(state), tendon)
        >>> arm.at(0.5).effects[1].cable_tensions(motion).tolist()
        [2.5]
    """
    check_kind("rod", rod, Rod)
    if (tension is None) == (length is None):
        raise ValueError("a tendon needs either a tension in N or a length in m")
    if (length is None) != (stiffness is None):
        raise ValueError(
            "a tendon with a length needs a stiffness in N/m, and one with a tension "
            "takes none"
        )
    kind, n = rod.rest_lengths.dtype, rod.n_elements
    first, last = (0, n - 1) if elements is None else elements
    first = check_count("first element", first, 0, n - 1)
    last = check_count("last element", last, first, n - 1)
    pieces = last - first + (anchor is not None)
    if pieces < 1:
        raise ValueError("a tendon needs two eyelets, or one eyelet and an anchor")
    given = numeric("offsets", offsets, "m")
    count = given.shape[0] if given.ndim > 1 else 1
    held = last - first + 1
    shapes = [(2,), (count, 2), (count, 2, held)]
    eyelets = as_array("offsets", given, "m", shapes, dtype=kind)
    if eyelets.ndim < 3:
        eyelets = jnp.broadcast_to(eyelets.reshape(-1, 2, 1), (count, 2, held))
    points = None
    if anchor is not None:
        points = as_array("anchor", anchor, "m", [(3,), (count, 3)], dtype=kind)
        points = jnp.broadcast_to(points, (count, 3)).T
    per_cable: list[tuple[int, ...]] = [(), (count,)]
    if friction is None and friction_at_rest is not None:
        raise ValueError("friction_at_rest needs a coefficient of friction")
    wide = 1e-3 * 1.0 * rod.length if onset is None else onset
    return Tendon(
        eyelets=eyelets,
        tension=None
        if tension is None
        else as_timed("tension", tension, "N", *per_cable, non_negative=True),
        length=None
        if length is None
        else as_timed("length", length, "m", *per_cable, non_negative=True),
        stiffness=None
        if stiffness is None
        else as_array("stiffness", stiffness, "N/m", positive=True, dtype=kind),
        onset=None
        if length is None
        else as_array("onset", wide, "m", positive=True, dtype=kind),
        anchors=points,
        friction=None
        if friction is None
        else as_array("friction", friction, "", non_negative=True, dtype=kind),
        slip_speed=None
        if friction is None
        else as_array("slip_speed", slip_speed, "m/s", positive=True, dtype=kind),
        friction_at_rest=None
        if friction_at_rest is None
        else as_array(
            "friction_at_rest",
            friction_at_rest,
            "",
            per_cable,
            at_least=-1.0,
            at_most=1.0,
            dtype=kind,
        ),
        first=first,
    )
