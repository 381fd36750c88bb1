"""What is damaged in a run is told in one sentence that names it.

A small part of what `tests/extremes/damaged_runs.py` tries.
"""

import json
import shutil

import pytest

from extremes import damage

DAMAGES = [
    ("config.json", "without seed", "it has no 'seed'"),
    ("config.json", "nested too deeply", "it is nested too deeply"),
    ("config.json", "steps = 1e+30", "'steps' must be a whole number from 1"),
    ("config.json", "variant = []", "'variant' must be text or null"),
    ("config.json", "env_options = {'name': 'x'}", "make 'x', not 'trivial'"),
    ("config.json", "env_options = [[]]", "'env_options' must be an object"),
    ("config.json", "score_window = 'x'", "'score_window' must be a whole number"),
    ("config.json", "task = True", "'task' must be text, got True"),
    ("config.json", "noise", "UnicodeDecodeError"),
    ("config.json", "a key twice", "it has the key 'format' twice"),
    ("policy/policy.json", "a key twice", "it has the key 'format' twice"),
    ("policy/policy.json", "a list", "it holds [], not an object"),
    ("policy/policy.json", "activation = 'x'", "'activation' must be one of tanh"),
    ("policy/policy.json", "output = {}", "'output' must be one of clip"),
    ("policy/policy.json", "layers = 'x'", "'layers' must be a whole number"),
    ("policy/policy.json", "action_repeat = 1000000000000", "from 1 to 2147483647"),
    ("policy/policy.json", "about.seed = 0", "belongs to another run than"),
    ("policy/policy.npz", "3 bits flipped", "policy.npz is damaged"),
    ("policy/policy.npz", "a pickle", "it is torn"),
    ("policy/policy.npz", "bias_0: flat", "has the shape (1, 64), not (1, 128)"),
    ("policy/policy.npz", "kernel_1: of one axis more", "the shape (1, 64, 64)"),
    ("policy/policy.npz", "kernel_0: of text", "must hold finite numbers"),
    ("policy/policy.npz", "kernel_1: nan", "must hold finite numbers"),
    ("policy/policy.npz", "observation_mean: gone", "it lacks 'observation_mean'"),
    ("policy/policy.npz", "observation_variance: negative", "must not be negative"),
]
ON_RESUMING = [
    ("summary.json", "a list", "summary.json is damaged: it holds []"),
    ("summary.json", "an empty object", "summary.json is damaged: it has no 'status'"),
    ("summary.json", "cut to half", "summary.json is damaged: "),
    ("config.json", "settings.clip = 'x'", "config.json is damaged: clip must be a nu"),
    ("config.json", "settings.clip = -1", "config.json is damaged: clip must be posit"),
    ("config.json", "settings.hidden_sizes = [1000000000]", "at most 16,384 units, go"),
    (
        "config.json",
        "a key twice",
        "config.json is damaged: it has the key 'format' tw",
    ),
    ("episodes.csv", "a cell that is empty", "has an empty value in the column"),
    ("episodes.csv", "cut to half", "complete rows, but the checkpoint counts"),
    ("progress.csv", "another number", "does not match the checkpoint: its first"),
    ("checkpoints/0000000008.npz", "cut to half", "0000000008.npz is damaged: it is"),
    ("checkpoints/0000000008.npz", "50 bits flipped", "0000000008.npz is damaged: "),
    ("checkpoints/0000000008.npz", "about: gone", "0000000008.npz is damaged: it la"),
]


@pytest.fixture
def spoilt(trained, tmp_path):
    """Makes a copy of the run with one file damaged."""

    def make(name, what):
        folder = tmp_path / "run"
        shutil.copytree(trained[0], folder)
        dict(damage.of(folder / name))[what](folder / name)
        return folder

    return make


def contents(folder):
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def check_refused(result, before, folder, said):
    code, out, err = result
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert str(folder) in err and said in err
    assert contents(folder) == before


@pytest.mark.fast_sets(9)
@pytest.mark.parametrize(("name", "what", "said"), DAMAGES)
def test_a_damaged_run_is_not_evaluated(name, what, said, spoilt, run):
    folder = spoilt(name, what)
    before = contents(folder)
    check_refused(run("evaluate", folder), before, folder, said)
    assert not (folder / "policy" / "unpickled").exists()


@pytest.mark.fast_sets(1)
@pytest.mark.default_precision
@pytest.mark.parametrize(("name", "what", "said"), ON_RESUMING)
def test_a_damaged_run_is_not_resumed(name, what, said, spoilt, run):
    folder = spoilt(name, what)
    before = contents(folder)
    words = ("train", "trivial", "--resume", "--out", folder)
    check_refused(run(*words), before, folder, said)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("a torn row in the middle", "row 1 has 1 values for"),
        ("a cell of text", "could not convert string to float: 'x'"),
        ("no head", "must have the columns"),
    ],
)
def test_a_damaged_table_is_not_drawn(what, said, spoilt, run):
    folder = spoilt("progress.csv", what)
    before = contents(folder)
    check_refused(run("render", folder), before, folder, said)


def test_a_file_is_no_run(trained, run):
    file = trained[0] / "config.json"
    code, _, err = run("evaluate", file)
    assert code == 2
    assert f"{file} is a file, not the folder of a run" in err


@pytest.mark.parametrize("command", ["evaluate", "render", "train trivial --out"])
def test_a_variable_that_is_not_set_is_no_folder(command, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = run(*command.split(), "")
    assert code == 2
    assert "must name a file or folder, got ''" in err
    assert not list(tmp_path.iterdir())


def test_what_a_terminal_would_obey_is_not_printed_raw(trained, run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained[0], folder)
    for name in ("config.json", "policy/policy.json"):
        text = (folder / name).read_text()
        content = json.loads(text.replace('"ppo"', '"\\u001b[2Jppo\\u202e"'))
        (folder / name).write_text(json.dumps(content))
    code, out, err = run("evaluate", folder, "--episodes", "2")
    assert code == 0
    assert "trivial, \\x1b[2Jppo\\u202e, seed 3" in out
    assert "\x1b" not in out + err
    code, _, err = run("train", "trivial", "--resume", "--out", folder)
    assert code == 2 and "\x1b" not in err


def test_a_folder_of_other_things_is_not_trained_in(run, tmp_path):
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "thesis.txt").write_text("years of work")
    before = contents(tmp_path)
    for more in ([], ["--overwrite"]):
        result = run("train", "trivial", "--steps", "2k", "--out", tmp_path, *more)
        check_refused(result, before, tmp_path, "replaces nothing there")


@pytest.mark.default_precision
def test_a_run_without_the_mark_is_read_and_never_written_to(trained, run, tmp_path):
    """As those of versions that marked none."""
    folder = tmp_path / "run"
    shutil.copytree(trained[0], folder)
    config = json.loads((folder / "config.json").read_text())
    del config["format"]
    (folder / "config.json").write_text(json.dumps(config))
    assert run("evaluate", folder, "--episodes", "2")[0] == 0
    before = contents(folder)
    for how in ("--resume", "--overwrite"):
        result = run("train", "trivial", "--out", folder, how)
        check_refused(result, before, folder, "replaces nothing there")


@pytest.mark.parametrize("steps", ["1e30", "1e400000", "9" * 5000])
def test_too_many_steps_are_refused_at_once_and_leave_nothing(steps, run, tmp_path):
    code, _, err = run("train", "trivial", "--steps", steps, "--out", tmp_path / "run")
    assert code == 2
    assert "too large" in err or "steps must be at most" in err
    assert len(err) < 5000
    assert not (tmp_path / "run").exists()
