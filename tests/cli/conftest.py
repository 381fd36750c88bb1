"""A finished run, made once by the command itself, and a way to call commands."""

import json
import subprocess
import sys

import pytest

import jaxrod
from jaxrod import cli

TINY = ["--steps", "2k", "--num-envs", "8", "--set", "rollout_steps=32"]


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The folder of a tiny run, and what the command that made it printed."""
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
    return folder, done.stdout


@pytest.fixture
def run(monkeypatch, capsys):
    """Calls a command in this process: exit code, stdout and stderr."""
    # JAX has long started here, too late for CPU settings.
    monkeypatch.setattr(jaxrod, "configure_cpu", lambda devices=None: None)

    def call(*words):
        try:
            code = cli.main([str(word) for word in words])
        except SystemExit as stopped:
            code = stopped.code
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def run_json(run):
    """Calls a command that must succeed and print one JSON object."""

    def call(*words):
        code, out, err = run(*words)
        assert code == 0, err
        return json.loads(out)

    return call
