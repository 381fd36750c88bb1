r"""The contact law of the published environments, its broad phase included.

For an element of the arm and a cylinder, with $\hat n$ the unit vector from the
element's closest point to the cylinder's and $\gamma$ the overlap, both nodes of the
element are pushed by $-F \hat n$ in full (the base by half of it), where

$$F = \max(0,\ (f - f_c)\cdot\hat n)
      + \tfrac12 [\gamma > 0]\,(k \gamma + \nu\, \bar v \cdot \hat n).$$

$f$ is the mean of all forces on the two nodes found so far and $f_c$ what this
cylinder has taken up so far in this step: the first term cancels whatever presses the
element against the cylinder. Elements are treated one after the other, cylinders one
after the other, so every force depends on those before it.

Before that a cylinder is left out altogether unless its box and the arm's overlap. The
box is wrong for a cylinder whose `normal` is parallel to its direction: it then has no
width. (PyElastica 1.0 still has this box, but not the first term of the force.)
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod import Motion, Rod, vectors
from jaxrod._pytree import pytree
from jaxrod.envs.cylinders import Cylinders
from jaxrod.vectors import Vec3

FARTHEST_GAP = 1e-5
"""Gap up to which the force-cancelling term acts [m]."""

PARALLEL = 1e-6
"""Squared sine of the angle below which element and cylinder count as parallel."""


@pytree
class LegacyContact:
    """The published contact of an arm with cylinders."""

    cylinders: Cylinders
    stiffness: Float[Array, ""]
    """k [N/m]"""
    damping: Float[Array, ""]
    """nu [kg/s]"""

    def add_to(self, forces: Vec3, rod: Rod, motion: Motion) -> Vec3:
        """All forces on the nodes [N], given all but those of contact."""
        # Without the barrier XLA works them out again wherever the sweep reads them:
        # three times slower altogether.
        normals, pushes = lax.optimization_barrier(self.encounters(rod, motion))
        return _sweep(forces, normals, pushes)

    def encounters(self, rod: Rod, motion: Motion) -> tuple[Vec3, Float[Array, "m n"]]:
        """Directions from element to cylinder, and the elastic and viscous push [N].

        Both are zero where there is no contact.
        """
        lengths = motion.lengths
        radii = rod.radii * jnp.sqrt(rod.rest_lengths / lengths)
        reach = radii[None, :] + self.cylinders.radii[:, None]
        apart, offset_squared = _closest_points(motion, self.cylinders)
        distance = vectors.safe_norm(apart)
        overlap = reach - distance
        far = reach + lengths[None, :] + self.cylinders.lengths[:, None]
        gate = boxes_overlap(self.cylinders, motion, lengths, radii)
        active = (
            gate[:, None] & (offset_squared < far * far) & (overlap >= -FARTHEST_GAP)
        )
        inverse = jnp.where(active, 1 / distance, 0)
        normal = vectors.scale(inverse, apart)
        u, v, w = (0.5 * (c[1:] + c[:-1])[None, :] for c in motion.velocity)
        closing = vectors.dot((u, v, w), normal)
        push = 0.5 * (self.stiffness * overlap + self.damping * closing)
        return normal, jnp.where(active & (overlap > 0), push, 0)


def boxes_overlap(
    cylinders: Cylinders,
    motion: Motion,
    lengths: Float[Array, " n"],
    radii: Float[Array, " n"],
) -> Bool[Array, " m"]:
    """Whether the box of the arm and the published box of each cylinder overlap."""
    margin = jnp.max(radii) + jnp.max(lengths)
    d1 = vectors.split(cylinders.normals)
    d3 = vectors.split(cylinders.directions)
    d2 = vectors.cross(d3, d1)
    centres = vectors.split(cylinders.centres)
    overlap = jnp.ones(cylinders.radii.shape, bool)
    for x, centre, a, b, c in zip(motion.position, centres, d1, d2, d3, strict=True):
        # The sum first, its absolute value after: so it was published.
        half = jnp.abs((a + b) * cylinders.radii + 0.5 * c * cylinders.lengths)
        low, high = jnp.min(x) - margin, jnp.max(x) + margin
        overlap &= (centre + half >= low) & (centre - half <= high)
    return overlap


def _closest_points(
    motion: Motion, cylinders: Cylinders
) -> tuple[Vec3, Float[Array, "m n"]]:
    """Vectors from elements to cylinder axes where both are closest [m].

    Returns:
        The vectors, and the squared distance of each element's first node from each
        cylinder's start [m^2].
    """
    edge = _rows(vectors.inner_difference(motion.position))
    axis = _columns(vectors.split(cylinders.directions))
    begin = _columns(vectors.split(cylinders.starts))
    x, y, z = motion.position
    offset = vectors.subtract(_rows((x[:-1], y[:-1], z[:-1])), begin)
    ends = cylinders.lengths[:, None]
    squared = vectors.dot(edge, edge)
    lean = vectors.dot(edge, axis)
    back = vectors.dot(edge, offset)
    height = vectors.dot(axis, offset)
    across = squared - lean * lean
    skew = across >= PARALLEL * squared
    # Of the two lines; then of element and cylinder, by turns.
    along = (squared * height - lean * back) / jnp.where(skew, across, 1)
    along = jnp.clip(jnp.where(skew, along, 0), 0, ends)
    part = jnp.clip((along * lean - back) / squared, 0, 1)
    along = jnp.clip(height + part * lean, 0, ends)
    apart = vectors.subtract(
        vectors.subtract(vectors.scale(along, axis), vectors.scale(part, edge)), offset
    )
    return apart, vectors.dot(offset, offset)


def _rows(field: Vec3) -> Vec3:
    """One value for each element."""
    return field[0][None, :], field[1][None, :], field[2][None, :]


def _columns(field: Vec3) -> Vec3:
    """One value for each cylinder."""
    return field[0][:, None], field[1][:, None], field[2][:, None]


def _sweep(forces: Vec3, normals: Vec3, pushes: Float[Array, "m n"]) -> Vec3:
    """Adds contact forces element by element, cylinder by cylinder.

    Cylinder j can treat element i as soon as it has treated element i - 1 and the
    cylinder before it element i + 1. So all work at the same time, each two elements
    behind the one before, and hand on the nodes they are done with.
    """
    count, n = pushes.shape
    rounds = n + 2 * count
    stream = jnp.pad(jnp.stack(forces), ((0, 0), (0, rounds - n - 1))).T
    skewed = _skewed(jnp.stack([*normals, pushes]), rounds)
    # The base node takes half of what its element gets.
    first = np.arange(rounds)[:, None] == 2 * np.arange(count)[None, :] + 1
    shares = jnp.asarray(np.where(first, 0.5, 1.0), pushes.dtype)

    def turn(
        carry: tuple[Array, Array, Array], given: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array, Array], Array]:
        left, done, taken = carry
        node, encounter, share = given
        normal, push = encounter[:3], encounter[3]
        right = jnp.concatenate([node[:, None], done[:, :-1]], axis=1)
        pressing = jnp.sum((0.5 * (left + right) - taken) * normal, axis=0)
        force = (jnp.maximum(pressing, 0) + push)[None, :] * normal
        done = left - share[None, :] * force
        taken = taken + (1 + share)[None, :] * force
        return (right - force, done, taken), done[:, -1]

    nothing = jnp.zeros((3, count), pushes.dtype)
    _, nodes = lax.scan(turn, (nothing, nothing, nothing), (stream, skewed, shares))
    return vectors.split(nodes[2 * count - 1 :].T)


def _skewed(fields: Float[Array, "k m n"], rounds: int) -> Float[Array, "rounds k m"]:
    """Fields by round: in round r cylinder j is at element r - 2 j - 1."""
    k, count, n = fields.shape
    wide = jnp.pad(fields, ((0, 0), (0, 0), (1, rounds + 1 - n)))
    flat = jnp.reshape(wide, (k, count * (rounds + 2)))[:, : count * rounds]
    return jnp.transpose(jnp.reshape(flat, (k, count, rounds)), (2, 0, 1))
