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
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
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
    """Shear and axial stiffness, per element [N]."""
    joint: Vec3
    """Bend-twist stiffness over joint length, per joint [N m]."""
    rest_strains: Vec3
    """Shear-stretch strain at rest, per element [1]."""
    rest_rotations: Vec3
    """Joint rotation at rest, per joint [rad]."""


def elastic_law(rod: Rod) -> ElasticLaw:
    """Computes the constants of the internal loads."""
    joint_lengths = rod.joint_lengths
    return ElasticLaw(
        inverse_lengths=1 / rod.rest_lengths,
        shear_stretch=vectors.split(rod.shear_stretch_stiffness),
        joint=vectors.split(rod.joint_stiffness / joint_lengths[None, :]),
        rest_strains=vectors.split(rod.rest_strains),
        rest_rotations=vectors.split(rod.rest_curvatures * joint_lengths[None, :]),
    )


def shear_stretch(edges: Vec3, orientation: Quaternion, inverse_lengths: Array) -> Vec3:
    """Shear-stretch strain of each element, material frame [1]."""
    a, b, c = to_material(directors(orientation), edges)
    return a * inverse_lengths, b * inverse_lengths, c * inverse_lengths - 1


def joint_rotations(orientation: Quaternion) -> tuple[Vec3, Array]:
    """Rotation vector [rad] from each element to the next, and its coupling.

    See `rotations.rotation_log_and_coupling` for the coupling coefficient.
    """
    w, x, y, z = orientation
    before = (w[:-1], x[:-1], y[:-1], z[:-1])
    after = (w[1:], x[1:], y[1:], z[1:])
    return rotation_log_and_coupling(multiply_quaternions(conjugate(before), after))


def joint_couples(rotation: Vec3, coupling: Array, moment: Vec3) -> tuple[Vec3, Vec3]:
    r"""Couples of a joint's moment on the two elements it joins.

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
    """Negative gradient of the stored energy.

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
    """Shear-stretch strain and curvature of a state.

    Returns:
        Shear-stretch strain per element, material frame [1] (zero if straight and
        unstretched), and curvature and twist per joint, material frame [1/m].
    """
    check_state(rod, state)
    orientation = split_quaternion(state.orientations)
    edges = vectors.inner_difference(vectors.split(state.positions))
    strain = shear_stretch(edges, orientation, 1 / rod.rest_lengths)
    rotation, _ = joint_rotations(orientation)
    return vectors.join(strain), vectors.join(rotation) / rod.joint_lengths[None, :]


def stored_energy(rod: Rod, state: RodState) -> Float[Array, ""]:
    """Elastic energy of the rod [J]."""
    check_state(rod, state)
    strain, curvature = strains(rod, state)
    strain = strain - rod.rest_strains
    curvature = curvature - rod.rest_curvatures
    shear = 0.5 * jnp.sum(
        rod.rest_lengths[None, :] * rod.shear_stretch_stiffness * strain**2
    )
    bend = 0.5 * jnp.sum(
        rod.joint_lengths[None, :] * rod.joint_stiffness * curvature**2
    )
    return shear + bend
