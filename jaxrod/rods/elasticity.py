r"""The consistent elastic law: strains, stored energy, internal loads.

With $\Delta x$ an element's edge vector, $\hat\ell$ its rest length, $R$ its
orientation and $\phi$ the rotation vector of a joint of rest length $\hat D$,

$$\sigma = R^T \Delta x / \hat\ell - e_3, \qquad \kappa = \phi / \hat D,$$
$$W = \tfrac12 \sum \hat\ell\, (\sigma-\sigma_0)\cdot S(\sigma-\sigma_0)
    + \tfrac12 \sum \hat D\, (\kappa-\kappa_0)\cdot B(\kappa-\kappa_0).$$

Internal loads are the exact negative gradient of $W$, in closed form. The discrete rod
therefore conserves energy (to the order of the integrator), and momentum and angular
momentum (to round-off). It stays bounded under loads that make laws without a potential
diverge.

The tangent stiffness of this law is also in closed form, block by block. It is the
derivative of the negative internal loads when nodes are displaced and elements rotated
by $\psi$ ($R \to e^{[\psi]} R$). Everything is in the world frame, where each element
and each joint has a single force or couple, of opposite sign on its two sides.

An element with edge $e$ pulls its nodes together with the force $N$. $D$ is its
stiffness divided by its length, rotated into the world frame:

$$\delta N = D\,\delta e + K\psi, \quad K = D[e]_\times - [N]_\times, \qquad
  \delta(N\times e) = K^T\delta e - [e]_\times K\psi.$$

A joint of rotation vector $\phi$ and torque $\tau = B\phi$ (world frame, at rest
$\phi = 0$) has the couple $\mu = J^{-T}\tau$ with $J^{-1} = 1 + \frac12[\phi]_\times
+ c[\phi]_\times^2$, and

$$\delta\mu = H(\psi_\text{after} - \psi_\text{before}) - [\mu]_\times\psi_\text{after},
  \quad H = (J^{-T}B + \partial(J^{-T}\tau)/\partial\phi|_\tau)\,J^{-1}.$$
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import (
    Matrix,
    add,
    cross_rows,
    outer,
    scale,
    scaled_identity,
    skew,
    subtract,
    transpose,
    turned_diagonal,
)
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
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState, check_state
from jaxrod.structure import pytree


@pytree
class ElasticLaw:
    """Constants of the internal loads of a rod, computed once per call."""

    inverse_lengths: Array
    """Inverse rest length, per element [1/m]."""
    shear_stretch: Vec3
    """Shear stiffness along d1, d2 and axial stiffness along d3, per element [N]."""
    joint: Vec3
    """Bend-twist stiffness divided by joint length, per joint [N m]."""
    rest_strains: Vec3
    """Shear-stretch strain at rest, per element [1]."""
    rest_rotations: Vec3
    """Joint rotation vector at rest, per joint [rad]."""


def elastic_law(rod: Rod) -> ElasticLaw:
    """Constants of the internal loads of a rod."""
    joint_lengths = rod.joint_lengths
    return ElasticLaw(
        inverse_lengths=1 / rod.rest_lengths,
        shear_stretch=vectors.split(rod.shear_stretch_stiffness),
        joint=vectors.split(rod.joint_stiffness / joint_lengths[None, :]),
        rest_strains=vectors.split(rod.rest_strains),
        rest_rotations=vectors.split(rod.rest_curvatures * joint_lengths[None, :]),
    )


def shear_stretch(edges: Vec3, orientation: Quaternion, inverse_lengths: Array) -> Vec3:
    """Shear-stretch strain of each element, `R^T e / l - e3`, material frame [1].

    `e` is the edge, `1 / l` the inverse rest length, `R` the orientation.
    """
    a, b, c = to_material(directors(orientation), edges)
    return a * inverse_lengths, b * inverse_lengths, c * inverse_lengths - 1


def joint_rotations(orientation: Quaternion) -> tuple[Vec3, Array]:
    """Rotation vector from each element to the next [rad], and coupling coefficient.

    See `rotations.rotation_log_and_coupling` for the coefficient.
    """
    w, x, y, z = orientation
    before = (w[:-1], x[:-1], y[:-1], z[:-1])
    after = (w[1:], x[1:], y[1:], z[1:])
    return rotation_log_and_coupling(multiply_quaternions(conjugate(before), after))


def joint_couples(rotation: Vec3, coupling: Array, moment: Vec3) -> tuple[Vec3, Vec3]:
    r"""Couples of a joint's moment on the two elements it joins.

    `rotation` is $\phi$, `moment` is $\tau$ and `coupling` is $c$
    (`rotations.rotation_log_and_coupling`).
    For the energy $E(\phi)$ with $\tau = \partial E/\partial\phi$ the couple on the
    element before is $a + b$, on the element after $-a + b$, each in its own
    material frame, with $a = \tau + c\,\phi\times(\phi\times\tau)$ and
    $b = \frac12\phi\times\tau$.

    Returns:
        The odd part `a` and the even part `b` [N m].
    """
    turned = vectors.cross(rotation, moment)
    correction = vectors.scale(coupling, vectors.cross(rotation, turned))
    return vectors.add(moment, correction), vectors.scale(0.5, turned)


def internal_loads(law: ElasticLaw, motion: Motion) -> Loads:
    """Internal loads of a rod: the negative gradient of its stored energy.

    Returns:
        Forces on nodes (world frame) [N], couples on elements (material frame) [N m].
    """
    frame = directors(motion.orientation)
    local = to_material(frame, motion.edges)
    inverse = law.inverse_lengths
    strain = (local[0] * inverse, local[1] * inverse, local[2] * inverse - 1)
    stress = vectors.multiply(
        law.shear_stretch, vectors.subtract(strain, law.rest_strains)
    )
    rotation, coupling = joint_rotations(motion.orientation)
    moment = vectors.multiply(law.joint, vectors.subtract(rotation, law.rest_rotations))
    odd, even = joint_couples(rotation, coupling, moment)
    couples = vectors.add(vectors.difference(odd), vectors.pair_sum(even))
    return Loads(
        forces=vectors.difference(to_world(frame, stress)),
        couples=vectors.add(couples, vectors.cross(local, stress)),
    )


def strains(
    rod: Rod, state: RodState
) -> tuple[Float[Array, "3 n"], Float[Array, "3 n-1"]]:
    """Shear-stretch strain, and curvature and twist, of a rod in a state.

    Returns:
        Shear-stretch strain per element, material frame [1] (zero if straight and
        unstretched), and curvature and twist per joint, material frame [1/m].

    Raises:
        ValueError: If the state does not match that rod.
        TypeError: If `rod` or `state` has the wrong type.

    Example:
        >>> longer = replace(state, positions=1.01 * state.positions)
        >>> strain, curvature = jaxrod.strains(rod, longer)
        >>> strain.shape, curvature.shape
        ((3, 10), (3, 9))
        >>> round(float(strain[2, 0]), 4)
        0.01
    """
    check_state(rod, state)
    return _strains(rod, state)


@jax.jit
def _strains(rod: Rod, state: RodState) -> tuple[Array, Array]:
    orientation = split_quaternion(state.orientations)
    edges = vectors.inner_difference(vectors.split(state.positions))
    strain = shear_stretch(edges, orientation, 1 / rod.rest_lengths)
    rotation, _ = joint_rotations(orientation)
    return vectors.join(strain), vectors.join(rotation) / rod.joint_lengths[None, :]


def stored_energy(rod: Rod, state: RodState) -> Float[Array, ""]:
    """Elastic energy of a rod: shear and stretch of elements, bending and twist [J].

    Raises:
        ValueError: If the state does not match that rod.
        TypeError: If `rod` or `state` has the wrong type.

    Example:
        >>> float(jaxrod.stored_energy(rod, state)) < 1e-9
        True
        >>> longer = replace(state, positions=1.01 * state.positions)
        >>> round(float(jaxrod.stored_energy(rod, longer)), 4)  # E A strain^2 L / 2 [J]
        0.0628
    """
    check_state(rod, state)
    return _stored_energy(rod, state)


@jax.jit
def _stored_energy(rod: Rod, state: RodState) -> Array:
    strain, curvature = _strains(rod, state)
    strain = strain - rod.rest_strains
    curvature = curvature - rod.rest_curvatures
    shear = 0.5 * jnp.sum(
        rod.rest_lengths[None, :] * rod.shear_stretch_stiffness * strain**2
    )
    bend = 0.5 * jnp.sum(
        rod.joint_lengths[None, :] * rod.joint_stiffness * curvature**2
    )
    return shear + bend


@pytree
class ElementTangent:
    """Derivatives of each element's force N and couple N x e, world frame."""

    stretching: Matrix
    """Derivative $D$ of the force $N$ in the element with respect to its edge [N/m]."""
    coupling: Matrix
    """Derivative $K$ of the force $N$ with respect to the element's rotation [N]."""
    turning: Matrix
    r"""Derivative $-[e]_\times K$ of the couple $N\times e$ with respect to the
    rotation [N m]."""


