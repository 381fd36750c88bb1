r"""Stress that is added to a rod's own: the base of actuation inside a rod.

The strains of a rod are the edges of its elements in their material frames,
$\epsilon_k = R_k^T \Delta x_k$ [m], and the rotations $\phi_k$ [rad] of its joints.
An actuator answers them by forces $n_k$ on elements and moments $m_k$ of joints, which
act on nodes and elements as the elastic ones do,

$$f = \Delta^h(R\,n), \qquad
  c = \Delta^h(a) + \mathcal A^h(b) + \epsilon\times n,$$

with the parts $a$, $b$ of `rods.elasticity.joint_couples`. So momentum and angular
momentum are exact whatever the stress is, and where there is a stored energy,
$n = \partial E/\partial\epsilon$ and $m = \partial E/\partial\phi$, loads are minus its
exact gradient.

Joints are at the nodes: an array of nodes, `n + 1` long, has those of inner nodes, and
those of the ends between a wall and the end element where there is a wall. At free ends
the rotation is zero, and a moment is left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.effects.base import Effect
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
"""Walls at ends of a rod into which an actuator goes on."""


@pytree
class SectionStrains:
    """How a rod is strained, as its sections see it."""

    edges: Vec3
    """From each node to the next in the element's material frame, `n` [m]."""
    rotations: Vec3
    """Of the joint at each node, material frame, `n + 1` [rad]; zero at free ends."""


@pytree
class SectionStress:
    """Stress of an actuator. `None` where there is none."""

    force: Vec3 | None = None
    """Of elements, material frame, in tension positive along d3, `n` [N]."""
    moment: Vec3 | None = None
    """Of the joint at each node, material frame, `n + 1` [N m]; not at free ends."""


class SectionLoad(Effect):
    """Base of actuators inside a rod.

    A subclass has `stored`, an energy of the strains; or, without one or in closed
    form, `stress`. Loads that see no more than moments which do not depend on the
    strains, and forces which depend on no strain but the element's own, may promise
    `reach = "neighbours"`.
    """

    walls: Walls = ()
    """Walls into which it goes on; a field of subclasses that do."""

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Stored energy [J]."""
        # Not abstract: a subclass may have `stress` alone.
        raise NotImplementedError(
            f"{type(self).__name__} must have stored(rod, strains) or "
            "stress(rod, strains)"
        )

    def stress(self, rod: Rod, strains: SectionStrains) -> SectionStress:
        """Force and moment: by default the derivatives of the stored energy."""
        slope = jax.grad(lambda there: self.stored(rod, there))(strains)
        return SectionStress(slope.edges, slope.rotations)

    def at_speed(self, rod: Rod, motion: Motion) -> SectionLoad:
        """Itself with what depends on how fast the rod moves; at rest as it is."""
        return self

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """The stress, as it acts on nodes and elements."""
        strains, couplings = self._strains(motion)
        stress = self.at_speed(rod, motion).stress(rod, strains)
        forces, couples = None, None
        if stress.force is not None:
            frame = directors(motion.orientation)
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
        """The stored energy, if there is one [J]."""
        if type(self).stored is SectionLoad.stored:
            return 0.0
        return self.stored(rod, self._strains(motion_of(state))[0])

    @property
    def twists(self) -> str | None:
        """All of it: strains themselves are in the material frame."""
        return "stress in the material frame"

    def _strains(self, motion: Motion) -> tuple[SectionStrains, Array]:
        """The strains, and the couplings of the joints (see `joint_couples`)."""
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
    """Rotation of the joint between a wall and the end element, and its coupling."""
    frame = split_quaternion(wall.orientation)
    element = at_end(orientation, wall.end)
    before, after = (frame, element) if wall.end == "start" else (element, frame)
    return rotation_log_and_coupling(multiply_quaternions(conjugate(before), after))


def _without_free_ends(moment: Vec3, held: Sequence[str]) -> Vec3:
    first, last = (0 if end in held else 1 for end in ("start", "finish"))
    if not first and not last:
        return moment

    def one(part: Array) -> Array:
        return vectors.pad(part[first : part.shape[0] - last], first, last)

    return one(moment[0]), one(moment[1]), one(moment[2])


def _inner_sum(a: Vec3) -> Vec3:
    """Sums of neighbours: one entry fewer than `a`."""
    return a[0][1:] + a[0][:-1], a[1][1:] + a[1][:-1], a[2][1:] + a[2][:-1]


def walls_of(into: Clamp | tuple[Clamp, ...] | None) -> Walls:
    """Walls of the clamps into which an actuator goes on.

    Raises:
        TypeError: If they are something else.
        ValueError: If two are at one end.
    """
    clamps = () if into is None else into if isinstance(into, tuple) else (into,)
    for clamp in clamps:
        check_kind("into", clamp, Clamp)
    walls = tuple(Wall(clamp.orientation, None, clamp.end) for clamp in clamps)
    if len({wall.end for wall in walls}) < len(walls):
        raise ValueError("into must be clamps at different ends")
    return walls


def lengths_at_nodes(rod: Rod) -> Array:
    """Rest length around each node, half of each neighbouring element's [m]."""
    return at_nodes(rod.rest_lengths)


def at_nodes(of_elements: Array) -> Array:
    """What elements have, half of it at each of their nodes."""
    half = 0.5 * of_elements
    return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)
