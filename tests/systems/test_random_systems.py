"""A few random systems; `random_systems.py` draws as many as one likes."""

import numpy as np
import pytest

from systems.random_systems import examined, random_structure


@pytest.mark.slow
@pytest.mark.parametrize("number", range(3))
def test_random_systems_stay_finite_and_make_no_energy(number, record):
    """In float32, half at the step of `stable_dt` and half at half of it."""
    structure = random_structure(np.random.default_rng([0, number]))
    found = examined(structure, 8, number)
    assert np.all(found["finite at drift"]) and np.all(found["finite at finer"])
    words, figure = "gain" if structure.loses else "drift", "finer"
    figure = f"{figure} gain" if structure.loses else figure
    record(
        f"8 random systems of structure {number}, float32, half the step of stable_dt: "
        f"{words} of energy",
        "0, over the largest kinetic energy",
        np.max(found[figure]),
        at_most=1e-3,
    )
