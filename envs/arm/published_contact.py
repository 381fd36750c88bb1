r"""The contact law of the published environments, with its broad phase.

For an element of the arm and a cylinder, with $\hat n$ the unit vector from the
element's closest point to the cylinder's and $\gamma$ the overlap, both nodes of the
element are pushed by $-F \hat n$ in full (the base by half of it), where

$$F = \max(0,\ (f - f_c)\cdot\hat n)
      + \tfrac12 [\gamma > 0]\,(k \gamma + \nu\, \bar v \cdot \hat n).$$

$f$ is the mean over the two nodes of all forces computed so far, and $\bar v$ the mean
of their velocities. $f_c$ is the sum of the forces that this cylinder has taken up so
far in this step, from all elements. $k$ is the stiffness and $\nu$ the damping of the
contact. The first term cancels the force that presses the element against the cylinder.
Elements and cylinders are treated one after another, so every force depends on the
forces before it.

The broad phase skips a cylinder unless its bounding box and the arm's overlap. The box
is wrong for a cylinder whose `normal` is parallel to its direction: it then has no
width. (PyElastica 1.0 still has this box, but not the first term of the force.)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod import Rod
from jaxrod.envs.arm.cylinders import Cylinders
from jaxrod.extend import Effect, Loads, Motion
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.methods.planar_verlet import PLANES, PlaneName
from jaxrod.structure import pytree, static

Components = tuple[Array, ...]
"""Components of a vector field, one array each: three, or two in a plane."""

FARTHEST_GAP = 1e-5
"""Largest gap between element and cylinder at which forces are cancelled [m]."""

PARALLEL = 1e-6
"""Squared sine of an angle below which element and cylinder count as parallel."""


@pytree
class PublishedContact(Effect):
    """Published contact law of an arm with cylinders, only for `pyelastica()`.

    It must be listed after all other effects that exert forces.
    """

    cylinders: Cylinders
    stiffness: Float[Array, ""]
    """Contact force per overlap, k [N/m]."""
    damping: Float[Array, ""]
    """Contact force per speed of approach, nu [kg/s]."""
    plane: PlaneName | None = static(default=None)
    """Plane perpendicular to all cylinders, if the arm and everything that acts on it
    stay in it: forces out of this plane are ignored."""

    def loads_after(self, rod: Rod, motion: Motion, before: Loads) -> Loads:
        """Contact forces on the nodes, from all forces of the effects listed before."""
        if before.forces is None:
            raise ValueError("PublishedContact needs the forces found so far")
        forces = self._seen(before.forces)
        # Without the barrier XLA recomputes the encounters wherever the sweep reads
        # them.
        normals, pushes = lax.optimization_barrier(self.encounters(rod, motion))
        after = _sweep(forces, normals, pushes)
        change = [new - old for new, old in zip(after, forces, strict=True)]
        if self.plane is None:
            return Loads(forces=(change[0], change[1], change[2]))
        a, b, out = PLANES[self.plane]
        x = {a: change[0], b: change[1], out: jnp.zeros_like(change[0])}
        return Loads(forces=(x[0], x[1], x[2]))

    def encounters(
        self, rod: Rod, motion: Motion
    ) -> tuple[Components, Float[Array, "m n"]]:
        """Contact normals n, and pushes 1/2 (k overlap + nu v . n) [N].

        Entry (j, i) is cylinder j and element i. A normal is the unit vector from the
        element's closest point to the cylinder's, zero beyond `FARTHEST_GAP`. A push is
        zero without overlap.
        """
        lengths = motion.lengths
        radii = rod.radii * jnp.sqrt(rod.rest_lengths / lengths)
        reach = radii[None, :] + self.cylinders.radii[:, None]
        closest = _closest_points if self.plane is None else self._closest_in_plane
        apart, offset_squared = closest(motion, self.cylinders)
        squared = _dot(apart, apart)
        distance = jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))
        overlap = reach - distance
        far = reach + lengths[None, :] + self.cylinders.lengths[:, None]
        gate = boxes_overlap(self.cylinders, motion, lengths, radii)
        active = (
            gate[:, None] & (offset_squared < far * far) & (overlap >= -FARTHEST_GAP)
        )
        inverse = jnp.where(active, 1 / distance, 0)
        normal = tuple(inverse * c for c in apart)
        speeds = tuple(
            0.5 * (c[1:] + c[:-1])[None, :] for c in self._seen(motion.velocity)
        )
        push = 0.5 * (self.stiffness * overlap + self.damping * _dot(speeds, normal))
        return normal, jnp.where(active & (overlap > 0), push, 0)

    def _seen(self, vector: Vec3) -> Components:
        """Components of a vector in the plane of motion; all three without a plane."""
        if self.plane is None:
            return vector
        a, b, _ = PLANES[self.plane]
        return vector[a], vector[b]

    def _closest_in_plane(
        self, motion: Motion, cylinders: Cylinders
    ) -> tuple[Components, Float[Array, "m n"]]:
        """Vector from each element to each cylinder axis, a point of the plane [m].

        It begins at the closest point of the element. The second result is as in
        `_closest_points`.
        """
        offset = tuple(
            c[None, :-1] - start[:, None]
            for c, start in zip(motion.position, cylinders.starts, strict=True)
        )
        edge = tuple(c[None, :] for c in self._seen(motion.edges))
        inside = self._seen((offset[0], offset[1], offset[2]))
        part = jnp.clip(-_dot(edge, inside) / _dot(edge, edge), 0, 1)
        apart = tuple(-part * e - o for e, o in zip(edge, inside, strict=True))
        return apart, _dot(offset, offset)


def boxes_overlap(
    cylinders: Cylinders,
    motion: Motion,
    lengths: Float[Array, " n"],
    radii: Float[Array, " n"],
) -> Bool[Array, " m"]:
    """Whether each cylinder's published bounding box overlaps that of the arm.

    The arm's box is that of its nodes, widened by its largest radius plus its largest
    element length.
    """
    margin = jnp.max(radii) + jnp.max(lengths)
    d1 = vectors.split(cylinders.normals)
    d3 = vectors.split(cylinders.directions)
    d2 = vectors.cross(d3, d1)
    centres = vectors.split(cylinders.centres)
    overlap = jnp.ones(cylinders.radii.shape, bool)
    for x, centre, a, b, c in zip(motion.position, centres, d1, d2, d3, strict=True):
        # The published order: sum first, absolute value after.
        half = jnp.abs((a + b) * cylinders.radii + 0.5 * c * cylinders.lengths)
        low, high = jnp.min(x) - margin, jnp.max(x) + margin
        overlap &= (centre + half >= low) & (centre - half <= high)
    return overlap


def _closest_points(
    motion: Motion, cylinders: Cylinders
) -> tuple[Vec3, Float[Array, "m n"]]:
    """Vector from each element to each cylinder axis between their closest points [m].

    Returns:
        The vectors (cylinder, element), and the squared distance of each element's
        first node from each cylinder's start [m^2].
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
    # Closest points of the two lines, then of element and cylinder in turn.
    along = (squared * height - lean * back) / jnp.where(skew, across, 1)
    along = jnp.clip(jnp.where(skew, along, 0), 0, ends)
    part = jnp.clip((along * lean - back) / squared, 0, 1)
    along = jnp.clip(height + part * lean, 0, ends)
    apart = vectors.subtract(
        vectors.subtract(vectors.scale(along, axis), vectors.scale(part, edge)), offset
    )
    return apart, vectors.dot(offset, offset)


