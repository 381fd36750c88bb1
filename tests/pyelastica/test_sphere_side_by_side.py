"""Contact of a rod with a sphere that moves, beside PyElastica's `RodSphereContact`.

PyElastica looks once in every element (from its middle on to half an element beyond
its end); ours acts at points of the rod, per length. On a sphere so large that the rod
lies along it both are one, but for couples: friction turns our sphere, and theirs not.
"""

from dataclasses import replace

import elastica
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.stepping.assembly import seen_at_rest

N, LENGTH, RADIUS, SPHERE = 8, 0.8, 0.05, 1e4
STIFFNESS, DAMPING, FRICTION = 2e5, 300.0, 0.4
DEPTH = 0.3 * RADIUS
START = np.array([-0.5 * LENGTH, 0.0, SPHERE + RADIUS - DEPTH])
OUT = np.array([0.0, 0.0, 1.0])


@jax.jit
def loads_on(system, state, velocities):
    """Loads of contact on the rod and the sphere at velocities of theirs."""
    seen, (contact,) = seen_at_rest(system, state)
    moving = {
        name: replace(
            one,
            motion=replace(
                one.motion,
                velocity=tuple(
                    0 * old + velocity
                    for old, velocity in zip(
                        one.motion.velocity, velocities[name], strict=True
                    )
                ),
            ),
        )
        for name, one in seen.items()
    }
    return contact.loads(moving)


def ours(velocity, of_sphere, drag):
    """Forces on rod and sphere, and the couple on the sphere about its centre."""
    rod, of_rod = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e7,
        start=START,
        direction=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )
    ball, of_ball = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.0, 0.0), SPHERE), density=1.0, dtype=jnp.float64
    )
    state = {"rod": of_rod, "ball": of_ball}
    contact = jaxrod.systems.body_contact(
        "rod",
        "ball",
        stiffness=STIFFNESS,
        damping=DAMPING,
        friction=FRICTION,
        friction_drag=drag,
    )
    system = jaxrod.make_system({"rod": jaxrod.make_scene(rod), "ball": ball}, contact)
    rates = {"rod": jnp.asarray(velocity), "ball": jnp.asarray(of_sphere)}
    loads = loads_on(system, state, rates)
    on_rod, on_ball = (np.stack(loads[name].forces) for name in ("rod", "ball"))
    return on_rod, on_ball[:, 0], np.stack(loads["ball"].couples)[:, 0]


def theirs(velocity, of_sphere, drag):
    """The same in PyElastica."""
    rod = elastica.CosseratRod.straight_rod(
        N,
        START,
        np.array([1.0, 0.0, 0.0]),
        OUT,
        LENGTH,
        RADIUS,
        1000.0,
        youngs_modulus=1e7,
    )
    rod.velocity_collection[:] = np.reshape(velocity, (3, 1))
    ball = elastica.Sphere(np.zeros(3), SPHERE, 1.0)
    ball.velocity_collection[:, 0] = of_sphere
    length = LENGTH / N
    elastica.RodSphereContact(
        k=STIFFNESS * length,
        nu=DAMPING * length,
        # Its friction is that of half of an element.
        velocity_damping_coefficient=0.5 * drag * length,
        friction_coefficient=FRICTION,
    ).apply_contact(rod, ball)
    return rod.external_forces, ball.external_forces[:, 0], ball.external_torques[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "velocity", "of_sphere", "drag"),
    [
        ("at rest", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 500.0),
        ("approaching", (0.0, 0.0, -0.4), (0.0, 0.0, 0.3), 500.0),
        ("sliding", (3.0, -4.0, -0.1), (-1.0, 0.5, 0.0), 1e9),
    ],
)
def test_forces_of_a_rod_along_a_sphere(case, velocity, of_sphere, drag, record):
    mine, on_mine, couple = ours(velocity, of_sphere, drag)
    other, on_other, none = theirs(velocity, of_sphere, drag)
    assert np.max(np.abs(other)) > 100.0
    inner, size = slice(2, -2), np.linalg.norm(on_other)
    # The sphere falls away along the rod, by this part of the depth at its ends.
    falls = (0.5 * LENGTH) ** 2 / (2 * SPHERE) / DEPTH
    for what, one, two in (
        ("inner nodes", mine[:, inner], other[:, inner]),
        ("sphere", on_mine, on_other),
    ):
        record(
            f"Contact with a sphere, {case}: force on {what}",
            "PyElastica 1.0",
            np.max(np.abs(one - two)) / np.max(np.abs(two)),
            at_most=2 * falls,
        )
    # Theirs gives the sphere no couple; ours is that of the force at its surface.
    assert np.all(none == 0)
    np.testing.assert_allclose(
        couple, np.cross(SPHERE * OUT, on_mine), rtol=0, atol=1e-3 * SPHERE * size
    )
