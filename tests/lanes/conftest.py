"""Kernels wherever they can be, in these tests alone: of lanes, and of rows."""

import pytest

from jaxrod.lanes.choice import lane_mode, use_lanes
from jaxrod.lanes.llvm.machine_code import not_here
from lanes.scenes import forced
from physics.validation import record as record

BY_BOTH = ("runs", "derivatives", "functions", "primitives", "random_programs")
"""Modules whose tests run with lanes and with rows."""


def pytest_generate_tests(metafunc):
    """Runs the tests of some modules in both modes."""
    name = metafunc.module.__name__.rpartition("test_")[2]
    if name in BY_BOTH and "always" in metafunc.fixturenames:
        metafunc.parametrize("always", ["always", "rows"], indirect=True)


@pytest.fixture(autouse=True)
def always(request):
    """Takes kernels in every run; skips where there are none."""
    if not_here() is not None:
        pytest.skip(not_here())
    before = lane_mode()
    forced(getattr(request, "param", "always"))
    yield
    use_lanes(before)
