"""An octopus arm of three kinds of muscles at rest, beside its sections in balance."""

import jax
import numpy as np
import pytest

import jaxrod
from physics.muscular_arm import LENGTH, arm, as_coomm, at_rest, with_energy

SETTLING, DAMPING = 6.0, 6.0  # [s], [1/s]


@pytest.mark.slow
def test_an_arm_of_muscles_comes_to_rest_where_its_sections_balance(record):
    advance, errors = jax.jit(jaxrod.advance), []
    for n in (50, 100):
        scene, state = arm(n, 1.0, DAMPING)
        dt = float(jaxrod.stable_dt(scene, 0.8).dt)
        found = advance(scene, state, dt, int(SETTLING / dt))
        assert np.max(np.abs(found.velocities)) < 1e-6
        apart = found.positions - at_rest(with_energy, 1.0, n)
        errors.append(float(np.max(np.linalg.norm(apart, axis=0))) / LENGTH)
    # It bends to and fro: this is no straight rod.
    assert found.tip[2] < 0.2 * LENGTH
    record(
        "Octopus arm of muscles at rest, 100 elements: nodes, over its length",
        "balance of each section, integrated",
        errors[1],
        at_most=0.01,
    )
    record(
        "The same: order of convergence, 50 to 100 elements",
        "2",
        float(np.log2(errors[0] / errors[1])),
        between=(1.7, 2.5),
    )


@pytest.mark.slow
def test_what_thinning_sections_change_of_an_arm_of_muscles(record):
    """COOMM's law and a stored energy differ in the second order of the strains."""
    apart = {}
    for share in (1.0, 0.1):
        one, two = (at_rest(law, share, 50) for law in (with_energy, as_coomm))
        apart[share] = float(np.max(np.linalg.norm(one - two, axis=0))) / LENGTH
    for share, bar in ((1.0, 0.06), (0.1, 0.01)):
        record(
            f"Octopus arm, {share:g} of its activations: stored energy, compared "
            "with COOMM",
            "COOMM's law; 0 for small strains",
            apart[share],
            at_most=bar,
        )
