"""The published results, and which of them a run compares with."""

import pytest

from benchmarks.paper.published import paper_result, result_of_run


def config(task, algorithm="trpo", variant="paper", **options):
    return {
        "task": task,
        "variant": variant,
        "env_options": {"variant": variant, **options},
        "algorithm": algorithm,
    }


def test_the_paper_shows_ppo_on_case_1_at_10652_in_10_9_hours():
    result = paper_result("Case1", "PPO")
    assert result.configuration == "batch=32000"
    assert (result.final_mean, result.final_std) == (10652.0, 665.0)
    assert round(result.wall_hours, 1) == 10.9
    assert paper_result("case1", "ppo") == result


@pytest.mark.parametrize("case", ["Case1", "Case2", "Case3", "Case4"])
@pytest.mark.parametrize("algorithm", ["PPO", "TRPO", "SAC", "TD3", "DDPG"])
def test_the_figures_show_one_configuration_of_every_pair(case, algorithm):
    result = paper_result(case, algorithm)
    assert result.in_figure
    assert result.best >= result.final_mean - 200
    # The log's totals: steps over hours is the mean speed.
    speed = result.timesteps / (3600 * result.wall_hours)
    assert speed == pytest.approx(result.steps_per_s, rel=0.02)


def test_other_configurations_are_found_by_name():
    assert paper_result("Case1", "PPO", "batch=1000").final_mean == -999.4
    with pytest.raises(ValueError, match=r"no results .* 'Case9'"):
        paper_result("Case9", "PPO")
    with pytest.raises(ValueError, match=r"4 results .*n_ctrl=2"):
        paper_result("Case3-ctrlpts", "PPO")


def test_equidistant_control_points_compare_with_the_papers_rows_of_that_number():
    for number in (2, 4, 6, 8):
        for algorithm in ("ppo", "trpo"):
            found = result_of_run(config("structured", algorithm, controls=number))
            assert found == paper_result(
                "Case3-ctrlpts", algorithm, f"batch=16000,n_ctrl={number}"
            )
    found = result_of_run(config("structured", controls=4))
    assert (round(found.final_mean), round(found.wall_hours, 1)) == (5695, 1.9)


def test_the_placed_points_and_the_published_nest_compare_with_the_figures():
    for task, options, paper in (
        ("structured", {}, "Case3"),
        ("structured", {"controls": None}, "Case3"),
        ("unstructured", {"nest": None}, "Case4"),
    ):
        found = result_of_run(config(task, **options))
        assert found == paper_result(paper, "TRPO")


@pytest.mark.parametrize(
    ("task", "algorithm", "options"),
    [
        ("structured", "trpo", {"controls": 3}),
        ("structured", "sac", {"controls": 4}),
        ("structured", "trpo", {"variant": "clean"}),
        ("unstructured", "trpo", {"nest": 0}),
        ("unstructured", "trpo", {"n_elements": 20}),
        ("tracking", "trpo", {"episode_length": 100}),
    ],
)
def test_other_tasks_than_the_papers_compare_with_nothing(task, algorithm, options):
    assert result_of_run(config(task, algorithm, **options)) is None
