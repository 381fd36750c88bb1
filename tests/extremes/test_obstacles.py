"""Extreme actions among obstacles: the arm stays out of them."""

import numpy as np
import pytest

from benchmarks.extremes.obstacles import run


@pytest.mark.slow
@pytest.mark.default_precision
def test_extreme_actions_never_push_the_arm_a_radius_into_the_nest(record):
    found = run("unstructured", count=48, seconds=1.0)
    assert found["states_not_finite_after_freezing"] == 0
    assert np.isfinite(found["largest_speed"])
    assert found["deepest_penetration_over_radius"] > 0.01, "nothing was touched"
    record(
        "Deepest overlap in 48 s of extreme actions in the nest, float32, over the "
        "radius",
        "none",
        found["deepest_penetration_over_radius"],
        at_most=1.0,
    )
