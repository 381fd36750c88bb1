"""`python -m benchmarks first_calls`: each program in a process of its own."""

import argparse
import inspect

import pytest

from benchmarks.first_calls import programs, run
from jaxrod.envs import names


def test_every_program_is_listed_and_described():
    own = {
        name
        for name, function in inspect.getmembers(programs, inspect.isfunction)
        if function.__module__ == programs.__name__ and not name.startswith("_")
    }
    assert own == set(run.PROGRAMS)
    assert all(getattr(programs, name).__doc__ for name in own)
    assert not own & set(names())


def test_a_row_has_a_number_for_each_column(monkeypatch, tmp_path):
    words = ["import", "prepare", "call", "again", "programs", "kernels"]
    given = []

    def measured(name, cache):
        given.append(cache)
        return dict(zip(words, (0.5, 1.0, 2.0 + len(given), 0.1, 3, 2), strict=True))

    monkeypatch.setattr(run, "measured", measured)
    row = run.row("equilibrium", tmp_path)
    assert row.count("|") == run.HEAD.splitlines()[0].count("|")
    assert given == ["0", str(tmp_path), str(tmp_path)]
    assert "| 3.0 | 3 | 2 | 5.0 | 0.10 |" in row


def test_names_are_programs_and_tasks():
    parser = argparse.ArgumentParser()
    run.add_arguments(parser)
    assert tuple(parser.parse_args([]).names) == run.PROGRAMS
    assert parser.parse_args(["fit", "tracking"]).names == ["fit", "tracking"]
    with pytest.raises(SystemExit):
        parser.parse_args(["nonsense"])


@pytest.mark.parametrize("name", ["readme_rod", "readme_system"])
def test_programs_of_the_readme_are_found(name):
    assert callable(getattr(programs, name)())


@pytest.mark.slow
def test_the_system_is_that_of_the_page():
    call = programs.system_advance()
    assert set(call()) == {"trunk", "branch", "ball"}
