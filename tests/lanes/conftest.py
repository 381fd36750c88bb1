"""Kernels wherever they can be, in these tests alone: of lanes, and of rows."""

import pytest

from jaxrod.lanes import primitives, steps
from jaxrod.lanes.choice import lane_mode, use_lanes
from jaxrod.lanes.llvm.machine_code import not_here
from lanes.scenes import forced
from lanes.warp_machine import lowered_to_threads
from physics.validation import record as record

BY_BOTH = ("runs", "derivatives", "functions", "primitives", "random_programs")
"""Modules whose tests run with lanes and with rows."""
BY_WARPS = ("primitives", "random_programs")
"""Modules whose tests run with warps, too: in threads of the processor."""


def pytest_generate_tests(metafunc):
    """Runs the tests of some modules in both modes."""
    name = metafunc.module.__name__.rpartition("test_")[2]
    if name in BY_BOTH and "always" in metafunc.fixturenames:
        modes = ["always", "loops", "rows", *(["warps"] if name in BY_WARPS else [])]
        metafunc.parametrize("always", modes, indirect=True)


@pytest.fixture(autouse=True)
def always(request, monkeypatch):
    """Takes kernels in every run; skips where there are none."""
    if not_here() is not None:
        pytest.skip(not_here())
    # Tests change what kernels are made of: none takes a program of another.
    steps._programs.clear()
    before = lane_mode()
    mode = getattr(request, "param", "always")
    if mode == "warps":
        mode = "rows"
        monkeypatch.setattr(primitives, "lowered_by_lanes", lowered_to_threads)
    forced(mode)
    yield
    use_lanes(before)
