r"""Free rotation of a rigid body by exact rotations: symplectic, second order.

The kinetic energy of an angular momentum $P$ (world) is
$\frac12 P_b\cdot A P_b$ with $P_b = R^T P$ and $A$ the inverse inertia. With the
splitting $A = a\,1 + \sum_k s_k c_k c_k^T$ every part moves the body by a rotation in
closed form. The first is about $P$, at the rate $a|P|$, and commutes with all others.
Part $k$ is about the material axis $c_k$, and leaves $c_k\cdot P_b$ constant. The parts
in order and then in reverse order are symmetric in time, and the world vector $P$ never
changes. A body with two equal moments of inertia, one of them about the first axis,
needs one part and rotates exactly.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    multiply_quaternions,
    normalise,
    rotation_exp,
    to_material,
)
from jaxrod.geometry.vectors import Vec3


def freely_turned(
    orientation: Quaternion,
    momentum: Vec3,
    isotropic: Array | None,
    parts: Sequence[tuple[Array | float, Vec3]],
    dt: Array,
) -> Quaternion:
    """Orientation after a time of free rotation.

    Args:
        orientation: Orientation, material to world.
        momentum: Angular momentum, world frame [kg m^2/s].
        isotropic: Isotropic part $a$ of the inverse inertia [1/(kg m^2)], if any.
        parts: Factors $s_k$ and material vectors $c_k$ of the other parts.
        dt: Time [s].
    """
    if isotropic is not None:
        turn = rotation_exp(vectors.scale(dt * isotropic, momentum))
        orientation = multiply_quaternions(turn, orientation)
    *others, last = parts
    for part in others:
        orientation = _turned(orientation, momentum, part, 0.5 * dt)
    orientation = _turned(orientation, momentum, last, dt)
    for part in reversed(others):
        orientation = _turned(orientation, momentum, part, 0.5 * dt)
    return normalise(orientation)


def _turned(
    orientation: Quaternion,
    momentum: Vec3,
    part: tuple[Array | float, Vec3],
    dt: Array,
) -> Quaternion:
    """Orientation after one part's rotation, about an axis fixed in the body."""
    factor, axis = part
    own = to_material(directors(orientation), momentum)
    rate = factor * vectors.dot(axis, own)
    turn = rotation_exp(vectors.scale(dt * rate, axis))
    return multiply_quaternions(orientation, turn)
