"""Programs made at random: lanes and XLA come to the same numbers."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lanes.programs import difference, logged
from lanes.scenes import forced


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("seed", range(6))
def test_a_random_program_is_the_same(seed, request):
    worst, why = difference(seed, forced())
    if worst is None:
        # Programs for rows have loops of unknown length, which warps leave to XLA.
        assert "warps" in request.node.name and "no loop" in why
    else:
        assert worst <= 1


def test_a_program_that_only_began_has_no_outcome_in_a_log(tmp_path):
    log = tmp_path / "log"
    assert logged(log) == ({}, None)
    log.write_text("rows 3\nrows 3 same\nloops 3 left: no\nrows 4\n")
    assert logged(log) == ({("rows", 3): "same", ("loops", 3): "left: no"}, 4)


@pytest.mark.slow
def test_many_random_programs_are_the_same(record):
    """In a process of their own, by XLA as it is without `configure_cpu`.

    With its fusion XLA's compiler (0.10.1) aborts the process on a few of them.
    """
    root = Path(__file__).parents[2]
    env = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    env["PYTHONPATH"] = os.pathsep.join((str(root / "tests"), str(root)))
    program = [sys.executable, str(root / "tests" / "lanes" / "programs.py")]
    done = subprocess.run(
        [*program, "--first", "1000", "--count", "300", "--mode", forced()],
        env=env,
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    *apart, last = done.stdout.splitlines()
    assert last == "300 programs, 0 differ, 0 left to XLA", (apart, done.stderr[-1000:])
    record(
        f"{forced()}: random programs",
        "XLA; differences beyond rounding, of 300",
        done.returncode,
        at_most=0,
    )
