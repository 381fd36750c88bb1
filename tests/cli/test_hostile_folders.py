"""Run folders that somebody else has made to do harm: each is refused in words.

The folders are made of data alone and handed to what the commands call. None may leave
the mark of having run something, or change the file of somebody else that they lead to.
"""

import importlib
import json
import os
import sys

import numpy as np
import pytest

from benchmarks.paper.cell_records import COLUMNS
from benchmarks.paper.plan import plan
from extremes.damage import Malicious
from jaxrod.cli import settings, train
from jaxrod.cli.runs import open_run
from jaxrod.cli.sweeps.running import open_log
from jaxrod.envs.trivial import Trivial
from jaxrod.files import LinkedFileError, UntrustedError, open_to_write
from jaxrod.training import PPOConfig, RunFolder, load_policy, restore_policy
from jaxrod.training.runs.checkpoint import Checkpoints
from jaxrod.training.runs.event_file import EventFile
from jaxrod.training.runs.owned_folder import LOCK, only_process

CONFIG = {
    "format": "jaxrod training run 1",
    "task": "trivial",
    "variant": None,
    "env_options": {},
    "algorithm": "ppo",
    "steps": 2000,
    "seed": 0,
    "score_window": 50,
    "settings": {},
}
OTHER = {"format": 2, "leaves": {}, "action_repeat": 1, "about": {}}
"""A policy that only the code which trained it can read."""
THESIS = "thesis\n" * 100

