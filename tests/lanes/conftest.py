"""Lanes wherever they can be, in these tests alone."""

import pytest

from jaxrod.lanes.choice import lane_mode, use_lanes
from jaxrod.lanes.llvm.machine_code import not_here
from physics.validation import record as record


@pytest.fixture(autouse=True)
def always():
    """Takes lanes in every run; skips where there are none."""
    if not_here() is not None:
        pytest.skip(not_here())
    before = lane_mode()
    use_lanes("always")
    yield
    use_lanes(before)
