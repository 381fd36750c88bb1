r"""Loose modes: motions of a rod as a whole that nothing resists, in statics.

A rod on two pins can spin about its axis, and a rod on a smooth floor can slide. The
tangent stiffness $T$ is then singular, and the balance of loads does not determine the
position along the mode. If the loads do not drive such a mode $m$, $m\cdot r = 0$, then
a spring that resists it at one place $u$ changes only that position:

$$(T + \sigma\,u u^T)\,s = -r \quad\Rightarrow\quad
  \sigma\,(m\cdot u)(u\cdot s) = -m\cdot r = 0 \quad\Rightarrow\quad T s = -r.$$

This is the solution that leaves that place exactly fixed, for any stiffness of the
spring. If the loads do drive the mode, $u\cdot s$ does not vanish. Newton's method then
keeps moving the rod, and converges only if it reaches a position where the loads no
longer drive the mode.

The modes that are checked are the six rigid-body motions and the rotation of all
elements about their own axes. A round rod that is straight at rest does not resist this
rotation, even if it is bent.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.statics.degrees_of_freedom import stack_dofs
from jaxrod.statics.effect_tangents import Tangent

_ROUNDINGS = 16
"""Multiple of the machine epsilon up to which a resistance counts as zero. Loose modes
reach 3; modes resisted by pins exceed 3000 in float32 even for n = 100 and L/r =
1000."""


def loose_modes(
    tangent: Tangent,
    rod: Rod,
    motion: Motion,
    free: Float[Array, "n+1 6"],
) -> Float[Array, "7 n+1 6"]:
    """Independent motions of the rod as a whole that nothing resists.

    Args:
        tangent: The tangent stiffness.
        rod: The rod.
        motion: Its configuration.
        free: Flags of the components: 1 if free, 0 if held by the scene.

    Returns:
        Displacements of nodes, in lengths of the rod, and rotations of elements [rad];
        zeros in place of modes that are resisted.
    """
    modes, units = _modes_of_the_whole(rod, motion), _units(rod)
    steps = units[None] * modes
    resisted = jax.vmap(tangent.multiply)(free[None] * steps)
    # Size of the rows if nothing cancelled.
    sizes = jax.tree.map(jnp.abs, tangent)
    whole = jnp.max(jax.vmap(sizes.multiply)(jnp.abs(steps)), axis=0)
    resisted = (free / jnp.where(whole > 0, whole, 1))[None] * resisted
    broken = (1 - free)[None] * modes
    both = jnp.concatenate([resisted, broken], axis=1).reshape(len(modes), -1)
    _, resistance, mixtures = jnp.linalg.svd(both.T, full_matrices=False)
    none = resistance <= _ROUNDINGS * jnp.finfo(resistance.dtype).eps
    mixtures = jnp.where(none[:, None], mixtures, 0)
    return jnp.sum(mixtures[:, :, None, None] * modes[None], axis=1)


def are_any(modes: Float[Array, "7 n+1 6"]) -> Bool[Array, ""]:
    """Whether any mode is nonzero, with entries above 0.01.

    In a straight rod, rotation as a whole about its axis minus rotation of all elements
    about theirs is a mode of the size of round-off. It does not count.
    """
    return jnp.max(jnp.abs(modes)) > 0.01


def held_in_the_middle(
    tangent: Tangent, rod: Rod, modes: Float[Array, "7 n+1 6"]
) -> Tangent:
    """Tangent with springs on the middle node and element that resist the loose modes.

    The springs are as stiff as the rod in bending. So if loads drive a mode, a
    correction is about as large as the bending under these loads.
    """
    middle = _middle(rod)
    local = modes[:, middle] / _units(rod)
    stiffness = jnp.mean(rod.bend_twist_stiffness[0]) / jnp.sum(rod.rest_lengths)
    springs = jnp.sum(local[:, :, None] * local[:, None, :], axis=0)
    return tangent.stiffened(middle, stiffness * springs)


def _modes_of_the_whole(rod: Rod, motion: Motion) -> Float[Array, "7 n+1 6"]:
    """Seven candidates: displacement along and rotation about each axis, and twist.

    Rotations are about the middle node; displacements are divided by the rod's length.
    The last candidate rotates all elements about their d3.
    """
    middle = _middle(rod)
    length = jnp.sum(rod.rest_lengths)
    x, y, z = ((c - c[middle]) / length for c in motion.position)
    d3 = directors(motion.orientation)[2]
    modes = []
    for k in range(3):
        nodes, elements = vectors.along(k, x), vectors.along(k, d3[0])
        around = vectors.cross(nodes, (x, y, z))
        modes.append(stack_dofs(nodes, vectors.scale(0.0, elements)))
        modes.append(stack_dofs(around, elements))
    return jnp.stack([*modes, stack_dofs(vectors.scale(0.0, (x, y, z)), d3)])


def _middle(rod: Rod) -> int:
    return rod.n_elements // 2


def _units(rod: Rod) -> Float[Array, "1 6"]:
    """Scales: the length of the rod [m] for displacements, 1 rad for rotations."""
    length = jnp.sum(rod.rest_lengths)
    one = jnp.ones_like(length)
    return jnp.stack([length, length, length, one, one, one])[None]
