r"""Stress added to a rod's elastic stress: the base of actuation inside a rod.

The strains of a rod are the edges of its elements in their material frames,
$\epsilon_k = R_k^T \Delta x_k$ [m], and the rotations $\phi_k$ [rad] of its joints.
An actuator responds to them with forces $n_k$ in elements and moments $m_k$ in joints,
which act on nodes and elements as the elastic ones do,

$$f = \Delta^h(R\,n), \qquad
  c = \Delta^h(a) + \mathcal A^h(b) + \epsilon\times n,$$

where $\Delta^h$ and $\mathcal A^h$ are the difference and the average of neighbours,
$c$ is in material frames, and $a$, $b$ are the parts of a moment that act on both
elements of a joint with opposite and with equal signs
(`rods.elasticity.joint_couples`). So any stress conserves momentum and angular momentum
exactly. If there is a stored energy, $n = \partial E/\partial\epsilon$ and
$m = \partial E/\partial\phi$, and the loads are its exact negative gradient.

Joints are at the nodes. An array over nodes, of length `n + 1`, has the joints of the
inner nodes and, at an end with a wall, the joint between the wall and the end element.
At free ends the rotation is zero, and a moment is left out.

The stability bound needs bounds of the stiffness of such actuators. In small motions
about the straight rod, $s$ is the stretch of an element,
$\gamma = e_\perp - \ell\theta$ its shear (the relative displacement $e_\perp$ of its
nodes perpendicular to the rod, minus its length $\ell$ times its rotation $\theta$),
and $\phi$ the rotation of a joint. An actuator adds at most
$\sum k_s s^2 + k_\gamma \gamma^2 + k_\phi \phi^2$ to twice the energy, with bounds $k$
that it states. Each part is split between nodes and elements by Young's inequality,
$(x + y)^2 \le (1 + w)\,x^2 + (1 + 1/w)\,y^2$, with the weight that makes the squared
frequencies equal. The part with $k_\gamma$ is then exactly that of the shear stiffness
in `jaxrod.analysis.stability`.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.effects.base import Effect, StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.ends import Wall, at_end, only_at_end
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    multiply_quaternions,
    rotation_log_and_coupling,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.elasticity import joint_couples, joint_rotations
from jaxrod.rods.motion import Loads, Motion, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree
from jaxrod.validation import check_kind

Walls = tuple[Wall, ...]
"""Walls at ends of a rod into which an actuator continues."""


@pytree
class SectionStrains:
    """Strains of elements and joints of a rod, in material frames.

    Example:
        >>> zero, long = jnp.zeros(10), jnp.full(10, 0.11)
        >>> turns = (jnp.zeros(11), jnp.zeros(11), jnp.zeros(11))
        >>> strains = actuation.SectionStrains((zero, zero, long), turns)
        >>> chamber = actuation.chamber(rod, pressure=2e4, area=1e-4)
        >>> round(float(chamber.stored(rod, strains)), 3)  # -pressure * new volume [J]
        -0.2
    """

    edges: Vec3
    """Vector from each node to the next, in the frame of the element, `n` entries
    [m]."""
    rotations: Vec3
    """Rotation vector of the joint at each node, material frame, `n + 1` entries [rad];
    zero at free ends."""


@pytree
class SectionStress:
    """Force and moment of an actuator in a rod; either is `None` if it is zero.

    Example:
        >>> zero, turns = jnp.zeros(10), (jnp.zeros(11), jnp.zeros(11), jnp.zeros(11))
        >>> strains = actuation.SectionStrains((zero, zero, rod.rest_lengths), turns)
        >>> warm = actuation.active_shape(rod, strain=(0.0, 0.0, 0.01))
        >>> stress = warm.stress(rod, strains)
        >>> round(float(stress.force[2][0]), 2), stress.moment is None  # -E A / 100 [N]
        (-12.57, True)
    """

    force: Vec3 | None = None
    """Force in each element, material frame, positive along d3 in tension, `n` entries
    [N]."""
    moment: Vec3 | None = None
    """Moment of the joint at each node, material frame, `n + 1` entries [N m]; unused
    at free ends."""


class SectionLoad(Effect):
    """Base class of actuators that add stress to the sections of a rod.

    A subclass defines `stored`, an energy of the strains. Without an energy, or for a
    closed form, it defines `stress`. A subclass may promise `reach = "neighbours"` if
    its moments do not depend on the strains and its forces depend on the element's own
    strain only.

    Example:
        >>> @extend.pytree
        ... class Strap(actuation.SectionLoad):
        ...     stiffness: jax.Array  # [N]
        ...
        ...     def stored(self, rod, strains):
        ...         stretch = strains.edges[2] / rod.rest_lengths - 1
        ...         return jnp.sum(0.5 * self.stiffness * stretch**2 * rod.rest_lengths)
        >>> longer = replace(state, positions=1.1 * state.positions)
        >>> round(float(Strap(100.0).energy(rod, longer)), 3)
        0.5
    """

    walls: Walls = ()
    """Walls of clamped ends into which the actuator extends beyond the rod. Subclasses
    that may extend into walls make it a field."""

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Stored energy of the actuator at the given strains [J]."""
        # Not abstract: a subclass may have `stress` alone.
        raise NotImplementedError(
            f"{type(self).__name__} must have stored(rod, strains) or "
            "stress(rod, strains)"
        )

    def stress(self, rod: Rod, strains: SectionStrains) -> SectionStress:
        """Force and moment; by default the derivatives of the stored energy."""
        slope = jax.grad(lambda there: self.stored(rod, there))(strains)
        return SectionStress(slope.edges, slope.rotations)

    def at_speed(self, rod: Rod, motion: Motion) -> SectionLoad:
        """The actuator with its speed-dependent parts set; by default unchanged."""
        return self

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces on nodes and couples on elements, due to the stress."""
        strains, couplings = self._strains(motion)
        stress = self.at_speed(rod, motion).stress(rod, strains)
        forces, couples = None, None
        if stress.force is not None:
            known = motion.sections
            frame = known.frame if known else directors(motion.orientation)
            forces = vectors.difference(to_world(frame, stress.force))
            couples = vectors.cross(strains.edges, stress.force)
        if stress.moment is not None:
            held = [wall.end for wall in self.walls]
            moment = _without_free_ends(stress.moment, held)
            odd, even = joint_couples(strains.rotations, couplings, moment)
            turning = vectors.add(vectors.inner_difference(odd), _inner_sum(even))
            couples = turning if couples is None else vectors.add(couples, turning)
        return Loads(forces, couples)

    def energy(self, rod: Rod, state: RodState) -> Array | float:
        """Stored energy in a state [J]; zero if the subclass defines none."""
        if type(self).stored is SectionLoad.stored:
            return 0.0
        return self.stored(rod, self._strains(motion_of(state))[0])

    @property
    def twists(self) -> str | None:
        """Description of the stress, for errors of methods that cannot twist."""
        return "stress in the material frame"

    def _strains(self, motion: Motion) -> tuple[SectionStrains, Array]:
        """Strains, and the coupling coefficient of the joint at each node.

        Joints with `walls` are included. For the coefficient see
        `elasticity.joint_couples`.
        """
        known = motion.sections
        if known:
            # In a plane the terms with couplings turn elements out of it only.
            edges, rotation = known.edges, known.rotations
            coupling = jnp.zeros_like(rotation[0])
        else:
            edges = to_material(directors(motion.orientation), motion.edges)
            rotation, coupling = joint_rotations(motion.orientation)
        x, y, z = (vectors.pad(part, 1, 1) for part in rotation)
        rotations, couplings = (x, y, z), vectors.pad(coupling, 1, 1)
        for wall in self.walls:
            turn, coupling = _wall_joint(wall, motion.orientation)
            size = couplings.shape[0]
            rotations = vectors.add(rotations, only_at_end(turn, size, wall.end))
            none = jnp.zeros_like(coupling)
            couplings += only_at_end((coupling, none, none), size, wall.end)[0]
        return SectionStrains(edges, rotations), couplings


def _wall_joint(wall: Wall, orientation: Quaternion) -> tuple[Vec3, Array]:
    """Rotation vector [rad] and coupling coefficient of the joint at a wall."""
    frame = split_quaternion(wall.orientation)
    element = at_end(orientation, wall.end)
    before, after = (frame, element) if wall.end == "base" else (element, frame)
    return rotation_log_and_coupling(multiply_quaternions(conjugate(before), after))


def _without_free_ends(moment: Vec3, held: Sequence[str]) -> Vec3:
    first, last = (0 if end in held else 1 for end in ("base", "tip"))
    if not first and not last:
        return moment

    def one(part: Array) -> Array:
        return vectors.pad(part[first : part.shape[0] - last], first, last)

    return one(moment[0]), one(moment[1]), one(moment[2])


def _inner_sum(a: Vec3) -> Vec3:
    """Sums a[k] + a[k+1] of neighbouring entries: one fewer than entries of `a`."""
    return a[0][1:] + a[0][:-1], a[1][1:] + a[1][:-1], a[2][1:] + a[2][:-1]


def walls_of(into: Clamp | tuple[Clamp, ...] | None) -> Walls:
    """Walls of the clamps into which an actuator continues.

    Raises:
        TypeError: If they are not clamps.
        ValueError: If two clamps are at the same end.
    """
    clamps = () if into is None else into if isinstance(into, tuple) else (into,)
    for clamp in clamps:
        check_kind("into", clamp, Clamp)
    walls = tuple(Wall(clamp.orientation, None, clamp.end) for clamp in clamps)
    if len({wall.end for wall in walls}) < len(walls):
        raise ValueError("into must be clamps at different ends")
    return walls


def stiffness_at_nodes(rod: Rod) -> Array:
    """Bend-twist stiffness of the joint at each node `(3, n + 1)` [N m^2]."""
    ends = rod.bend_twist_stiffness
    return jnp.concatenate([ends[:, :1], rod.joint_stiffness, ends[:, -1:]], axis=1)


def joint_lengths_at_nodes(rod: Rod, walls: Walls) -> Array:
    """Rest length of the joint at each node; zero at ends without a wall [m]."""
    held = {wall.end for wall in walls}
    lengths = lengths_at_nodes(rod)
    first, last = (0.0 if end not in held else 1.0 for end in ("base", "tip"))
    return lengths.at[0].multiply(first).at[-1].multiply(last)


def rest_curvatures_at_nodes(rod: Rod) -> Array:
    """Curvature and twist at rest of the joint at each node `(3, n + 1)` [1/m].

    They are zero at both ends: a wall is in line with the rod at rest.
    """
    return jnp.pad(rod.rest_curvatures, ((0, 0), (1, 1)))


def lengths_at_nodes(rod: Rod) -> Array:
    """Rest length around each node: half of each neighbouring element [m]."""
    return at_nodes(rod.rest_lengths)


def at_nodes(of_elements: Array) -> Array:
    """Shares a quantity of elements among nodes: half to each node of an element."""
    half = 0.5 * of_elements
    return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)


_LEAST_WEIGHT = 1e-6
"""Smallest weight that `_share` gives to one term of a sum, as a fraction of the sum
[1]."""


def section_bound(
    rod: Rod,
    stretch: Array | None = None,
    shear: Array | None = None,
    turning: Array | None = None,
) -> StabilityBound:
    r"""Stability bound of stiffness against stretch, shear, bending and twist.

    Args:
        rod: The rod.
        stretch: $k_s$ of each element `(n,)` [N/m]; it may also resist displacement
            perpendicular to the rod.
        shear: $k_\gamma$ of each element `(n,)` [N/m].
        turning: $k_\phi$ of the joint at each node `(n + 1,)` [N m].
    """
    nodes = jnp.zeros_like(rod.node_masses)
    elements = jnp.zeros_like(rod.rest_lengths)
    if stretch is not None:
        nodes = nodes + 4 * at_nodes(stretch)
    if shear is not None:
        weight = _moves(rod) / _rocking(rod)
        nodes = nodes + 4 * at_nodes(shear * (1 + 1 / weight))
        elements = elements + shear * (1 + weight) * rod.rest_lengths**2
    if turning is not None:
        elements = elements + 2 * (turning[1:] + turning[:-1])
    return StabilityBound(nodes=nodes, elements=elements)


def transport_bound(
    rod: Rod, force: Array | None = None, moment: Array | None = None
) -> StabilityBound:
    """Stability bound of a stress that is constant in the material frame.

    Args:
        rod: The rod.
        force: Bound on the size of the force, per element [N].
        moment: Bound on the size of the moment, per node [N m].
    """
    bounds = []
    if force is not None:
        pushed = jnp.abs(force) / rod.rest_lengths
        bounds.append(section_bound(rod, shear=pushed))
    if moment is not None:
        size = jnp.abs(moment)
        bounds.append(StabilityBound(elements=size[1:] + size[:-1]))
    return together(*bounds)


def fibre_bound(
    rod: Rod,
    stiffness: Array,
    along: Array,
    across: Array,
    lever: Array,
) -> StabilityBound:
    """Stability bound of springs along fibres, which stretch, shear and bend the rod.

    Args:
        rod: The rod.
        stiffness: Stiffness of each fibre around each node `(k, n + 1)` [N/m].
        along: Component of the fibre's direction along the rod, same shape [1].
        across: Component of the fibre's direction perpendicular to the rod, same shape
            [1].
        lever: Elongation of the fibre per rotation of the joint, same shape [m].
    """
    # Any weights give a bound; these do not change if the rod's ends are swapped.
    moves, rocking, inertia = (
        _at_each_node(values)[None, :]
        for values in (_moves(rod), _rocking(rod), jnp.min(rod.inertias, axis=0))
    )
    parts = along**2 * moves, across**2 * (moves + rocking), 4 * lever**2 / inertia
    whole = parts[0] + parts[1] + parts[2]
    directions = along**2, across**2, lever**2
    stretch, shear, turning = (
        jnp.sum(stiffness * size * _share(whole, part), axis=0)
        for size, part in zip(directions, parts, strict=True)
    )
    return section_bound(rod, _of_elements(stretch), _of_elements(shear), turning)


def cross_bound(rod: Rod, coupling: Array) -> StabilityBound:
    """Stability bound of a coupling of shear `gamma` and twist `phi` at nodes.

    It adds `2 coupling gamma phi` to twice the energy; `coupling` is a force [N].
    """
    inertia = jnp.min(rod.inertias, axis=0)
    rate = jnp.sqrt(4 / inertia / (_moves(rod) + _rocking(rod)))
    # The twist at a node is bounded with the shear of both neighbouring elements.
    turned = coupling / jnp.minimum(*_beside_nodes(rate))
    return section_bound(rod, shear=_of_elements(coupling) * rate, turning=turned)


def together(*bounds: StabilityBound) -> StabilityBound:
    """Sum of the stiffnesses of several stability bounds; their drag is ignored."""

    def total(name: str) -> Array | None:
        parts = [getattr(bound, name) for bound in bounds]
        found = [part for part in parts if part is not None]
        return sum(found[1:], found[0]) if found else None

    return StabilityBound(nodes=total("nodes"), elements=total("elements"))


def _at_each_node(values: Array) -> Array:
    """Mean of the values of the two elements at each node."""
    before, after = _beside_nodes(values)
    return 0.5 * (before + after)


def _beside_nodes(values: Array) -> tuple[Array, Array]:
    """Values of the elements before and after each node, repeated at the ends."""
    padded = jnp.pad(values, (1, 1), mode="edge")
    return padded[:-1], padded[1:]


def _moves(rod: Rod) -> Array:
    """Squared frequency, per stiffness, of the two nodes of each element [1/kg].

    It is `2 (1 / m + 1 / m')` for node masses `m` and `m'`: half of each node's mass
    belongs to the element, which acts as a spring between them.
    """
    inverse = 1 / rod.node_masses
    return 2 * (inverse[1:] + inverse[:-1])


def _rocking(rod: Rod) -> Array:
    """Squared frequency of each element rotating between fixed nodes, per stiffness.

    It is the squared length over the rotary inertia [1/kg].
    """
    return rod.rest_lengths**2 / jnp.min(rod.inertias, axis=0)


def _of_elements(at_nodes: Array) -> Array:
    """Mean of values at the two nodes of each element."""
    return 0.5 * (at_nodes[1:] + at_nodes[:-1])


def _share(whole: Array, part: Array) -> Array:
    """Factor `whole / part` of the square of one term in a bound of a squared sum.

    With the terms' sizes `p` and `q`, `(a + b)^2 <= (p + q) (a^2 / p + b^2 / q)`.
    """
    # Proportional to the part plus a small constant, so that the round-off of a part
    # that is zero adds nothing.
    weight = part + _LEAST_WEIGHT * whole
    there = weight > 0
    most = (1 + 3 * _LEAST_WEIGHT) * whole
    return jnp.where(there, most / jnp.where(there, weight, 1), 0)
