"""Options of a task: read, recorded and named."""

import dataclasses
import inspect
import re
from pathlib import Path

import pytest

from jaxrod import cli
from jaxrod.cli import runs, settings, train
from jaxrod.envs import names
from jaxrod.envs.registry import factory_of

CASES = ("tracking", "reaching", "structured", "unstructured")


def config(task, algorithm="trpo", variant="paper", **options):
    return {
        "task": task,
        "variant": variant,
        "env_options": {"variant": variant, **options},
        "algorithm": algorithm,
        "seed": 0,
    }


def test_the_score_of_cases_3_and_4_is_of_ten_episodes_as_in_the_paper():
    windows = [runs.score_window(task) for task in CASES]
    assert windows == [50, 50, 10, 10]


def test_a_run_is_described_and_filed_with_what_was_chosen():
    assert (
        runs.describe(config("structured", controls=4))
        == "structured (paper, controls = 4), trpo, seed 0"
    )
    assert (
        runs.describe(config("unstructured", nest=7))
        == "unstructured (paper, nest = 7), trpo, seed 0"
    )
    assert (
        runs.describe(config("/home/you/reach.py:Reach", "ppo", None))
        == "reach.py:Reach, ppo, seed 0"
    )
    parser = cli._parser(["train"])[0]
    for words, folder in (
        (["structured", "--option", "controls=4"], "structured-paper-controls-4-ppo-0"),
        (["unstructured", "--option", "nest=7"], "unstructured-paper-nest-7-ppo-0"),
        (["unstructured", "--option", "nest=none"], "unstructured-paper-ppo-0"),
    ):
        for more in ([], ["--resume"]):
            args = parser.parse_args(["train", *words, *more])
            variant = None if more else "paper"
            assert train._folder(args, variant) == Path("runs") / folder


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["structured", "controls=1"], "controls must be at least 2"),
        (["structured", "nest=1"], "'structured' has no option 'nest', it has"),
        (["tracking", "controls=4"], "'tracking' has no option 'controls'"),
        (["unstructured", "nest=-1"], "nest must be at least 0"),
        (["unstructured", "nest=bird"], "nest must be"),
    ],
)
def test_a_choice_that_a_task_does_not_have_is_named(words, sentence, run, tmp_path):
    task, option = words
    code, out, err = run("train", task, "--option", option, "--out", tmp_path / "run")
    assert (code, out) == (2, "")
    assert sentence in err
    assert not (tmp_path / "run").exists()


def test_options_are_listed_with_meanings_units_and_defaults(run, monkeypatch):
    for task in names():
        code, out, err = run("train", task, "--option", "help")
        assert (code, err) == (0, "")
        listed = re.findall(r"^(\w+)=(\S+) +(\S.*)", out, re.M)
        parameters = inspect.signature(factory_of(task)).parameters
        assert [name for name, *_ in listed] == list(parameters)
        for name, usual, _ in listed:
            assert (
                settings.options([f"{name}={usual}"])[name] == parameters[name].default
            )
    code, out, _ = run("train", "gripper", "--option", "help")
    assert re.search(
        r"^spread=0.01 +Largest distance of the ball .*\[m\]", out, re.M | re.S
    )
    monkeypatch.chdir(Path(__file__).parents[2])
    code, out, _ = run("train", "examples/own_task.py:make_task", "--option", "help")
    assert (
        code == 0
        and out == "height=0.3  The highest goal, and the lowest below zero [m].\n"
    )


def test_options_of_ones_own_task_are_explained_wherever_it_does():
    class Plain:
        pass

    class Documented:
        def __init__(self, size, start=(0, 1), *more, on=True, **others):
            """Makes it.

            Args:
                size (float): Size of the arm,
                    without the hand [m].
                start: Where it begins: here.
                *more: Nothing.

            Raises:
                ValueError: It fails.
            """

    @dataclasses.dataclass(frozen=True)
    class Fields:
        depth: float | None = None
        """Depth of the water [m]."""

    assert settings.listing_of_options(Plain) == "the task has no options"
    assert settings.listing_of_options(Documented).splitlines() == [
        "size=         Size of the arm, without the hand [m].",
        "start=[0, 1]  Where it begins: here.",
        "on=true",
    ]
    assert settings.listing_of_options(Fields) == "depth=none  Depth of the water [m]."
