"""Runs that are damaged, killed, or started twice."""

import sys

import pytest

from extremes import damaged_runs, kills


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.filterwarnings("default")
def test_no_damage_is_fatal_or_goes_unnoticed(tmp_path, record):
    attack = damaged_runs.Attack(tmp_path)
    trials = list(attack.trials())[::20]
    found = [
        (what, command, fault)
        for what, spoil, named, command in trials
        if (fault := attack.fault(what, spoil, named, command))
    ]
    assert not found
    record(
        f"Runs damaged in {len(trials)} ways: tracebacks, losses, wrong results",
        "none",
        len(found),
        at_most=0,
    )


@pytest.mark.slow
def test_killed_runs_end_as_those_left_in_peace(monkeypatch, capsys, record):
    monkeypatch.setattr(sys, "argv", ["kills.py", "--kills", "8", "--pairs", "3"])
    faults = kills.main()
    assert not faults, capsys.readouterr().out
    record(
        "Runs killed 8 times in all, and 3 pairs in one folder: results that differ",
        "none",
        faults,
        at_most=0,
    )
