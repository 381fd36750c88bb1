r"""Rotations as unit quaternions: exponential, logarithm, frames.

A quaternion $q = (w, x, y, z)$ maps material components to world components,
$v_\mathrm{world} = q\, v_\mathrm{material}\, q^*$. In PyElastica's notation its
rotation matrix is $Q^T$: the directors $d_1, d_2, d_3$ are the matrix's columns.

Exponential and logarithm are evaluated by polynomials in squares. There is no square
root of zero, no division by an angle and no branch, so automatic differentiation has no
singularity at the straight rod at rest.

Free rotation of a rigid body is a sequence of exact rotations: symplectic, second
order.

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

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3, dot, scale

Quaternion = tuple[Array, Array, Array, Array]
"""A field of quaternions, as the arrays of w, x, y and z components."""

# Chebyshev interpolants, written as polynomials in u = tan(theta/8)^2, which covers
# every joint angle from 0 to pi as u runs from 0 to 0.172:
#   atan(sqrt u) / sqrt u           relative error 7e-10 (degree 5), 5e-20 (degree 12)
#   (1 - (t/2) cot(t/2)) / t^2,  t = 8 atan(sqrt u)          2e-8,          1e-17
_ATAN_SINGLE = (
    0.9999999993712282,
    -0.33333306893048514,
    0.19998183041083206,
    -0.14239532669648974,
    0.10569828806414448,
    -0.06026305227658459,
)
_ATAN_DOUBLE = (
    1.0,
    -0.33333333333333326,
    0.19999999999997015,
    -0.1428571428532971,
    0.11111111085322109,
    -0.09090908059031191,
    0.07692281099937744,
    -0.06666205259976526,
    0.05876834004614161,
    -0.05217312574061591,
    0.04499500728984032,
    -0.03338782450121195,
    0.015113765096600925,
)
_COUPLING_SINGLE = (
    0.08333333161961404,
    0.0888896063198832,
    0.07614229722934435,
    0.08271958106603673,
    0.06573262919711573,
    0.13880859371963714,
)
_COUPLING_DOUBLE = (
    0.08333333333333333,
    0.08888888888888717,
    0.07619047619103696,
    0.08155202814712977,
    0.07822564740289835,
    0.08058588550713681,
    0.07878776607404814,
    0.08014902205173824,
    0.07991587012208509,
    0.07323473600504803,
    0.11390451090234865,
    -0.03000161688187721,
    0.2626840495356016,
)
# Half-angles beyond this (rotations by more than a whole turn per step) saturate.
_LARGEST_HALF_ANGLE_SQUARED = math.pi**2


def _polynomial(u: Array, coefficients: tuple[float, ...]) -> Array:
    total = coefficients[-1] * u + coefficients[-2]
    for coefficient in reversed(coefficients[:-2]):
        total = total * u + coefficient
    return total


def _is_single(a: Array) -> bool:
    return jnp.finfo(a.dtype).bits <= 32


def arctangent_ratio(u: Array) -> Array:
    r"""Ratio $\arctan(\sqrt u)/\sqrt u$, for u up to $\tan^2(\pi/8)$."""
    return _polynomial(u, _ATAN_SINGLE if _is_single(u) else _ATAN_DOUBLE)


def split_quaternion(stacked: Float[Array, "4 n"]) -> Quaternion:
    """Splits a component-first array of quaternions into its components."""
    return stacked[0], stacked[1], stacked[2], stacked[3]


def join_quaternion(q: Quaternion) -> Float[Array, "4 n"]:
    """Stacks quaternion components, component axis first."""
    return jnp.stack(q)


def multiply_quaternions(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product `a b`: rotation by `b`, then by `a`."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def conjugate(q: Quaternion) -> Quaternion:
    """Conjugate (w, -x, -y, -z): the inverse rotation of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def normalise(q: Quaternion) -> Quaternion:
    """Quaternion scaled to unit norm."""
    inverse = lax.rsqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse


def sine_ratio_and_cosine(squared_angle: Array) -> tuple[Array, Array]:
    r"""Functions $\sin(a)/a$ and $\cos(a)$ of $a^2$, both entire.

    Two Taylor polynomials at $a/2$ followed by one angle doubling: exact to
    round-off for $|a| \le \pi$, constant beyond.
    """
    terms = 6 if _is_single(squared_angle) else 10
    u = 0.25 * jnp.minimum(squared_angle, _LARGEST_HALF_ANGLE_SQUARED)
    sines = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(terms))
    # 1 - cos instead of cos: the doubling then keeps full relative accuracy.
    versines = tuple((-1) ** k / math.factorial(2 * k + 2) for k in range(terms))
    sine_ratio = _polynomial(u, sines)
    versine = u * _polynomial(u, versines)
    return sine_ratio * (1 - versine), 1 - 2 * versine * (2 - versine)