@pytree
class JointTangent:
    """Couple of each joint of a rod and its derivative, world frame."""

    stiffness: Matrix
    r"""Derivative $H$ of the couple $\mu$ with respect to the relative rotation
    [N m]."""
    couple: Vec3
    r"""Couple $\mu$ of the joint, which turns with the element after it [N m]."""


def element_tangent(law: ElasticLaw, motion: Motion) -> ElementTangent:
    """Derivatives of each element's force and couple, for its edge and rotation."""
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
    """Couple of each joint, and its derivative for the joint's relative rotation."""
    rotation, coupling = joint_rotations(motion.orientation)
    w, x, y, z = motion.orientation
    after = (w[1:], x[1:], y[1:], z[1:])
    moment = vectors.multiply(law.joint, vectors.subtract(rotation, law.rest_rotations))
    return turned_joint(after, rotation, coupling, law.joint, moment)


def turned_joint(
    after: Quaternion, rotation: Vec3, coupling: Array, stiffness: Vec3, moment: Vec3
) -> JointTangent:
    """Tangent stiffness of a joint, world frame.

    Args:
        after: Orientation of the element after the joint. The vectors below are in the
            material frame of that element.
        rotation: Rotation vector of the joint [rad].
        coupling: Coupling coefficient, see `rotations.rotation_log_and_coupling`.
        stiffness: Bend-twist stiffness divided by joint length [N m].
        moment: Derivative of the joint's energy with respect to its rotation vector
            [N m].
    """
    frame = directors(after)
    phi, tau = to_world(frame, rotation), to_world(frame, moment)
    bent = vectors.cross(phi, tau)
    twice = vectors.cross(phi, bent)
    couple = vectors.add(
        vectors.add(tau, vectors.scale(-0.5, bent)), vectors.scale(coupling, twice)
    )
    # d(J^-T tau)/dphi at fixed tau: terms of phi x tau, of phi x (phi x tau), and of c.
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
    r"""Product of a matrix and $J^{-1} = 1 + \frac12[\phi]_\times + c[\phi]_\times^2$.

    $J^{-1}$ is the derivative of a rotation vector when a further rotation follows, in
    the frame after it: $\log(e^{\phi} e^{\psi}) = \phi + J^{-1}\psi + O(\psi^2)$.
    """

    def one(row: Vec3) -> Vec3:
        once = vectors.cross(row, rotation)
        twice = vectors.scale(coupling, vectors.cross(once, rotation))
        return vectors.add(row, vectors.add(vectors.scale(0.5, once), twice))

    return one(matrix[0]), one(matrix[1]), one(matrix[2])


def _coupling_slope(squared_angle: Array, coupling: Array) -> Array:
    r"""Derivative of the coupling coefficient with respect to the squared angle.

    The closed form loses digits as $\epsilon/\theta^2$, but is multiplied by
    $\theta^3$. The series is used where even that error would matter.
    """
    small = squared_angle < 1e-3
    series = 1 / 720 + squared_angle / 15120
    safe = jnp.where(small, 1, squared_angle)
    closed = (1 - 12 * coupling + 4 * coupling * coupling * safe) / (8 * safe)
    return jnp.where(small, series, closed)
