"""C programs of jaxrod's laws make jaxrod's steps, and list the same neighbours."""

import platform
import shutil
from dataclasses import replace

import pytest

from benchmarks.c_programs.run import Problem
from benchmarks.c_programs.scenes import SCENES, rods

STEPS = 34
"""Steps with two searches for neighbours where lists are rebuilt every 32."""
COMPARED = {"rod": rods(20), **SCENES}
SLOW = ("line", "rod", "crossing", "coil", "plectoneme")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    if shutil.which("cc") is None or platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("no C compiler is installed for x86")
    return tmp_path_factory.mktemp("programs")


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
        for name in COMPARED
    ],
)
def test_a_c_program_makes_the_same_steps(name, folder):
    problem = Problem.of(COMPARED[name], "float64")
    there = problem.in_c(problem.program(256, folder), STEPS)
    ended = problem.jaxrods(problem.model)(STEPS)
    assert problem.apart(ended, there) < 1e-12
    if name != "joint":
        return
    # A comparison that accepts everything would prove nothing.
    other = replace(problem, constants=problem.constants * (1 + 1e-6))
    with pytest.raises(FloatingPointError, match="jaxrod and C differ by"):
        problem.apart(ended, other.in_c(problem.program(256, folder), STEPS))
