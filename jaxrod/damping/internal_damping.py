r"""Internal damping: viscosity of the material of the rod (Kelvin-Voigt).

It adds $\tau S\,\dot\sigma$ and $\tau B\,\dot\kappa$ to the elastic stress and moment,
with one relaxation time $\tau$. Rigid-body motion is not damped, and a mode of angular
frequency $\omega$ decays at the rate $\tau\omega^2/2$.

Each kick by the loads is followed by a backward Euler step of the damping alone, at
fixed configuration. $h$ is the step, $M$ the inertia, $G$ the matrix that maps the
velocities and spins $r$ to strain rates, and $D$ the drag coefficients of the strain
rates. The step solves for the impulses $p$ of the forces in elements and the couples in
joints:

$$(1 + h D\,G M^{-1} G^T)\,p = -h D\,G\,r, \qquad M\,\Delta r = G^T p.$$

This is one block-tridiagonal system (`chain_of_pairs.py`). Components are along the
axes of elements and joints, where $D$ is diagonal. Each impulse acts in both directions
and thus conserves momentum and angular momentum to round-off, whatever the accuracy of
$p$. In the bound of `stable_dt` the damping only adds inertia, $M + h G^T D G$: $\tau$
may be as large as desired. The error is of first order in $h\tau\omega^2$, which is
small for all motion that lasts more than a few steps.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod.damping.chain_of_pairs import ChainOfPairs
from jaxrod.effects.base import Effect
from jaxrod.effects.directions import frame_along
from jaxrod.geometry import matrices, vectors
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    multiply_quaternions,
    normalise,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod, free_velocity_mask
from jaxrod.rods.motion import Motion
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array


@pytree
class InternalDamping(Effect):
    """Viscosity of the material; see `internal_damping`."""

    relaxation_time: Float[Array, ""]
    """Relaxation time: viscous stiffness over elastic stiffness [s]."""

    def dissipate(self, scene: LoadedRod, motion: Motion, dt: Array) -> Motion:
        """Motion whose strain rates have decayed for one step, by backward Euler."""
        pairs = _pairs(scene, motion, self.relaxation_time * dt)
        inverse_masses = 1 / scene.rod.node_masses
        inverse_inertias = vectors.split(1 / scene.rod.principal_inertias)
        spin = motion.spin
        if not motion.spin_is_velocity:
            spin = vectors.multiply(inverse_inertias, to_material(pairs.frame, spin))
        mobility = _mobility(scene, motion, inverse_masses, inverse_inertias)
        # XLA would compute the frames again for each coupling, and compile slowly.
        chain = lax.optimization_barrier(pairs.chain(*mobility))
        joints, elements = pairs.strain_rates(motion.velocity, spin)
        pushes, turns = pairs.loads(*chain.solve(joints, elements))
        if motion.spin_is_velocity:
            turns = vectors.multiply(inverse_inertias, to_material(pairs.frame, turns))
        return replace(
            motion,
            velocity=vectors.subtract(
                motion.velocity, vectors.scale(inverse_masses, pushes)
            ),
            spin=vectors.subtract(motion.spin, turns),
        )


@pytree
class _Pairs:
    """Geometry and drag of the impulses in elements and joints of a damping step.

    Every impulse acts on two nodes, or on two elements, in opposite directions. Joint
    `k` of `n + 1` is before element `k`; the first and the last are joints to walls,
    without drag at free ends. Components are along the axes of the element or the
    joint.
    """

    frame: Matrix
    """Axes d1, d2, d3 of the elements, world frame."""
    edges: Vec3
    """Vectors from each node to the next, world frame [m]."""
    axes_before: Matrix
    """Axes of the joints, in the material frame of the element before each."""
    axes_after: Matrix
    """Axes of the joints, in the material frame of the element after each."""
    joint_drag: Vec3
    """Impulse in one step per rotation rate of each joint, about its axes [N m s^2]."""
    element_drag: Vec3
    """Impulse in one step per rate of the edge of each element, along its axes
    [N s^2/m]."""

    def strain_rates(self, velocity: Vec3, spin: Vec3) -> tuple[Vec3, Vec3]:
        """Rotation rates of joints [rad/s] and rates of edges of elements [m/s].

        Args:
            velocity: Velocities of the nodes, world frame [m/s].
            spin: Angular velocities of the elements, material frame [rad/s].
        """
        before, after = (_padded(spin, *ends) for ends in ((1, 0), (0, 1)))
        joints = vectors.subtract(
            to_material(self.axes_after, after), to_material(self.axes_before, before)
        )
        lever = to_material(self.frame, self.edges)
        stretched = to_material(self.frame, vectors.inner_difference(velocity))
        return joints, vectors.add(stretched, vectors.cross(lever, spin))

    def loads(self, joints: Vec3, elements: Vec3) -> tuple[Vec3, Vec3]:
        """Impulses on nodes [N s] and elements [N m s], world frame.

        Each impulse is cancelled by an opposite one to the last digit, except at walls.

        Args:
            joints: Impulses of couples in joints, along their axes.
            elements: Impulses of forces in elements, along their axes.
        """
        n = len(self.edges[0])
        force = to_world(self.frame, elements)
        x, y, z = (c[1:] for c in to_world(self.axes_before, joints))
        couple = to_world(self.frame, (x, y, z))
        x, y, z = (vectors.pad(c[:1], 0, n - 1) for c in joints)
        wall = to_world(self.frame, (x, y, z))
        x, y, z = (c[:n] for c in vectors.difference(couple))
        turns = vectors.subtract(vectors.cross(force, self.edges), (x, y, z))
        x, y, z = (-c for c in vectors.difference(force))
        return (x, y, z), vectors.add(turns, wall)

    def chain(self, moving: Array, partly: Vec3, turning: Vec3) -> ChainOfPairs:
        """Linear system of the impulses: couplings G M^-1 G^T, and drag as weights.

        Args:
            moving: Inverse masses of nodes that are free along all axes, otherwise 0.
            partly: Inverse masses of the other nodes along each axis; 0 where held.
            turning: Inverse inertias of the elements about d1, d2, d3; 0 where held.
        """
        # The number of elements must be odd: an element without drag is appended.
        more = 1 - len(self.edges[0]) % 2
        frame = _padded_rows(self.frame, 0, more)
        lever = _padded(to_material(self.frame, self.edges), 0, more)
        moving, partly = vectors.pad(moving, 0, more), _padded(partly, 0, more)
        first, second = (
            _padded_rows(axes, 0, more) for axes in (self.axes_before, self.axes_after)
        )
        turned_first = _scaled_columns(first, _padded(turning, 1, more))
        turned_second = _scaled_columns(second, _padded(turning, 0, 1 + more))
        first_next, turned_next = _part(first, 1, None), _part(turned_first, 1, None)
        turned_here = _part(turned_second, None, -1)
        x, y, z = lever
        a, b, c = _padded(turning, 0, more)
        levered = (
            (b * z * z + c * y * y, -c * x * y, -b * x * z),
            (-c * x * y, a * z * z + c * x * x, -a * y * z),
            (-b * x * z, -a * y * z, a * y * y + b * x * x),
        )
        u, v, w = (c[:-1] + c[1:] for c in partly)
        pushed = _products(_scaled_columns(frame, (u, v, w)), frame)
        elements = matrices.add(
            matrices.add(levered, pushed),
            matrices.scaled_identity(moving[:-1] + moving[1:]),
        )
        i, j, k = (-(c + moving)[1:-1] for c in partly)
        nodes = _scaled_columns(_part(frame, None, -1), (i, j, k))
        return ChainOfPairs(
            joint_weights=_padded(self.joint_drag, 0, more),
            element_weights=_padded(self.element_drag, 0, more),
            joints=matrices.add(
                _products(turned_first, first), _products(turned_second, second)
            ),
            elements=elements,
            before=matrices.transpose(
                matrices.scale(-1, matrices.cross_rows(turned_here, lever))
            ),
            after=matrices.transpose(matrices.cross_rows(turned_next, lever)),
            across_elements=matrices.scale(-1, _products(turned_here, first_next)),
            across_nodes=_products(nodes, _part(frame, 1, None)),
        )


def _pairs(scene: LoadedRod, motion: Motion, duration: Array) -> _Pairs:
    """Makes `_Pairs` at a configuration.

    Args:
        scene: The scene, whose wall joints are damped, too.
        motion: Configuration of the rod.
        duration: Relaxation time times step [s^2].
    """
    rod = scene.rod
    frame = directors(motion.orientation)
    drag = vectors.split(rod.joint_stiffness / rod.joint_lengths[None, :])
    x, y, z = _padded(drag, 1, 1)
    for effect in scene.effects:
        wall = effect.wall(rod)
        if wall is not None and wall.stiffness is not None:
            index = 0 if wall.end == "base" else -1
            x, y, z = (
                c.at[index].add(k)
                for c, k in zip((x, y, z), wall.stiffness, strict=True)
            )
    before, after = _joint_axes(scene, motion.orientation, frame)
    shear = vectors.split(rod.shear_stretch_stiffness / rod.rest_lengths[None, :])
    pairs = _Pairs(
        frame=frame,
        edges=motion.edges,
        axes_before=_with_walls(before),
        axes_after=_with_walls(after),
        joint_drag=vectors.scale(duration, (x, y, z)),
        element_drag=vectors.scale(duration, shear),
    )
    return lax.optimization_barrier(pairs)


def _joint_axes(
    scene: LoadedRod, q: Quaternion, frame: Matrix
) -> tuple[Matrix, Matrix]:
    """Axes of the inner joints, in the frames of the elements before and after them.

    With twist they are the axes of a frame midway between those of both elements;
    without, those of a frame along the mean direction of both.
    """
    if scene.method.twist:
        w, x, y, z = (c[:-1] for c in q)
        back = conjugate((w, x, y, z))
        w, x, y, z = (c[1:] for c in q)
        w, x, y, z = multiply_quaternions(back, (w, x, y, z))
        # Half of the relative rotation, by the smaller angle.
        way = jnp.where(w < 0, -1, 1)
        half = normalise((1 + way * w, way * x, way * y, way * z))
        axes = directors(half)
        return axes, matrices.transpose(axes)
    # The d1 and d2 of an element are unrelated to those of the next.
    x, y, z = (c[:-1] + c[1:] for c in frame[2])
    length = jnp.maximum(vectors.safe_norm((x, y, z)), 1e-6)
    axes = directors(frame_along((x / length, y / length, z / length)))
    first, second = _part(frame, None, -1), _part(frame, 1, None)
    return _products(axes, first), _products(axes, second)


def _mobility(
    scene: LoadedRod, motion: Motion, inverse_masses: Array, inverse_inertias: Vec3
) -> tuple[Array, Vec3, Vec3]:
    """Inverse masses and inertias as `_Pairs.chain` takes them; 0 where held.

    They are the masses of free nodes, those of partly held nodes along each axis, and
    the inertias of elements.
    """
    nodes, elements = free_velocity_mask(scene, motion)
    x, y, z = (c != 0 for c in nodes)
    everywhere = x & y & z
    moving = jnp.where(everywhere, inverse_masses, 0)
    i, j, k = (jnp.where(c & ~everywhere, inverse_masses, 0) for c in (x, y, z))
    a, b, c = (c != 0 for c in elements)
    turning = a | b | c
    u, v, w = (jnp.where(turning, c, 0) for c in inverse_inertias)
    return moving, (i, j, k), (u, v, w)


def _with_walls(axes: Matrix) -> Matrix:
    """Axes of all joints, from those of the inner joints.

    The axes of the joints to walls are those of the end elements.
    """
    one = jnp.ones((), axes[0][0].dtype)
    ends = [(1, 1, 0)]
    (a, b, c), (d, e, f), (g, h, i) = (
        [lax.pad(c, one * (i == j), ends) for j, c in enumerate(row)]
        for i, row in enumerate(axes)
    )
    return (a, b, c), (d, e, f), (g, h, i)


def _padded(a: Vec3, before: int, after: int) -> Vec3:
    """Vector field with `before` zeros before and `after` zeros after its entries."""
    x, y, z = (vectors.pad(c, before, after) for c in a)
    return x, y, z


def _padded_rows(a: Matrix, before: int, after: int) -> Matrix:
    """Matrix field with `before` zeros before and `after` zeros after its entries."""
    x, y, z = (_padded(row, before, after) for row in a)
    return x, y, z


def _part(matrix: Matrix, first: int | None, last: int | None) -> Matrix:
    """Entries of a matrix field from index `first` up to index `last`."""
    (a, b, c), (d, e, f), (g, h, i) = ([c[first:last] for c in row] for row in matrix)
    return (a, b, c), (d, e, f), (g, h, i)


def _scaled_columns(a: Matrix, factors: Vec3) -> Matrix:
    """Products of matrices with diagonal matrices, which scale their columns."""
    x, y, z = (vectors.multiply(row, factors) for row in a)
    return x, y, z


def _products(a: Matrix, b: Matrix) -> Matrix:
    """Products a b^T of matrix fields."""
    x, y, z = (to_material(b, row) for row in a)
    return x, y, z


def internal_damping(relaxation_time: Numbers) -> InternalDamping:
    """Viscosity of the rod's material: strain rates decay, rigid motion does not.

    The amplitude of a mode of angular frequency w decays at the rate
    `relaxation_time w^2 / 2`. Steps are stable at any relaxation time. The wall joint
    of `clamp` has the same damping as the rod, as if its wall did not move.

    A step takes some three to ten times as long as without it: see docs/material.md.

    Args:
        relaxation_time: Viscous over elastic stiffness [s].

    Raises:
        ValueError: If it is not a number, or negative.

    Example:
        >>> moving = replace(state, velocities=jnp.ones_like(state.velocities))
        >>> scene = jaxrod.make_scene(rod, jaxrod.internal_damping(0.01))
        >>> after = jaxrod.step(scene, moving, 1e-4)
        >>> after.velocities[:, 0].round(3).tolist()  # rigid motion is not damped
        [1.0, 1.0, 1.0]
    """
    return InternalDamping(
        as_array("relaxation_time", relaxation_time, "s", non_negative=True)
    )