def rotation_exp(rotation: Vec3) -> Quaternion:
    """Quaternion of a rotation vector [rad].

    Exact to round-off for rotations up to a whole turn.
    """
    half = scale(0.5, rotation)
    sine_ratio, cosine = sine_ratio_and_cosine(dot(half, half))
    return (cosine, *scale(sine_ratio, half))


def rotation_log(q: Quaternion) -> Vec3:
    """Rotation vector [rad] of a unit quaternion, of length 0 to pi."""
    rotation, _ = rotation_log_and_coupling(q)
    return rotation


def rotation_log_and_coupling(q: Quaternion) -> tuple[Vec3, Array]:
    r"""Rotation vector $\phi$ of a unit quaternion, and the coupling coefficient.

    With $v$ the vector part and $w \ge 0$ after choosing the sign,
    $\phi = 8\, k\, a(u)\, v$ where $k = \tan(\theta/8)/|v|$ needs one square root
    of a number between 1/2 and 1, $u = k^2 |v|^2$, $a(u) = \arctan(\sqrt u)/\sqrt u$.

    The coupling coefficient $c = (1 - \frac\theta2\cot\frac\theta2)/\theta^2$ enters
    the exact gradient of a joint energy. With $\tau = \partial E/\partial\phi$ the
    couple on the element before the joint is
    $\tau + \frac12\phi\times\tau + c\,\phi\times(\phi\times\tau)$ in its own frame,
    and that on the element after it
    $-\tau + \frac12\phi\times\tau - c\,\phi\times(\phi\times\tau)$.

    Returns:
        The rotation vector [rad] and `c` [1].
    """
    sign = 1 - 2 * (q[0] < 0).astype(q[0].dtype)
    w = sign * q[0]
    v = scale(sign, (q[1], q[2], q[3]))
    quarter_cosine = jnp.sqrt(0.5 * (1 + w))
    k = quarter_cosine / ((1 + w) * (1 + quarter_cosine))
    u = dot(v, v) * k * k
    coupling = _polynomial(u, _COUPLING_SINGLE if _is_single(w) else _COUPLING_DOUBLE)
    return scale(8 * k * arctangent_ratio(u), v), coupling


def directors(q: Quaternion) -> tuple[Vec3, Vec3, Vec3]:
    """World components of the material axes d1, d2, d3."""
    w, x, y, z = q
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return (
        (1 - (yy + zz), xy + wz, xz - wy),
        (xy - wz, 1 - (xx + zz), yz + wx),
        (xz + wy, yz - wx, 1 - (xx + yy)),
    )


def to_material(frame: tuple[Vec3, Vec3, Vec3], world: Vec3) -> Vec3:
    """Material components of a world vector; `frame` has the directors d1, d2, d3."""
    return dot(frame[0], world), dot(frame[1], world), dot(frame[2], world)


def to_world(frame: tuple[Vec3, Vec3, Vec3], material: Vec3) -> Vec3:
    """World components of a material vector; `frame` has the directors d1, d2, d3."""
    d1, d2, d3 = frame
    a, b, c = material
    return (
        d1[0] * a + d2[0] * b + d3[0] * c,
        d1[1] * a + d2[1] * b + d3[1] * c,
        d1[2] * a + d2[2] * b + d3[2] * c,
    )


def directors_from_orientations(
    orientations: Float[Array, "*batch 4 n"],
) -> Float[Array, "*batch 3 3 n"]:
    """Director matrices: `[..., i, j, :]` is world component j of director i.

    For one rod this is the layout of PyElastica's `director_collection`; for a batch or
    a rollout there is one matrix per state.
    """
    w, x, y, z = (orientations[..., component, :] for component in range(4))
    frame = directors((w, x, y, z))
    return jnp.stack([jnp.stack(d, axis=-2) for d in frame], axis=-3)


def freely_turned(
    orientation: Quaternion,
    momentum: Vec3,
    isotropic: Array | None,
    parts: Sequence[tuple[Array | float, Vec3]],
    dt: Array,
) -> Quaternion:
    """Orientation of a rigid body after free rotation for a time, by the splitting.

    Args:
        orientation: Orientation, material to world.
        momentum: Angular momentum, world frame [kg m^2/s].
        isotropic: Isotropic part $a$ of the inverse inertia [1/(kg m^2)], or `None`.
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
    """Orientation after rotation for `dt` at the angular velocity s (c . P) c.

    `part` is (s, c); c and the angular momentum P are in body axes, `momentum` in the
    world frame.
    """
    factor, axis = part
    own = to_material(directors(orientation), momentum)
    rate = factor * vectors.dot(axis, own)
    turn = rotation_exp(vectors.scale(dt * rate, axis))
    return multiply_quaternions(orientation, turn)
