"""docs/algorithms.md is what its program writes, which misstates no setting."""

import dataclasses

import pytest

from benchmarks.algorithms import run as algorithms
from benchmarks.paper import settings


def without(name, setting, cases="all"):
    """The rows without the one on a setting of a learner."""
    rows = algorithms.read()
    left = [
        row
        for row in rows
        if not (name in row.named() and row.setting == setting and row.cases == cases)
    ]
    assert len(left) == len(rows) - 1
    return left


def test_the_page_is_what_the_program_writes():
    assert algorithms.PAGE.read_text() == algorithms.page(algorithms.read())


def test_a_setting_that_is_not_told_is_missed():
    with pytest.raises(
        ValueError, match="each setting of sac once: initial_temperature"
    ):
        algorithms.page(without("sac", "initial_temperature"))
    with pytest.raises(
        ValueError, match="setting of trpo in structured once: short_st"
    ):
        algorithms.page(without("trpo", "short_steps", "structured"))


def test_a_setting_that_is_told_twice_is_noticed():
    rows = algorithms.read()
    with pytest.raises(ValueError, match="each setting of td3 once: critics"):
        algorithms.page([*rows, next(row for row in rows if row.setting == "critics")])


@pytest.mark.parametrize(
    ("setting", "changes", "sentence"),
    [
        ("clip", {"reference": "0.3"}, r"is 0\.2 now: why\?"),
        ("clip", {"why": "chance"}, "it is as in the reference"),
        ("epochs", {"reference": "8"}, "it is as in the reference"),
    ],
)
def test_a_default_that_is_told_otherwise_is_noticed(setting, changes, sentence):
    rows = [
        dataclasses.replace(row, **changes) if row.setting == setting else row
        for row in algorithms.read()
    ]
    with pytest.raises(ValueError, match=sentence):
        algorithms.page(rows)


def test_one_row_does_not_tell_of_two_values(monkeypatch):
    planned = settings.GRID["structured"]["ppo"]
    other = dataclasses.replace(planned, settings={**planned.settings, "discount": 0.9})
    plans = {**settings.GRID["structured"], "ppo": other}
    monkeypatch.setattr(algorithms, "GRID", {**settings.GRID, "structured": plans})
    with pytest.raises(ValueError, match=r"several values: \[0\.9, 0\.985\]"):
        algorithms.page(algorithms.read())


def test_equal_settings_of_cases_and_learners_are_one_row():
    few = {"discount": 0.9, "num_envs": 8}
    plan, more = settings.Planned(1, few), settings.Planned(1, {**few, "clip": 0.3})
    grid = {"a": {"x": plan, "y": plan}, "b": {"x": more, "y": plan}}
    assert list(algorithms._grouped(grid)) == [
        ("a, b", "x, y", "`discount`", "0.9"),
        ("a, b", "x, y", "`num_envs`", "8"),
        ("b", "x", "`clip`", "0.3"),
    ]
