"""A few random systems; `random_systems.py` draws as many as one likes."""

from dataclasses import replace

import numpy as np
import pytest

from systems.random_systems import WIDE, examined, random_structure


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


@pytest.mark.slow
def test_energy_is_kept_unless_rods_are_strained_too_far(record):
    """Masses and moduli over six decades, float64, half of the bound, 2,000 steps.

    Some of these rods are torn or turned round at a joint. `health` flags them, and
    only their energy is wrong.
    """
    structure = random_structure(np.random.default_rng([0, 17]))
    ranges = replace(WIDE, safety=1.0)
    found = examined(structure, 20, 17, ranges, 100, "float64")
    flagged, wrong = found["strains flagged at finer"], found["finer"] > 1e-3
    assert np.all(found["finite at finer"])
    assert np.any(wrong) and np.sum(flagged) < 10
    record(
        "20 random systems of a wide range, float64, half of the bound, those that "
        "health does not flag: drift of energy",
        "0, over the largest kinetic energy",
        np.max(found["finer"][~flagged]),
        at_most=1e-3,
    )
