"""Fixtures that call commands of `jaxrod`."""

import json

import pytest

import jaxrod
from jaxrod import cli


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
