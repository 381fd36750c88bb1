r"""The elastic law's tangent stiffness, in closed form, block by block.

How minus the internal loads change when nodes are displaced and elements turned by
$\psi$ ($R \to e^{[\psi]} R$), everything in the world frame, where each element and
each joint has just one force or couple, of opposite sign on its two sides.

An element of edge $e$ pulls its nodes together with $N$; with $D$ its stiffness over
its length, turned into the world frame,

$$\delta N = D\,\delta e + K\psi, \quad K = D[e]_\times - [N]_\times, \qquad
  \delta(N\times e) = K^T\delta e - [e]_\times K\psi.$$

A joint of rotation vector $\phi$ and torque $\tau = B\phi$ (world frame, at rest
$\phi = 0$) has the couple $\mu = J^{-T}\tau$ with $J^{-1} = 1 + \frac12[\phi]_\times
+ c[\phi]_\times^2$, and

$$\delta\mu = H(\psi_\text{after} - \psi_\text{before}) - [\mu]_\times\psi_\text{after},
  \quad H = (J^{-T}B + \partial(J^{-T}\tau)/\partial\phi|_\tau)\,J^{-1}.$$
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import vectors
from jaxrod._pytree import pytree
from jaxrod.block_tridiagonal import BlockTridiagonal
from jaxrod.elasticity import ElasticLaw, joint_rotations
from jaxrod.motion import Motion
from jaxrod.rotations import Quaternion, directors, to_material, to_world
from jaxrod.vectors import Vec3

Matrix = tuple[Vec3, Vec3, Vec3]
"""A field of 3 by 3 matrices: its rows."""


@pytree
class ElementTangent:
    """What an element of a rod contributes."""

    stretching: Matrix
    """`D`: of the pull by the edge."""
    coupling: Matrix
    """`K`: of the pull by the turn."""
    turning: Matrix
    """Of the couple by the turn."""


@pytree
class JointTangent:
    """What a joint contributes."""

    stiffness: Matrix
    """`H`: of the couple by the relative turn."""
    couple: Vec3
    """The couple [N m]: it turns with the element after the joint."""


def element_tangent(law: ElasticLaw, motion: Motion) -> ElementTangent:
    """The tangent of the shear-stretch energy, per element."""
    frame = directors(motion.orientation)
    edges, inverse = motion.edges, law.inverse_lengths
    local = to_material(frame, edges)
    strain = (local[0] * inverse, local[1] * inverse, local[2] * inverse - 1)
    stress = vectors.multiply(
        law.shear_stretch, vectors.subtract(strain, law.rest_strains)
    )
    stretching = turned_diagonal(frame, vectors.scale(inverse, law.shear_stretch))
    coupling = subtract(cross_rows(stretching, edges), skew(to_world(frame, stress)))
    turning = transpose(cross_rows(transpose(coupling), edges))
    return ElementTangent(stretching, coupling, turning)


def joint_tangent(law: ElasticLaw, motion: Motion) -> JointTangent:
    """The tangent of the bend-twist energy, per joint."""
    rotation, coupling = joint_rotations(motion.orientation)
    w, x, y, z = motion.orientation
    after = (w[1:], x[1:], y[1:], z[1:])
    moment = vectors.multiply(law.joint, vectors.subtract(rotation, law.rest_rotations))
    return turned_joint(after, rotation, coupling, law.joint, moment)


def turned_joint(
    after: Quaternion, rotation: Vec3, coupling: Array, stiffness: Vec3, moment: Vec3
) -> JointTangent:
    """The tangent of a joint, given its state in the material frame after it.

    Args:
        after: Orientation of the element after the joint.
        rotation: Rotation vector of the joint [rad].
        coupling: Its coupling coefficient, see `rotations.rotation_log_and_coupling`.
        stiffness: Bend-twist stiffness over joint length [N m].
        moment: Derivative of the joint's energy by its rotation vector [N m].
    """
    frame = directors(after)
    phi, tau = to_world(frame, rotation), to_world(frame, moment)
    bent = vectors.cross(phi, tau)
    twice = vectors.cross(phi, bent)
    couple = vectors.add(
        vectors.add(tau, vectors.scale(-0.5, bent)), vectors.scale(coupling, twice)
    )
    # d(J^-T tau)/dphi at fixed tau: of phi x tau, of phi x (phi x tau), of c.
    slope = 2 * _coupling_slope(vectors.dot(phi, phi), coupling)
    aligned = vectors.dot(phi, tau)
    bending = add(skew(bent), subtract(outer(tau, phi), scaled_identity(aligned)))
    change = add(
        scale(0.5, skew(tau)),
        subtract(scale(slope, outer(twice, phi)), scale(coupling, bending)),
    )
    turned = turned_diagonal(frame, stiffness)
    by_rotation = add(transpose(times_inverse(turned, phi, coupling)), change)
    return JointTangent(times_inverse(by_rotation, phi, coupling), couple)


def times_inverse(matrix: Matrix, rotation: Vec3, coupling: Array) -> Matrix:
    r"""A matrix times $J^{-1} = 1 + \frac12[\phi]_\times + c[\phi]_\times^2$.

    This is how a rotation vector changes when its rotation is turned on, in the frame
    it leads to: $\log(e^{\phi} e^{\psi}) = \phi + J^{-1}\psi + O(\psi^2)$.
    """

    def one(row: Vec3) -> Vec3:
        once = vectors.cross(row, rotation)
        twice = vectors.scale(coupling, vectors.cross(once, rotation))
        return vectors.add(row, vectors.add(vectors.scale(0.5, once), twice))

    return one(matrix[0]), one(matrix[1]), one(matrix[2])


def _coupling_slope(squared_angle: Array, coupling: Array) -> Array:
    r"""Derivative of the coupling coefficient by the square of the angle.

    The closed form loses digits as $\epsilon/\theta^2$, but is multiplied by
    $\theta^3$; the series takes over where even that would be felt.
    """
    small = squared_angle < 1e-3
    series = 1 / 720 + squared_angle / 15120
    safe = jnp.where(small, 1, squared_angle)
    closed = (1 - 12 * coupling + 4 * coupling * coupling * safe) / (8 * safe)
    return jnp.where(small, series, closed)


def skew(a: Vec3) -> Matrix:
    """The matrix whose product with a vector is the vector product with `a`."""
    zero = jnp.zeros_like(a[0])
    return (zero, -a[2], a[1]), (a[2], zero, -a[0]), (-a[1], a[0], zero)


def outer(a: Vec3, b: Vec3) -> Matrix:
    """The matrix of the products of components."""
    return vectors.scale(a[0], b), vectors.scale(a[1], b), vectors.scale(a[2], b)


def scaled_identity(a: Array) -> Matrix:
    """The identity times a scalar field."""
    zero = jnp.zeros_like(a)
    return (a, zero, zero), (zero, a, zero), (zero, zero, a)


def turned_diagonal(frame: tuple[Vec3, Vec3, Vec3], entries: Vec3) -> Matrix:
    """World components of a matrix that is diagonal in the material frame."""
    one, two, three = (
        outer(vectors.scale(entry, axis), axis)
        for axis, entry in zip(frame, entries, strict=True)
    )
    return add(add(one, two), three)


def cross_rows(matrix: Matrix, a: Vec3) -> Matrix:
    """The product with `skew(a)` on the right: each row's vector product with `a`."""
    return (
        vectors.cross(matrix[0], a),
        vectors.cross(matrix[1], a),
        vectors.cross(matrix[2], a),
    )


