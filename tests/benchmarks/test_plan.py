"""The published grid as it is planned: within the paper's budget, and trainable."""

import pytest

from benchmarks.paper.plan import plan
from benchmarks.paper.published import CASES
from benchmarks.paper.settings import CLEAN, GRID
from jaxrod.training import algorithm_names


def test_the_grid_has_every_case_and_algorithm_within_the_papers_budget():
    cells = plan([], [], [0])
    pairs = {(cell.case, cell.algorithm) for cell in cells}
    assert len(pairs) == len(cells) == 20
    for cell in cells:
        assert cell.variant == "paper"
        assert 0.98 * GRID[cell.task][cell.algorithm].steps <= cell.steps
        assert cell.steps <= cell.paper.timesteps


@pytest.mark.parametrize("case", GRID)
def test_every_cell_names_settings_that_its_learner_takes(case):
    # `plan` validates them as a run does; two devices are what a laptop has.
    # What needs a model is not of the paper.
    assert set(GRID[case]) == set(algorithm_names()) - {"dagger", "shac"}
    for cell in plan([case], [], [0, 1]):
        assert cell.settings["num_envs"] % 2 == 0


def test_cases_have_the_tasks_names_and_the_papers():
    named = plan(["tracking", "structured"], ["ppo"], [0])
    assert plan(["Case1", "case3", "Case1"], ["PPO", "ppo"], [0, 0]) == named
    assert [cell.name for cell in named] == ["Case1-PPO-0", "Case3-PPO-0"]
    (clean,) = plan(["Case4"], ["sac"], [2], variant="clean")
    assert clean.name == "Case4-SAC-clean-2"
    assert clean.paper is None
    assert list(CASES.values()) == ["Case1", "Case2", "Case3", "Case4"]


def test_a_share_of_the_steps_is_rounded_down_to_whole_updates():
    (cell,) = plan(["Case2"], ["ppo"], [0], fraction=0.01)
    assert cell.steps == 10_000_000 // 100 // 16_384 * 16_384
    # Episodes are cut short for the same part of a shorter run.
    (whole,) = plan(["Case3"], ["trpo"], [0])
    (half,) = plan(["Case3"], ["trpo"], [0], fraction=0.5)
    assert whole.settings["short_steps"] == 370_000
    assert half.settings["short_steps"] == 185_000


def test_clean_variants_have_settings_of_their_own_where_they_are_planned():
    (clean,) = plan(["structured"], ["sac"], [0], variant="clean")
    assert clean.settings["num_envs"] == 32
    assert clean.steps == 2_000_000 // 1280 * 1280
    for case, name in (("structured", "trpo"), ("tracking", "sac")):
        assert name not in CLEAN.get(case, {})
        (as_published,) = plan([case], [name], [0])
        (clean,) = plan([case], [name], [0], variant="clean")
        assert clean.settings == as_published.settings
    for case, plans in CLEAN.items():
        for cell in plan([case], list(plans), [0], variant="clean"):
            assert cell.settings["num_envs"] % 2 == 0
