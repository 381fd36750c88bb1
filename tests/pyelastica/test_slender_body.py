"""Slender-body drag beside PyElastica 1.0's, in its own law."""

from dataclasses import replace

import elastica
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm

VISCOSITY, DT, STEPS, N = 40.0, 5e-5, 100, 8


class Simulator(elastica.BaseSystemCollection, elastica.Forcing):
    pass


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(elastica, "SlenderBodyTheory"), reason="PyElastica has no such drag"
)
def test_an_arm_thrown_into_viscous_fluid(record):
    rod, state = arm(N, youngs_modulus=1e6)
    s = np.linspace(0.0, 1.0, N + 1)
    throw = np.stack([3 * s**2, np.sin(3 * s), 0.5 * np.cos(2 * s)])
    scene = jaxrod.make_scene(
        rod, jaxrod.fluids.slender_body_drag(VISCOSITY), method=jaxrod.pyelastica()
    )
    thrown = replace(state, velocities=jnp.asarray(throw))
    end = jaxrod.advance(scene, thrown, DT, STEPS)
    free = jaxrod.advance(replace(scene, effects=()), thrown, DT, STEPS)

    simulator = Simulator()
    theirs = elastica.CosseratRod.straight_rod(
        N,
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0]),
        1.0,
        0.05,
        1000.0,
        youngs_modulus=1e6,
        shear_modulus=1e6 / 3,
    )
    simulator.append(theirs)
    simulator.add_forcing_to(theirs).using(
        elastica.SlenderBodyTheory, dynamic_viscosity=VISCOSITY
    )
    simulator.finalize()
    theirs.velocity_collection[:] = throw
    stepper, time = elastica.PositionVerlet(), np.float64(0.0)
    for _ in range(STEPS):
        time = stepper.step(simulator, time, np.float64(DT))

    # Without drag it would be elsewhere.
    assert np.max(np.abs(free.velocities - end.velocities)) > 0.1
    moved = np.max(np.abs(end.positions - theirs.position_collection))
    faster = np.max(np.abs(end.velocities - theirs.velocity_collection))
    record(
        "Slender-body drag, 100 steps: positions [m]",
        "PyElastica 1.0",
        moved,
        at_most=1e-12,
    )
    record(
        "Slender-body drag, 100 steps: velocities [m/s]",
        "PyElastica 1.0",
        faster,
        at_most=1e-12,
    )
