"""The published grid as it is planned: within the paper's budget, and trainable."""

import pytest

from algorithms_page import CLEAN_DIFFERENT, DIFFERENT, both, settings_rows
from jaxrod.cli import grid as grids
from jaxrod.cli import runs
from jaxrod.training import algorithm_names, find_algorithm
from jaxrod.training.grid_settings import CLEAN, GRID


def test_the_grid_has_every_case_and_algorithm_within_the_papers_budget():
    cells = grids.plan([], [], [0])
    pairs = {(cell.case, cell.algorithm) for cell in cells}
    assert len(pairs) == len(cells) == 20
    for cell in cells:
        assert cell.variant == "paper"
        assert 0.98 * GRID[cell.task][cell.algorithm].steps <= cell.steps
        assert cell.steps <= cell.paper.timesteps


@pytest.mark.parametrize("case", GRID)
def test_every_cell_names_settings_that_its_learner_takes(case):
    # `plan` validates them as a run does; two devices are what a laptop has.
    assert set(GRID[case]) == set(algorithm_names())
    for cell in grids.plan([case], [], [0, 1]):
        assert cell.settings["num_envs"] % 2 == 0


def test_cases_have_the_tasks_names_and_the_papers():
    named = grids.plan(["tracking", "structured"], ["ppo"], [0])
    assert grids.plan(["Case1", "case3", "Case1"], ["PPO", "ppo"], [0, 0]) == named
    assert [cell.name for cell in named] == ["Case1-PPO-0", "Case3-PPO-0"]
    (clean,) = grids.plan(["Case4"], ["sac"], [2], variant="clean")
    assert clean.name == "Case4-SAC-clean-2"
    assert clean.paper is None
    assert list(runs.PAPER_CASES.values()) == ["Case1", "Case2", "Case3", "Case4"]


def test_a_share_of_the_steps_is_rounded_down_to_whole_updates():
    (cell,) = grids.plan(["Case2"], ["ppo"], [0], fraction=0.01)
    assert cell.steps == 10_000_000 // 100 // 16_384 * 16_384
    # Episodes are cut short for the same part of a shorter run.
    (whole,) = grids.plan(["Case3"], ["trpo"], [0])
    (half,) = grids.plan(["Case3"], ["trpo"], [0], fraction=0.5)
    assert whole.settings["short_steps"] == 370_000
    assert half.settings["short_steps"] == 185_000


def test_the_page_on_algorithms_tells_what_differs_by_case():
    named = {case: plans for case, plans in GRID.items() if case != "trivial"}
    published = [
        (algorithms, cases, setting, ours)
        for algorithms, cases, setting, _, ours, _ in settings_rows(DIFFERENT)
        if cases != "all"
    ]
    clean = [
        (algorithms, cases, setting, value)
        for cases, algorithms, setting, value in settings_rows(CLEAN_DIFFERENT)
    ]
    for rows, grid in ((published, named), (clean, CLEAN)):
        told = {(case, name): {} for case, plans in grid.items() for name in plans}
        for algorithms, cases, setting, value in rows:
            everybody = ", ".join(algorithm_names())
            who = everybody if algorithms == "all" else algorithms
            for case, name in both(cases, who):
                assert setting not in told[case, name], (case, name, setting)
                told[case, name][setting] = value
        for (case, name), settings in told.items():
            default = find_algorithm(name).config_type()
            for setting, value in grid[case][name].settings.items():
                assert value != getattr(default, setting), (case, name, setting)
            planned = {k: str(v) for k, v in grid[case][name].settings.items()}
            assert settings == planned, (case, name)


def test_clean_variants_have_settings_of_their_own_where_they_are_planned():
    (clean,) = grids.plan(["structured"], ["sac"], [0], variant="clean")
    assert clean.settings["num_envs"] == 32
    assert clean.steps == 2_000_000 // 1280 * 1280
    for case, name in (("structured", "trpo"), ("tracking", "sac")):
        assert name not in CLEAN.get(case, {})
        (as_published,) = grids.plan([case], [name], [0])
        (clean,) = grids.plan([case], [name], [0], variant="clean")
        assert clean.settings == as_published.settings
    for case, plans in CLEAN.items():
        for cell in grids.plan([case], list(plans), [0], variant="clean"):
            assert cell.settings["num_envs"] % 2 == 0
