r"""Stress that is added to a rod's own: the base of actuation inside a rod.

The strains of a rod are the edges of its elements in their material frames,
$\epsilon_k = R_k^T \Delta x_k$ [m], and the rotations $\phi_k$ [rad] of its joints.
An actuator responds to them with forces $n_k$ in elements and moments $m_k$ in joints,
which act on nodes and elements as the elastic ones do,

$$f = \Delta^h(R\,n), \qquad
  c = \Delta^h(a) + \mathcal A^h(b) + \epsilon\times n,$$

with the parts $a$, $b$ of `rods.elasticity.joint_couples`. So momentum and angular
momentum are exact for any stress. If there is a stored energy,
$n = \partial E/\partial\epsilon$ and $m = \partial E/\partial\phi$, and the loads are
its exact negative gradient.

Joints are at the nodes. An array over nodes, of length `n + 1`, has the joints of the
inner nodes and, at an end with a wall, the joint between the wall and the end element.
At free ends the rotation is zero, and a moment is left out.
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
"""Walls at ends of a rod into which an actuator continues."""


@pytree
class SectionStrains:
    """Strains of a rod in the material frames of its sections."""

    edges: Vec3
    """Vectors from each node to the next in the element's material frame, `n` [m]."""
    rotations: Vec3
    """Rotation of the joint at each node, material frame, `n + 1` [rad]; 0 if free."""


@pytree
class SectionStress:
    """Stress of an actuator; components that it does not have are `None`."""

    force: Vec3 | None = None
    """Force in elements, material frame, positive along d3 in tension, `n` [N]."""
    moment: Vec3 | None = None
    """Moment in the joint at each node, material frame, `n + 1` [N m]; not if free."""


class SectionLoad(Effect):
    """Base of actuators inside a rod.

    A subclass has `stored`, an energy of the strains, or `stress`, without an energy or
    in closed form. A subclass may promise `reach = "neighbours"` if its moments do not
    depend on the strains and its forces depend on the element's own strain only.
    """

    walls: Walls = ()
    """Walls into which it continues; subclasses that support it have it as a field."""

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
        """The actuator with its speed-dependent parts set; by default unchanged."""
        return self

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Stress, as it acts on nodes and elements."""
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
        """Stored energy, zero if there is none [J]."""
        if type(self).stored is SectionLoad.stored:
            return 0.0
        return self.stored(rod, self._strains(motion_of(state))[0])

    @property
    def twists(self) -> str | None:
        """Name of the stress, all of which is in the material frame."""
        return "stress in the material frame"

    def _strains(self, motion: Motion) -> tuple[SectionStrains, Array]:
        """Strains, and the couplings of the joints (see `joint_couples`)."""
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
    """Sums of neighbours, with one entry fewer than `a`."""
    return a[0][1:] + a[0][:-1], a[1][1:] + a[1][:-1], a[2][1:] + a[2][:-1]


def walls_of(into: Clamp | tuple[Clamp, ...] | None) -> Walls:
    """Walls of the clamps into which an actuator continues.

    Raises:
        TypeError: If they are not clamps.
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
    """Quantity of the elements, half of it at each of their nodes."""
    half = 0.5 * of_elements
    return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)
