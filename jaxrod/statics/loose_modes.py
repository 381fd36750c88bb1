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

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
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

_MIXED = 1 / 16
"""Share of the largest component of a force or couple whose round-off counts for the
other two. Out of balance by its round-off, a couple turned with an element resists the
turn as much."""

_SWEEPS = 8
"""Number of rotations of each pair of vectors. Six make seven vectors orthogonal."""


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
    largest = jnp.max(whole.reshape(-1, 2, 3), axis=2, keepdims=True)
    largest = jnp.broadcast_to(largest, (len(whole), 2, 3)).reshape(whole.shape)
    whole = jnp.maximum(whole, _MIXED * largest)
    resisted = (free / jnp.where(whole > 0, whole, 1))[None] * resisted
    broken = (1 - free)[None] * modes
    both = jnp.concatenate([resisted, broken], axis=1).reshape(len(modes), -1)
    resistance, mixtures = singular_mixtures(both)
    none = resistance <= _ROUNDINGS * jnp.finfo(resistance.dtype).eps
    mixtures = jnp.where(none[:, None], mixtures, 0)
    return jnp.sum(mixtures[:, :, None, None] * modes[None], axis=1)


def singular_mixtures(
    vectors: Float[Array, "k m"],
) -> tuple[Float[Array, " k"], Float[Array, "k k"]]:
    r"""Mixtures of a few vectors that are orthogonal to each other.

    They are the singular values $\sigma_i$ and left singular vectors $u_i$ of the
    matrix $A$ whose rows are the vectors: $|u_i^T A| = \sigma_i$. Orthogonalisation
    reduces $A$ to a small triangle, and rotations of pairs of its rows (one-sided
    Jacobi) make these orthogonal. The errors are a few roundings of the largest
    singular value. LAPACK is not used, so that a kernel can run the whole search.

    Returns:
        The singular values, in no order, and the mixtures in rows.
    """
    count = len(vectors)
    even = count + count % 2
    triangle, left = [], vectors
    for _ in range(count):
        size = jnp.sqrt(jnp.sum(left[0] ** 2))
        one = left[0] / jnp.where(size > 0, size, 1)
        shares = jnp.sum(left * one[None], axis=1)
        triangle.append(jnp.pad(shares, (count - len(left), even - count)))
        left = (left - shares[:, None] * one[None])[1:]
    begin = jnp.concatenate(
        [jnp.stack(triangle, axis=1), jnp.eye(even, count, dtype=vectors.dtype)], axis=1
    )
    half = even // 2

    def rotated(rows: Array, _: None) -> tuple[Array, None]:
        above, below = rows[:half], rows[half:]
        product = jnp.sum((above * below)[:, :count], axis=1)
        twice = 2 * jnp.where(product == 0, 1, product)
        gap = jnp.sum((below**2 - above**2)[:, :count], axis=1) / twice
        tangent = jnp.where(gap < 0, -1, 1) / (jnp.abs(gap) + jnp.sqrt(1 + gap * gap))
        tangent = jnp.where(product == 0, 0, tangent)
        cosine = lax.rsqrt(1 + tangent * tangent)
        c, s = cosine[:, None], (cosine * tangent)[:, None]
        above, below = c * above - s * below, s * above + c * below
        # The first row stays, and the others move on by one place on a circle.
        above, last = (
            jnp.concatenate([above[:1], below[:1], above[1:-1]]),
            above[-1:],
        )
        return jnp.concatenate([above, below[1:], last]), None

    rows, _ = lax.scan(rotated, begin, length=_SWEEPS * (even - 1))
    # After whole sweeps all rows are where they began, the row of padding last.
    rows = rows[:count]
    resistance = jnp.sqrt(jnp.sum(rows[:, :count] ** 2, axis=1))
    return resistance, rows[:, count:]


def are_any(modes: Float[Array, "7 n+1 6"]) -> Bool[Array, ""]:
    """Whether any mode is nonzero, with entries above 0.01.

    In a straight rod, rotation as a whole about its axis minus rotation of all elements
    about theirs is a mode of the size of round-off. It does not count.
    """
    return jnp.max(jnp.abs(modes)) > 0.01


def held_in_the_middle(
    tangent: Tangent, rod: Rod, modes: Float[Array, "7 n+1 6"]
) -> Tangent:
    """Tangent with springs on the middle of the rod that resist the loose modes.

    The springs are as stiff as the rod in bending. So if loads drive a mode, a
    correction is about as large as the bending under these loads. They act on means
    over both sides of the middle, so that a symmetric rod stays symmetric.
    """
    first = (rod.n_elements - 1) // 2
    local = modes[:, first : first + 2] / _units(rod)[None]
    local = (local * middle_shares(rod, local.dtype)[None]).reshape(len(modes), -1)
    stiffness = jnp.mean(rod.bend_twist_stiffness[0]) / jnp.sum(rod.rest_lengths)
    springs = jnp.sum(local[:, :, None] * local[:, None, :], axis=0)
    return tangent.stiffened(first, stiffness * springs)


def middle_shares(rod: Rod, dtype: Any) -> Float[Array, "2 6"]:
    """Weights of two blocks in the displacement and rotation of the middle of a rod.

    Displacements of its two middle nodes and rotations of its two middle elements are
    averaged, or that of the only middle one is taken.
    """
    if rod.n_elements % 2:
        shares = [[0.5] * 3 + [1.0] * 3, [0.5] * 3 + [0.0] * 3]
    else:
        shares = [[0.0] * 3 + [0.5] * 3, [1.0] * 3 + [0.5] * 3]
    return jnp.asarray(shares, dtype)


def _modes_of_the_whole(rod: Rod, motion: Motion) -> Float[Array, "7 n+1 6"]:
    """Seven candidates: displacement along and rotation about each axis, and twist.

    Rotations are about the middle node; displacements are divided by the rod's length.
    The last candidate rotates all elements about their d3.
    """
    middle = rod.n_elements // 2
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


def _units(rod: Rod) -> Float[Array, "1 6"]:
    """Scales: the length of the rod [m] for displacements, 1 rad for rotations."""
    length = jnp.sum(rod.rest_lengths)
    one = jnp.ones_like(length)
    return jnp.stack([length, length, length, one, one, one])[None]
