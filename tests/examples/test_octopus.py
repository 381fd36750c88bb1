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