EVIL = """
from os import system
open({mark!r}, "w").close()
class Holder:
    def make(**options): open({mark!r}, "w").close()
def make(*given, **options): open({mark!r}, "w").close()
ALGORITHM = make
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder that is the current one, with somebody's module and thesis beside."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thesis.txt").write_text(THESIS)
    text = EVIL.format(mark=str(tmp_path / "mark"))
    (tmp_path / "evil_module.py").write_text(text)
    (tmp_path / "evil_package").mkdir()
    (tmp_path / "evil_package" / "__init__.py").write_text(text)
    (tmp_path / "evil_package" / "inside.py").write_text(text)
    (tmp_path / "run").mkdir()
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("evil_")]:
        del sys.modules[name]


def write(run, **changes):
    (run / "config.json").write_text(json.dumps(CONFIG | changes))


def task(where, said, trust=(), **options):
    """A task that a run names."""

    def attempt(place):
        given = {k: v.format(place) for k, v in options.items()}
        write(place / "run", task=where.format(place), env_options=given)
        open_run(place / "run", trust)

    return pytest.param(attempt, said, id=f"task {where} {trust}".strip())


def of_policy(what, value, said, trust=()):
    """An algorithm or a setting that a run names, where its policy is read."""

    def attempt(place):
        run = place / "run"
        write(run, **{what: value})
        (run / "policy").mkdir()
        (run / "policy" / "policy.json").write_text(json.dumps(OTHER))
        np.savez(run / "policy" / "policy.npz")
        restore_policy(run, Trivial(), trust=trust)

    return pytest.param(attempt, said, id=f"{what} {value} {trust}")


def stored_setting(path, said):
    """A network that a run names, where it is gone on with."""

    def attempt(place):
        settings.configure(PPOConfig(), {"network": path}, ["clip=0.1"])

    return pytest.param(attempt, said, id=f"resumed network {path}")


def led(name, use, said, how=os.symlink):
    """Something in the folder that leads to a file or a folder of somebody else."""

    def attempt(place):
        write(place / "run")
        (place / "elsewhere").mkdir()
        target = "thesis.txt" if "." in name else "elsewhere"
        how(place / target, place / "run" / name)
        use(place / "run")

    return pytest.param(attempt, said, id=f"{name} by {how.__name__}")


def pipe(target, name):
    """A pipe in the place of a file: whoever opens it waits for ever."""
    os.mkfifo(name)


def device(target, name):
    """A file without an end."""
    os.symlink("/dev/zero", name)


def over(how):
    """The same in the place of a file that is there."""

    def replace(target, name):
        name.unlink()
        how(target, name)

    replace.__name__ = how.__name__
    return replace


def lock(run):
    with only_process(run):
        pass


def append(name):
    return lambda run: getattr(RunFolder(run), name).append([{"step": 1}])


def replaceable(run):
    RunFolder(run).check_replaceable()


def save(run):
    Checkpoints(run / "checkpoints").save(1, {"a": np.zeros(2)}, {})


def pickled(name, read):
    """Arrays that only a pickle can hold, and running it leaves a mark."""

    def attempt(place):
        write(place / "run")
        (place / "run" / name).parent.mkdir()
        array = np.array([Malicious(place / "mark")], dtype=object)
        np.savez(place / "run" / name, about=array, bias_0=array)
        read(place / "run")

    return pytest.param(attempt, "allow_pickle=False", id=f"pickle in {name}")


def read_checkpoint(run):
    Checkpoints(run / "checkpoints").restore({})


def read_policy(run):
    layers = {"activation": "tanh", "output": "clip", "layers": 1}
    sizes = {"format": 1, "observation_size": 1, "action_size": 1}
    (run / "policy" / "policy.json").write_text(json.dumps(layers | sizes))
    load_policy(run / "policy")


def doubled(name, text, read):
    """A key twice, of which a person sees one and a program takes the other."""

    def attempt(place):
        (place / "run" / "policy").mkdir()
        (place / "run" / "policy" / "policy.npz").touch()
        (place / "run" / name).write_text(text)
        read(place / "run")

    return pytest.param(attempt, rf"{name} .* twice", id=f"doubled key in {name}")


def read_described(run):
    load_policy(run / "policy")


def read_summary(run):
    RunFolder(run).summary()


def log_events(run):
    EventFile(run / "tensorboard", [], 0.0)


FLAG = r"--trust {}, in Python trust="
LINK = "is a link to .*(thesis.txt|elsewhere|zero)"
HOSTILE = [
    task("jaxrod.files:os.system", "without dots", command="touch {}/mark"),
    task("numpy:os.system", "without dots", command="touch {}/mark"),
    task("evil_module:Holder.make", "without dots", trust=("evil_module",)),
    task("os:system", "'os' is a module of Python's", command="touch {}/mark"),
    task("os:system", "'os' is a module of Python's", ("os",), command="touch {}/mark"),
    task("posix:system", "'posix' is a module", command="touch {}/mark"),
    task("subprocess:getoutput", "'subprocess' is a module", cmd="touch {}/mark"),
    task("builtins:open", "'builtins' is a module", file="{}/thesis.txt", mode="w"),
    task("shutil:copyfile", "'shutil'", src="evil_module.py", dst="{}/mark"),
    task("numpy:load", FLAG.format("numpy"), file="x", allow_pickle="true"),
    task("jax.numpy:load", FLAG.format("jax.numpy"), file="x"),
    task("jaxrod.files:write_atomically", FLAG.format("jaxrod.files"), path="{}/mark"),
    task("jaxrod.envs.trivial:Trivial", FLAG.format("jaxrod.envs.trivial")),
    task("evil_module:make", FLAG.format("evil_module")),
    task("evil_module:make", FLAG.format("evil_module"), trust=("evil",)),
    task("evil_module:make", FLAG.format("evil_module"), trust=("evil_module.make",)),
    task("evil_package:make", FLAG.format("evil_package"), ("evil_package.inside",)),
    task("evil_package.inside:make", FLAG.format(".*inside"), ("evil_package",)),
    task("evil_module.py:make", FLAG.format(".*/evil_module.py")),
    task("{}/evil_module.py:make", FLAG.format(".*"), trust=("evil_module",)),
    task("{}/evil_module.py:make", FLAG.format(".*"), trust=("other.py",)),
    task("evil module:make", "neither the name of a module nor a .py file"),
    task(".evil_module:make", "neither the name of a module nor a .py file"),
    task(":make", "must be module:NAME"),
    of_policy("algorithm", "evil_module:ALGORITHM", FLAG.format("evil_module")),
    of_policy("algorithm", "os:system", "config.json: 'os:system' is not imported"),
    of_policy("algorithm", "antigravity:x", "config.json: .* Python's standard"),
    of_policy("algorithm", "jaxrod.files:os.system", "module:NAME"),
    of_policy(
        "settings", {"network": "evil_module:make"}, "network: 'evil_module:make"
    ),
    of_policy("settings", {"network": "builtins:exec"}, "network: 'builtins:exec'"),
    of_policy("settings", {"network": "evil_module:system"}, "--trust evil_module"),
    stored_setting("builtins:exec", "network: 'builtins:exec' is not imported"),
    stored_setting("evil_module:make", "network: .*--trust evil_module"),
    led(LOCK, lock, LINK),
    led(LOCK, lock, r"2 names \(hard links\)", how=os.link),
    led(LOCK, lock, "not a plain file", how=pipe),
    led("progress.csv", append("progress"), LINK),
    led("episodes.csv", append("episodes"), r"2 names \(hard links\)", how=os.link),
    led("progress.csv", append("progress"), "not a plain file", how=pipe),
    led("run.log", lambda run: open_log(run / "run.log"), LINK),
    led("policy", replaceable, LINK),
    led("checkpoints", replaceable, LINK),
    led("checkpoints", save, LINK),
    led("tensorboard", replaceable, LINK),
    led("tensorboard", log_events, LINK),
    led(
        "config.json", lambda run: RunFolder(run).config(), "not a pla", how=over(pipe)
    ),
    led(
        "config.json", lambda run: RunFolder(run).config(), "not a pl", how=over(device)
    ),
    pickled("policy/policy.npz", read_policy),
    pickled("checkpoints/0000000001.npz", read_checkpoint),
    doubled("config.json", '{"task": "trivial", "task": "os:system"}', open_run),
    doubled("policy/policy.json", '{"layers": 1, "layers": 2}', read_described),
    doubled("summary.json", '{"status": 1, "status": 2}', read_summary),
]


@pytest.mark.parametrize(("attempt", "said"), HOSTILE)
def test_a_hostile_folder_runs_nothing_and_is_refused_in_words(attempt, said, place):
    with pytest.raises((ValueError, ImportError), match=said):
        attempt(place)
    assert not (place / "mark").exists()
    assert (place / "thesis.txt").read_text() == THESIS
    assert not any((place / "elsewhere").glob("*"))
    assert not [name for name in sys.modules if name.startswith("evil_")]


def test_there_are_at_least_forty_of_them():
    assert len(HOSTILE) >= 40


@pytest.mark.parametrize(
    ("where", "trust"),
    [
        ("evil_module:make_task", ("evil_module",)),
        ("evil_module:make_task", ("another", "evil_module:make_task")),
        ("evil_package.inside:make_task", ("evil_package.inside",)),
        ("evil_module.py:make_task", ("evil_module.py",)),
        ("{}/evil_module.py:make_task", ("evil_module.py",)),
        ("evil_module.py:make_task", ("{}/evil_module.py",)),
        ("evil_module:Trivial", ("evil_module:Trivial",)),
    ],
)
def test_what_the_user_vouches_for_is_made(where, trust, place):
    """A module is trusted by its whole name or its file, an object by its path."""
    text = (
        "from jaxrod.envs.trivial import Trivial\ndef make_task(): return Trivial()\n"
    )
    for file in (
        "evil_module.py",
        "evil_package/inside.py",
        "evil_package/__init__.py",
    ):
        (place / file).write_text(text)
    write(place / "run", task=where.format(place))
    found = open_run(place / "run", [one.format(place) for one in trust])
    assert found.env == Trivial()


def test_a_trusted_module_does_not_lend_what_it_has_only_imported(place):
    (place / "evil_module.py").write_text("from os import system\n")
    command = {"command": f"touch {place}/mark"}
    write(place / "run", task="evil_module:system", env_options=command)
    with pytest.raises(
        UntrustedError, match=r"it is part of posix, .*evil_module:system"
    ):
        open_run(place / "run", ("evil_module",))
    assert not (place / "mark").exists()


def test_a_text_in_the_place_of_a_tuple_is_no_trust(place):
    """A part of it would do, where the whole is to match."""
    write(place / "run", task="evil_module:make")
    with pytest.raises(ValueError, match=r"trust must be a tuple .* \('my_evil_modu"):
        open_run(place / "run", "my_evil_module")


def test_a_setting_as_by_default_needs_no_word(place, monkeypatch):
    """It is the learner's own, and nothing is imported for it."""
    (place / "evil_module.py").write_text("def make(role, outputs): ...\n")
    monkeypatch.syspath_prepend(place)
    usual = PPOConfig(network=importlib.import_module("evil_module").make)
    stored = {"network": "evil_module:make"}
    assert settings.configure(usual, stored, []).network is usual.network


