"""What a task lets choose: read, recorded, named, and compared with the right rows."""

from pathlib import Path

import pytest

from jaxrod import cli, viz
from jaxrod.cli import runs, train
from jaxrod.envs.registry import made


def config(task, algorithm="trpo", variant="paper", **options):
    return {
        "task": task,
        "variant": variant,
        "env_options": {"variant": variant, **options},
        "algorithm": algorithm,
        "seed": 0,
    }


def test_equidistant_control_points_compare_with_the_papers_rows_of_that_number():
    for number in (2, 4, 6, 8):
        for algorithm in ("ppo", "trpo"):
            found = runs.paper_result(config("structured", algorithm, controls=number))
            assert found == viz.paper_result(
                "Case3-ctrlpts", algorithm, f"batch=16000,n_ctrl={number}"
            )
    assert "5,695 after 1.9 h" in runs.paper_sentence(config("structured", controls=4))


def test_the_placed_points_and_the_published_nest_compare_with_the_figures():
    for task, options, paper in (
        ("structured", {}, "Case3"),
        ("structured", {"controls": None}, "Case3"),
        ("unstructured", {"nest": None}, "Case4"),
    ):
        found = runs.paper_result(config(task, **options))
        assert found == viz.paper_result(paper, "TRPO")


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
    assert runs.paper_result(config(task, algorithm, **options)) is None


def test_the_score_of_cases_3_and_4_is_of_ten_episodes_as_in_the_paper():
    windows = [runs.score_window(task) for task in runs.PAPER_CASES]
    assert windows == [50, 50, 10, 10]


def test_a_run_is_described_and_filed_with_what_was_chosen():
    assert (
        runs.describe(config("structured", controls=4))
        == "structured (paper, 4 control points), trpo, seed 0"
    )
    assert (
        runs.describe(config("unstructured", nest=7))
        == "unstructured (paper, nest 7), trpo, seed 0"
    )
    parser = cli._parser(["train"])[0]
    for words, folder in (
        (["structured", "--controls", "4"], "structured-paper-4-controls-ppo-0"),
        (["unstructured", "--nest", "7"], "unstructured-paper-nest-7-ppo-0"),
        (["unstructured", "--nest", "published"], "unstructured-paper-ppo-0"),
    ):
        for more in ([], ["--resume"]):
            args = parser.parse_args(["train", *words, *more])
            variant = None if more else "paper"
            assert train._folder(args, variant) == Path("runs") / folder


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["structured", "--controls", "1"], "controls must be at least 2"),
        (["structured", "--nest", "1"], "'structured' has no option 'nest', it has"),
        (
            ["tracking", "--controls", "4"],
            "'tracking' has no option 'controls'",
        ),
        (["unstructured", "--nest", "-1"], "nest must be at least 0"),
        (
            ["unstructured", "--nest", "bird"],
            "--nest: must be published or a seed, got 'bird'",
        ),
    ],
)
def test_a_choice_that_a_task_does_not_have_is_named(words, sentence, run, tmp_path):
    code, out, err = run("train", *words, "--out", tmp_path / "run")
    assert (code, out) == (2, "")
    assert sentence in err
    assert not (tmp_path / "run").exists()


def test_naming_the_default_nest_is_choosing_nothing(run, tmp_path, monkeypatch):
    asked = []

    def stop(env, *arguments, **more):
        asked.append(made(env).options)
        raise FloatingPointError("enough")

    monkeypatch.setattr("jaxrod.training.train", stop)
    for words in ([], ["--nest", "published"], ["--nest", "7"]):
        run("train", "unstructured", *words, "--out", tmp_path / "run")
    assert asked[0] == asked[1] == {"variant": "paper"}
    assert asked[2] == {"variant": "paper", "nest": 7}
