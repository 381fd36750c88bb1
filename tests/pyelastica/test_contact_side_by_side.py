"""Contact beside PyElastica 1.0's, where the two laws are the same.

PyElastica looks for contact once in every element, at the point next to the cylinder,
and gives the force to both nodes; ours acts at the nodes, per length. An arm along a
cylinder that moves as a whole is where that makes no difference, but at the arm's ends:
there PyElastica shares out the same total in its own way. Its law is another where
elements meet obstacles at an angle, where arms leave (its dashpot pulls), between
sticking and sliding (ours turns smoothly) and in the first hundredth of a radius (ours
has a smooth onset).
"""

from dataclasses import replace

import elastica
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.touching import contact_loads

N, LENGTH, RADIUS = 8, 0.8, 0.05
POST = 0.12  # radius of the cylinder [m]
STIFFNESS, DAMPING, FRICTION, DRAG = 2e5, 300.0, 0.4, 500.0
AXIS, AWAY = np.array([[2.0, -1.0, 2.0], [-4.0, 2.0, 5.0]])
ALONG = AXIS / 3.0
OUT = AWAY / np.linalg.norm(AWAY)  # from the cylinder's axis to the arm's
ACROSS = np.cross(OUT, ALONG)


def both_forces(depth, velocity, friction, drag):
    """Forces on the nodes of an arm beside a cylinder, ours and PyElastica's [N]."""
    start = OUT * (POST + RADIUS - depth)
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e7,
        start=start,
        direction=ALONG,
        normal=OUT,
        dtype=jnp.float64,
    )
    everywhere = jnp.tile(jnp.asarray(velocity)[:, None], N + 1)
    state = replace(state, velocities=everywhere)
    ends = ALONG * -0.5, ALONG * (LENGTH + 0.5)
    ours = jaxrod.contact(
        jaxrod.shapes.cylinder(*ends, POST),
        stiffness=STIFFNESS,
        damping=DAMPING,
        friction=friction,
        friction_drag=drag,
    )
    forces, _ = contact_loads(ours, rod, state)

    length = LENGTH / N
    arm = elastica.CosseratRod.straight_rod(
        N, start, ALONG, OUT, LENGTH, RADIUS, 1000.0, youngs_modulus=1e7
    )
    arm.velocity_collection[:] = np.reshape(velocity, (3, 1))
    post = elastica.Cylinder(ends[0], ALONG, OUT, LENGTH + 1.0, POST, 1000.0)
    elastica.RodCylinderContact(
        k=STIFFNESS * length,
        nu=DAMPING * length,
        # Its friction is that of half of an element.
        velocity_damping_coefficient=0.5 * drag * length,
        friction_coefficient=friction,
    ).apply_contact(arm, post)
    return np.asarray(forces), arm.external_forces


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "velocity", "friction", "drag"),
    [
        ("at rest", 0.0 * OUT, 0.0, DRAG),
        ("approaching", -0.7 * OUT + 2.0 * ALONG, 0.0, DRAG),
        ("sliding", 3.0 * ALONG - 4.0 * ACROSS - 0.1 * OUT, FRICTION, 1e9),
        ("creeping", 3e-5 * ALONG - 4e-5 * ACROSS, FRICTION, DRAG),
    ],
)
def test_forces_of_an_arm_along_a_cylinder(case, velocity, friction, drag, record):
    ours, theirs = both_forces(0.3 * RADIUS, velocity, friction, drag)
    largest = np.max(np.abs(theirs))
    assert largest > 100.0
    inner = slice(2, -2)
    apart = np.max(np.abs(ours[:, inner] - theirs[:, inner])) / largest
    record(f"Contact with a cylinder, {case}", "PyElastica 1.0", apart, at_most=1e-11)
    if case == "creeping":
        # A hundred-thousandth of the force: friction is compared by itself.
        rubs = [(f - np.outer(OUT, OUT @ f))[:, inner] for f in (ours, theirs)]
        np.testing.assert_allclose(*rubs, rtol=1e-5, atol=1e-9)
    totals = ours.sum(axis=1), theirs.sum(axis=1)
    np.testing.assert_allclose(*totals, rtol=0, atol=1e-11 * N * largest)