def test_a_command_answers_in_one_sentence_with_the_flag(place, run):
    write(place / "run", task="evil_module:make")
    for words in (
        ("evaluate", place / "run"),
        ("render", place / "run"),
    ):
        code, out, err = run(*words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert f"the task of {place}/run/config.json: 'evil_module:make' is not" in err
        assert "--trust evil_module," in err
    assert not (place / "mark").exists()


@pytest.mark.parametrize("how", ["--resume", "--like"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"algorithm": "evil_module:ALGORITHM"}, "'evil_module:ALGORITHM' is not"),
        ({"settings": {"network": "evil_module:make"}}, "network: 'evil_module:make'"),
        ({"settings": {"network": "builtins:exec"}}, "network: 'builtins:exec' is"),
    ],
)
def test_a_run_is_not_gone_on_with_by_code_that_it_names(how, change, said, place, run):
    write(place / "run", **change)
    where = {"--resume": ["--resume", "--out", place / "run"]}
    words = where.get(how, ["--like", place / "run", "--out", place / "new"])
    code, out, err = run("train", "trivial", *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"{place}/run/config.json: {said}" in err
    assert not (place / "mark").exists()


def test_a_folder_that_is_a_link_itself_is_the_users_own_choice(place):
    (place / "elsewhere").mkdir()
    (place / "named").symlink_to(place / "elsewhere")
    with only_process(place / "named"):
        RunFolder(place / "named").begin(CONFIG)
    assert (place / "elsewhere" / "config.json").is_file()


def test_a_lock_that_was_left_behind_is_taken_over(place):
    (place / "run" / LOCK).write_text("17 somewhere\n" * 20)
    with only_process(place / "run"):
        assert (place / "run" / LOCK).read_text().startswith(f"{os.getpid()} ")
    with pytest.raises(LinkedFileError, match="not a plain file"):
        open_to_write(place / "run", os.O_RDONLY)


def test_a_link_that_is_replaced_whole_leaves_what_it_led_to(place):
    (place / "run" / "summary.json").symlink_to(place / "thesis.txt")
    RunFolder(place / "run").write_summary({"status": "finished"})
    assert not (place / "run" / "summary.json").is_symlink()
    assert (place / "thesis.txt").read_text() == THESIS


SWEEP = ("sweep", "trivial", "--seeds", 0, "--steps", "20k", "--dry-run", "--out")
GRID = ("reproduce", "trivial", "--algorithms", "ppo", "--seeds", 0, "--out")


@pytest.mark.parametrize("name", ["trivial-ppo-0", "trivial-ppo-0.log"])
def test_a_sweep_trains_in_no_folder_that_a_link_leads_to(name, place, run):
    (place / "elsewhere").mkdir()
    (place / "run" / name).symlink_to(place / "elsewhere")
    code, _, err = run(*SWEEP, place / "run")
    assert code == 2 and f"{name} is a link to {place}/elsewhere" in err


@pytest.mark.parametrize("name", ["runs", "runs/trivial-PPO-0"])
def test_a_grid_trains_in_no_folder_that_a_link_leads_to(name, place, run):
    (cell,) = plan(["trivial"], ["ppo"], [0])
    name = name.replace("trivial-PPO-0", cell.name)
    (place / "elsewhere").mkdir()
    (place / "run" / name).parent.mkdir(exist_ok=True)
    (place / "run" / name).symlink_to(place / "elsewhere")
    code, _, err = run(*GRID, place / "run")
    assert code == 2 and f"{name} is a link to {place}/elsewhere" in err
    assert not any((place / "elsewhere").iterdir())


def test_a_record_of_a_grid_imports_nothing(place, run):
    (cell,) = plan(["trivial"], ["ppo"], [0])
    record = dict.fromkeys(COLUMNS, 0.0) | {"seed": 0, "status": "finished"}
    record["config"] = CONFIG | {"algorithm": "evil_module:ALGORITHM"}
    (place / "run" / "cells").mkdir()
    (place / "run" / "cells" / f"{cell.name}.json").write_text(json.dumps(record))
    code, _, err = run(*GRID, place / "run", "--dry-run")
    assert code == 2 and "names the algorithm 'evil_module:ALGORITHM'" in err
    assert not (place / "mark").exists()


def test_a_run_that_is_stopped_says_with_which_flags_it_goes_on(place, monkeypatch):
    (place / "evil_module.py").write_text("def make(role, outputs): ...\n")
    monkeypatch.syspath_prepend(place)
    own = PPOConfig(network=importlib.import_module("evil_module").make)
    assert train._modules("ppo", PPOConfig()) == []
    assert train._modules("mine:ALGORITHM", own) == ["evil_module", "mine"]
