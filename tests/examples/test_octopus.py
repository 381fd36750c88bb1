"""The octopus of the examples: its arms curl alike, and its momentum stays zero."""

import jax
import numpy as np
import pytest

import jaxrod
from examples.loading import load


@pytest.mark.slow
def test_arms_curl_alike_and_momentum_stays():
    with jax.enable_x64(True):
        example = load("octopus")
        system, state, dt = example.curl(0.6)
        depths = -np.asarray(state["arms"].positions[:, 2, -1])
        assert np.all(depths > 0.05)
        # Eight arms alike: the animal has the symmetry it began with.
        assert np.ptp(depths) < 1e-6 * np.mean(depths)
        mass = float(np.sum(system.members["head"].masses)) + float(
            np.sum(system.members["arms"].rod.linear_density)
            * example.LENGTH
            / example.N_ELEMENTS
        )
        assert np.linalg.norm(system.momentum(state)) < 1e-13 * mass
        assert not jaxrod.health(system.at(0.6), state, dt).flagged


@pytest.mark.slow
def test_its_curled_arms_can_be_at_rest():
    """Nothing holds it, so it is loose; its eight arms are curled alike."""
    with jax.enable_x64(True):
        example = load("octopus")
        system, state = example.octopus()
        still = system.at(1.0)
        # A loose turn that is missed among round-off would take a hundred corrections.
        found = jaxrod.equilibrium(still, state, max_iterations=30)
        assert bool(found.converged) and bool(found.stable) and bool(found.loose)
        # The animal may have turned, so tips are looked at from its head.
        tips = np.asarray(found.state["arms"].positions[:, :, -1])
        head = np.asarray(found.state["head"].positions[:, 0])
        far = np.linalg.norm(tips - head, axis=1)
        assert np.ptp(far) < 1e-6 * np.mean(far)
        assert float(found.force_residual) < 1e-6
