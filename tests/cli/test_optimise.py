"""`jaxrod optimise`: what it writes, what it refuses, that it explains itself."""

import csv
import json
import shlex
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxrod import cli, control
from jaxrod.cli import optimise
from jaxrod.envs import make


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["levenberg-marquardt", "adam"])
def test_the_folder_holds_the_result_and_json_prints_the_summary(run, tmp_path, solver):
    out = tmp_path / "deep" / "reach"
    words = ["optimise", "tracking", "--out", out, "--json", "--iterations", "2"]
    words += ["--target", "0.3", "0.7", "-0.2", "--knots", "3", "--duration", "0.1"]
    words += ["--solver", solver]
    code, printed, err = run(*words)
    assert code == 1  # two steps do not get there, and the exit code says so
    assert ("2/2 steps" in err) == (solver == "adam")
    summary = json.loads((out / "summary.json").read_text())
    assert json.loads(printed) == summary | {"out": str(out)}
    assert summary["target"] == pytest.approx([0.3, 0.7, -0.2])
    assert summary["iterations"] == 2 and not summary["success"]
    asked = json.loads((out / "config.json").read_text())
    assert (asked["knots"], asked["target"]) == (3, [0.3, 0.7, -0.2])
    assert (asked["solver"], asked["iterations"]) == (solver, 2)
    with (out / "history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["iteration"] for row in rows][:2] == ["0", "1"]
    assert float(rows[1]["cost"]) < float(rows[0]["cost"])
    with np.load(out / "trajectory.npz") as file:
        saved = dict(file)
    assert saved["knots"].shape == (3, 2, 6)
    assert saved["controls"].shape[1:] == (2, 6)
    assert len(saved["times"]) == len(saved["positions"])
    tip = saved["positions"][-1, :, -1]
    apart = np.linalg.norm(tip - summary["target"])
    assert apart == pytest.approx(summary["tip_distance"], abs=1e-6)
    assert (out / "replay.html").read_text().startswith("<!DOCTYPE html>")
    assert (out / "convergence.png").read_bytes().startswith(b"\x89PNG")

    before = {file: file.read_bytes() for file in out.iterdir()}
    code, _, err = run(*words)
    assert code == 2 and "--overwrite" in err
    assert before == {file: file.read_bytes() for file in out.iterdir()}


@pytest.mark.parametrize("rows", [2, 3])
def test_curves_of_controls_have_a_colour_and_a_name_per_direction(rows):
    knots = np.random.default_rng(0).normal(size=(5, rows * 6))
    result = SimpleNamespace(
        history={"cost": [1.0, 0.1]},
        knots=knots,
        times=np.linspace(0, 1, 9),
        problem=SimpleNamespace(data=SimpleNamespace(control_shape=(rows, 6))),
    )
    _, axes = optimise._figure(result).axes
    drawn = np.array([line.get_ydata() for line in axes.lines]).T
    np.testing.assert_array_equal(drawn, knots)
    looks = [(line.get_color(), line.get_alpha()) for line in axes.lines]
    assert len(set(looks)) == rows * 6 and len({colour for colour, _ in looks}) == rows
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert names == list(optimise.DIRECTIONS[:rows])


@pytest.mark.slow
def test_a_reach_at_rest_succeeds_with_the_default_solver(run, tmp_path):
    words = ["optimise", "tracking", "--out", tmp_path / "reach", "--json"]
    code, printed, _ = run(*words, "--speed-tolerance", "0.1", "--elements", "10")
    summary = json.loads(printed)
    assert code == 0 and summary["success"] and summary["iterations"] <= 20
    assert summary["tip_distance"] < 0.005 and summary["tip_speed"] < 0.1


@pytest.mark.slow
def test_ctrl_c_before_anything_was_found_writes_nothing(run, tmp_path, monkeypatch):
    def interrupt(*arguments, **settings):
        raise KeyboardInterrupt

    monkeypatch.setattr(control, "levenberg_marquardt", interrupt)
    code, _, err = run("optimise", "tracking", "--out", tmp_path / "none")
    assert code == 130 and "interrupted" in err
    assert not (tmp_path / "none").exists()


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trivial"], "task must be one of tracking; got 'trivial'"),
        (
            ["tracking", "--seed", "-1"],
            "seed must be an integer from 0 to 4294967295, got -1",
        ),
        (["tracking", "--tolerance", "0"], "tolerance must be positive, got 0 m"),
        (["tracking", "--duration", "-1"], "duration must be positive, got -1 s"),
        (["tracking", "--duration", "1e9"], "duration must be less than 1,073,741,824"),
        (["tracking", "--duration", "1e308"], "duration must be less than"),
        (["tracking", "--knots", "9" * 20], "knots must be at most 2147483647"),
        (["tracking", "--target", "nan", "0", "0"], "target must be finite, got nan m"),
        (["tracking", "--elements", "7"], "n_elements must be"),
        (["tracking", "--knots", "1"], "knots must be at least 2, got 1"),
    ],
)
def test_wrong_requests_are_refused_in_one_sentence(run, tmp_path, words, message):
    code, out, err = run("optimise", *words, "--out", tmp_path / "run")
    assert (code, out) == (2, "")
    assert message in err and err.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("more", [[], ["--overwrite"]])
@pytest.mark.parametrize("name", ["trajectory.npz", "config.json"])
def test_what_it_did_not_write_is_never_replaced(name, more, run, tmp_path):
    """A training run's folder, for one."""
    (tmp_path / name).write_text('{"format": "jaxrod training run 1"}')
    code, _, err = run("optimise", "tracking", "--out", tmp_path, *more)
    assert code == 2 and err.count("\n") == 1
    assert f"{tmp_path} holds {name}, and " in err
    assert "jaxrod replaces nothing there" in err
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_a_file_is_no_folder_for_a_result(run, tmp_path):
    (tmp_path / "notes").write_text("mine")
    code, _, err = run("optimise", "tracking", "--out", tmp_path / "notes")
    assert code == 2 and "notes is a file, not a folder" in err


def test_the_arm_is_the_tasks_without_its_muscles():
    env = make("tracking", variant="clean")
    arm = optimise.arm_of(env)
    controls = jax.numpy.linspace(-1, 1, 12).reshape(2, 6)
    all_three = jax.numpy.pad(controls, ((0, 1), (0, 0)))
    acted = env.default_params().arm.scene(all_three)
    same = jax.tree.map(
        lambda a, b: bool(np.allclose(a, b, rtol=1e-12)),
        arm.with_controls(controls),
        acted,
    )
    assert all(jax.tree.leaves(same))


def test_help_explains_and_its_examples_parse(run):
    code, out, err = run("optimise", "--help")
    assert (code, err) == (0, "") and "examples:" in out
    assert optimise.__doc__.splitlines()[0] in out
    for line in optimise.EXAMPLES.splitlines()[1:]:
        words = line.partition("jaxrod ")[2].partition("   ")[0].partition(" >")[0]
        parsed = shlex.split(words)
        cli._parser(parsed)[0].parse_args(parsed)
