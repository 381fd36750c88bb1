"""Rigid motions of the parts of a member: its rods, or its bodies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry import matrices, vectors
from jaxrod.geometry.rotations import directors
from jaxrod.geometry.vectors import Vec3
from jaxrod.systems.members.parts import Seen


def rigid_motions(own: Seen, length: Array) -> Iterator[tuple[Vec3, Vec3]]:
    """Yields scaled velocities and angular velocities of the rigid motions of parts.

    Each part is displaced along three axes and turned about three through its middle,
    and all elements of a rod turn about their own axes.

    Args:
        own: The member.
        length: Scale of velocities [m].
    """
    count = own.parts.count
    centred = []
    for component in own.motion.position:
        rows = component.reshape(count, -1)
        # Relative to the first node, so that no digits are lost far from the origin.
        rows = rows - rows[:, :1]
        centred.append((rows - jnp.mean(rows, axis=1, keepdims=True)).reshape(-1))
    arm: Vec3 = (centred[0], centred[1], centred[2])
    d3 = directors(own.motion.orientation)[2]
    still, unturned = vectors.scale(0.0, arm), vectors.scale(0.0, d3)
    motions = [] if not own.parts.is_rod else [(still, d3)]
    for axis in range(3):
        moving, turning = _along(axis, arm[0]), _along(axis, d3[0])
        motions.append((moving, unturned))
        around = vectors.scale(1 / length, vectors.cross(moving, arm))
        motions.append((around, turning))
    for velocity, turning in motions:
        for part in range(count):
            yield _of_part(part, count, velocity), _of_part(part, count, turning)


def _of_part(part: int, count: int, field: Vec3) -> Vec3:
    """Copy of a field with zeros for all parts but one."""
    x, y, z = (
        jnp.where(jnp.arange(c.size) // (c.size // count) == part, c, 0) for c in field
    )
    return x, y, z


def _along(axis: int, like: Array) -> Vec3:
    """Constant field of unit vectors along a world axis."""
    x, y, z = (jnp.full_like(like, k == axis) for k in range(3))
    return x, y, z


def spins(own: Seen, turning: Vec3) -> Vec3:
    """Spins (angular momenta) of elements at given angular velocities [rad/s]."""
    # Angular velocities are linear in spins: their matrix, column by column.
    columns = []
    for axis in range(3):
        spin = _along(axis, turning[0])
        moving = replace(own, motion=replace(own.motion, spin=spin))
        columns.append(moving.angular_velocities)
    matrix = matrices.transpose((columns[0], columns[1], columns[2]))
    # Scaled to the size of one, because products of three inertias would underflow in
    # float32.
    size = matrix[0][0] + matrix[1][1] + matrix[2][2]
    a, b, c = matrices.scale(1 / size, matrix)
    cofactors = vectors.cross(b, c), vectors.cross(c, a), vectors.cross(a, b)
    determinant = vectors.dot(a, cofactors[0]) * size
    inverse = matrices.transpose(matrices.scale(1 / determinant, cofactors))
    x, y, z = (vectors.dot(row, turning) for row in inverse)
    return x, y, z