def _rows(field: Vec3) -> Vec3:
    """Adds a leading axis to a field over elements: shape (n,) becomes (1, n)."""
    return field[0][None, :], field[1][None, :], field[2][None, :]


def _columns(field: Vec3) -> Vec3:
    """Adds a trailing axis to a field over cylinders: shape (m,) becomes (m, 1)."""
    return field[0][:, None], field[1][:, None], field[2][:, None]


def _sweep(
    forces: Components, normals: Components, pushes: Float[Array, "m n"]
) -> Components:
    """Adds the contact forces of all cylinders and elements to the node forces [N].

    `normals` and `pushes` are those of `encounters`, for cylinder j and element i.
    The published loops run over cylinders, then over elements. Cylinder j can treat
    element i once it has treated element i - 1 and cylinder j - 1 has treated element
    i + 1. So all cylinders are treated in parallel, each two elements behind the
    previous one.

    Each component is a separate array: stacked, they would cost XLA four times as much.
    """
    count, n = pushes.shape
    rounds = n + 2 * count
    streams = tuple(jnp.pad(c, (0, rounds - n - 1)) for c in forces)
    skewed = tuple(_skewed(c, rounds) for c in normals)
    # The base node takes half of the force on its element.
    first = np.arange(rounds)[:, None] == 2 * np.arange(count)[None, :] + 1
    shares = jnp.asarray(np.where(first, 0.5, 1.0), pushes.dtype)
    Carry = tuple[Components, Components, Components]

    def turn(carry: Carry, given: tuple[Any, ...]) -> tuple[Carry, Components]:
        left, done, taken = carry
        node, normal, push, share = given
        right = _each(lambda x, d: jnp.concatenate([x[None], d[:-1]]), node, done)
        felt = _each(lambda a, b, t: 0.5 * (a + b) - t, left, right, taken)
        size = jnp.maximum(_dot(felt, normal), 0) + push
        force = tuple(size * c for c in normal)
        done = _each(lambda a, f: a - share * f, left, force)
        taken = _each(lambda t, f: t + (1 + share) * f, taken, force)
        left = _each(lambda b, f: b - f, right, force)
        return (left, done, taken), tuple(d[-1] for d in done)

    nothing = tuple(jnp.zeros(count, pushes.dtype) for _ in forces)
    _, nodes = lax.scan(
        turn,
        (nothing, nothing, nothing),
        (streams, skewed, _skewed(pushes, rounds), shares),
        unroll=4,
    )
    return tuple(c[2 * count - 1 :] for c in nodes)


def _skewed(field: Float[Array, "m n"], rounds: int) -> Float[Array, "rounds m"]:
    """Field arranged by round of `_sweep`, in which cylinders lag by two elements each.

    Row r (round), column j (cylinder) has the value of cylinder j and element
    r - 2 j - 1, or zero if there is no such element.
    """
    count, n = field.shape
    wide = jnp.pad(field, ((0, 0), (1, rounds + 1 - n)))
    flat = jnp.reshape(wide, (count * (rounds + 2),))[: count * rounds]
    return jnp.reshape(flat, (count, rounds)).T


def _each(function: Callable[..., Array], *fields: Components) -> Components:
    """Applies a function to the fields' components, one component at a time."""
    return tuple(map(function, *fields))


def _dot(a: Components, b: Components) -> Array:
    """Scalar product of two vector fields at each entry: the sum of a_k b_k."""
    return reduce(lambda s, t: s + t, (x * y for x, y in zip(a, b, strict=True)))