def transpose(a: Matrix) -> Matrix:
    """Rows become columns."""
    x, y, z = zip(*a, strict=True)
    return x, y, z


def add(a: Matrix, b: Matrix) -> Matrix:
    """Sum."""
    return vectors.add(a[0], b[0]), vectors.add(a[1], b[1]), vectors.add(a[2], b[2])


def subtract(a: Matrix, b: Matrix) -> Matrix:
    """Difference."""
    return add(a, scale(-1, b))


def scale(factor: Array | float, a: Matrix) -> Matrix:
    """Product with a scalar field."""
    return (
        vectors.scale(factor, a[0]),
        vectors.scale(factor, a[1]),
        vectors.scale(factor, a[2]),
    )


def stacked(matrix: Matrix) -> Float[Array, "entries 3 3"]:
    """The matrices as one array."""
    entries = jnp.stack([entry for row in matrix for entry in row], axis=-1)
    return entries.reshape(-1, 3, 3)


def assembled(
    element: ElementTangent, joint: JointTangent, masses: Array, turning: Matrix
) -> BlockTridiagonal:
    """The matrix of the whole rod.

    Block `k` is node `k` (its displacement) and element `k` (its turn); the last node
    has no element, and zeros in its place.

    Args:
        element: Of the elements.
        joint: Of the joints.
        masses: To add on the diagonal of the nodes, `(n + 1,)`.
        turning: To add to the elements' own blocks.
    """
    bend = stacked(joint.stiffness)
    carried = bend - stacked(skew(joint.couple))
    stretch, couple = stacked(element.stretching), stacked(element.coupling)
    own = stacked(add(element.turning, turning))
    own = _placed(own, 0, 1) + _placed(bend, 0, 2) + _placed(carried, 1, 1)
    before, after = _placed(stretch, 1, 0), _placed(stretch, 0, 1)
    nodes = before + after + stacked(scaled_identity(masses))
    couple_after, none = _placed(couple, 0, 1), jnp.zeros_like(nodes)
    couple_transposed = jnp.swapaxes(couple_after, 1, 2)
    return BlockTridiagonal(
        lower=_quarters(-before, _placed(couple, 1, 0), none, _placed(-bend, 1, 1)),
        diagonal=_quarters(nodes, -couple_after, -couple_transposed, own),
        upper=_quarters(-after, none, couple_transposed, _placed(-carried, 0, 2)),
    )


def _placed(blocks: Array, before: int, after: int) -> Array:
    """Blocks with zeros put at the ends of the chain."""
    return jnp.pad(blocks, ((before, after), (0, 0), (0, 0)))


def _quarters(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Blocks of 6 by 6 from their quarters."""
    return jnp.concatenate(
        [jnp.concatenate([a, b], axis=2), jnp.concatenate([c, d], axis=2)], axis=1
    )
