"""Extreme actions in free space: nothing non-finite, no energy from nowhere."""

import pytest

from extremes.actions import run


def check(result, record):
    name = f"{result['episodes']:,} episodes of {result['seconds']:g} s"
    record(
        f"Extreme actions, {name}: states that are not finite",
        "none",
        result["flags"]["not_finite"] + result["states_not_finite_after_freezing"],
        at_most=0,
    )
    record(
        f"Extreme actions, {name}: share that is flagged",
        "none",
        result["episodes_flagged"] / result["episodes"],
        at_most=1e-3,
    )
    record(
        f"Extreme actions, {name}: energy beyond the work done, relative",
        "work of the couples",
        result["energy_beyond_work"],
        at_most=0.01,
    )


@pytest.mark.default_precision
def test_extreme_actions_on_the_benchmarks_arm(record):
    check(run(48, 0.14, batch=48), record)


@pytest.mark.slow
@pytest.mark.default_precision
def test_extreme_actions_for_whole_episodes(record):
    check(run(192, 5.0), record)
