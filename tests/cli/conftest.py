"""A finished run, made once by the command itself."""

import subprocess
import sys

import pytest

from commands import run as run
from commands import run_json as run_json

TINY = ["--steps", "2k", "--num-envs", "8", "--set", "rollout_steps=32"]


@pytest.fixture(scope="session")
def trained(told):
    """The folder of a tiny run, and what the command that made it printed."""
    return told[:2]


@pytest.fixture(scope="session")
def told(tmp_path_factory):
    """The folder of a tiny run, what was printed, and what was said on stderr."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    words = ["train", "trivial", *TINY, "--seed", "3", "--out", str(folder), "--json"]
    # A process of its own, with warnings as errors: JAX must not have started
    # before the CPU settings are made.
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "jaxrod", *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder, done.stdout, done.stderr
