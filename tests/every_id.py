"""Every id of the tasks as a parameter of a test: one quick to compile, others slow."""

import pytest

from jaxrod.envs.gym import ids

QUICK = "jaxrod/reaching-clean-v0"
assert QUICK in ids()
EVERY_ID = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == QUICK else pytest.mark.slow)
        for name in ids()
    ],
)
