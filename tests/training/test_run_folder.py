"""A run folder loses nothing, holds one run, and says what is wrong with it."""

from __future__ import annotations

import dataclasses
import errno
import json
import shutil

import jax
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.trivial import Trivial
from jaxrod.training import PPOConfig, RunFolder, find_algorithm, train
from jaxrod.training.runs.owned_folder import FolderInUseError
from jaxrod.training.runs.resuming import DamagedCheckpointWarning

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
USUAL = {
    "steps": 128 * 8,
    "config": SMALL,
    "chunk_steps": 128,
    "evaluation_episodes": 0,
    "progress": False,
}
pytestmark = pytest.mark.default_precision


def contents(folder):
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


class StoppedError(Exception):
    """Ends a run as a kill does, as far as its files are concerned."""


def stop(row):
    if row["env_steps"] == 128 * 6:
        raise StoppedError


def train_until_stopped(folder, **changes):
    with pytest.raises(StoppedError):
        train(
            Trivial(),
            out=folder,
            **USUAL | {"checkpoint_seconds": 0, "log": stop} | changes,
        )


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run with checkpoints of its fourth and fifth update, killed in the sixth."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    with jax.enable_x64(False):
        train_until_stopped(folder)
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    with jax.enable_x64(False):
        train(Trivial(), out=folder, **USUAL)
    return RunFolder(folder)


@pytest.fixture
def copy(stopped, tmp_path):
    return RunFolder(shutil.copytree(stopped, tmp_path / "run"))


def resume(folder, **changes):
    return train(Trivial(), out=folder.path, resume=True, **USUAL | changes)


def assert_same(folder, whole):
    """The same run, as far as it does not depend on the clock."""
    assert folder.episodes.path.read_bytes() == whole.episodes.path.read_bytes()
    files = [f.policy / "policy.npz" for f in (folder, whole)]
    with np.load(files[0]) as found, np.load(files[1]) as wanted:
        for name in wanted.files:
            np.testing.assert_array_equal(found[name], wanted[name])


def fill_with_thesis(folder):
    for name in ("policy/thesis.txt", "checkpoints/my_model.pt", "other.txt"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("years of work")


def fill_with_other_tool(folder):
    folder.mkdir()
    (folder / "config.json").write_text('{"model_type": "bert", "seed": 1}')
    (folder / "summary.json").write_text("{}")


def fill_with_damaged_config(folder):
    folder.mkdir()
    (folder / "config.json").write_text('{"format": "jaxrod tr')


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    ("fill", "said"),
    [
        (fill_with_thesis, "holds policy, checkpoints|holds checkpoints, policy"),
        (fill_with_other_tool, "holds config.json, summary.json, and its config.json"),
        (fill_with_damaged_config, r"holds config.json, and .*config\.json is damaged"),
    ],
)
def test_what_jaxrod_did_not_write_is_never_replaced(tmp_path, fill, said, overwrite):
    folder = tmp_path / "mine"
    fill(folder)
    before = contents(folder)
    with pytest.raises(ValueError, match=f"mine ({said}).* replaces nothing there"):
        train(Trivial(), out=folder, overwrite=overwrite, **USUAL)
    assert contents(folder) == before


@pytest.mark.slow
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_run_that_lost_its_configuration_is_not_replaced(copy, overwrite):
    (copy.path / "config.json").unlink()
    before = contents(copy.path)
    with pytest.raises(ValueError, match=r"and no config\.json that says"):
        train(Trivial(), out=copy.path, overwrite=overwrite, **USUAL)
    assert contents(copy.path) == before


@pytest.mark.parametrize("out", ["", " "])
def test_no_name_is_no_folder(out, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="out must name a folder, got "):
        train(Trivial(), out=out, **USUAL)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_overwriting_removes_the_run_file_by_file_and_nothing_else(copy):
    strange = ("policy/thesis.txt", "checkpoints/my_model.pt", "checkpoints/5/x", "a")
    for name in strange:
        (copy.path / name).parent.mkdir(exist_ok=True)
        (copy.path / name).write_text("mine")
    (copy.path / "replay.html").write_text("of the run before")
    (copy.path / "checkpoints" / ".0000000006.npz.abcdefgh.partial").write_text("torn")
    copy.clear()
    found = {file.relative_to(copy.path).as_posix() for file in contents(copy.path)}
    assert found == set(strange)
    # What stayed is no run, and is not taken for one.
    with pytest.raises(ValueError, match="jaxrod replaces nothing there"):
        train(Trivial(), out=copy.path, **USUAL)


def test_what_cannot_start_costs_nothing(copy):
    before = contents(copy.path)
    usual = find_algorithm("ppo")

    def broken(*_):
        raise RuntimeError("no weights")

    learner = dataclasses.replace(usual, init=broken)
    with pytest.raises(RuntimeError, match="no weights"):
        train(Trivial(), learner, out=copy.path, overwrite=True, **USUAL)
    with pytest.raises(ValueError, match=r"config\.json can hold only finite numbers"):
        unknown = make("trivial", name=float("nan"))
        train(unknown, out=copy.path, overwrite=True, **USUAL)
    assert contents(copy.path) == before
    new = copy.path / "new"
    with pytest.raises(RuntimeError, match="no weights"):
        train(Trivial(), learner, out=new, **USUAL)
    with pytest.raises(ValueError, match="steps must be at most 2,147,483,647 updates"):
        train(Trivial(), out=new, **USUAL | {"steps": 10**30})
    assert not new.exists()


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("how", [{}, {"resume": True}, {"overwrite": True}])
def test_a_second_run_in_the_folder_is_refused(copy, whole, how):
    refused = []

    def second(row):
        with pytest.raises(FolderInUseError if how else ValueError) as error:
            train(Trivial(), out=copy.path, **USUAL | how)
        refused.append(str(error.value))

    resume(copy, log=second)
    assert len(refused) == 3
    if how:
        assert "run is in use by process" in refused[0]
    assert_same(copy, whole)


def test_an_undamaged_run_goes_on_as_if_nothing_had_happened(copy, whole):
    (copy.checkpoints / ".0000000006.npz.abcdefgh.partial").write_text("torn")
    resume(copy)
    assert_same(copy, whole)
    assert not [file for file in copy.path.rglob(".*")]


@pytest.mark.parametrize("name", ["episodes.csv", "progress.csv"])
def test_lost_rows_are_told_and_nothing_is_changed(copy, name):
    file = copy.path / name
    rows = file.read_text().splitlines(keepends=True)
    file.write_text("".join(rows[: len(rows) // 3]))
    before = contents(copy.path)
    counted = rf"{name} has {len(rows) // 3 - 1} complete rows, but .* counts \d+: "
    with pytest.raises(ValueError, match=counted):
        resume(copy)
    assert contents(copy.path) == before


def test_the_checkpoint_before_a_damaged_one_is_taken_and_it_is_said(copy, whole):
    newest, before = (copy.checkpoints / f"000000000{k}.npz" for k in (5, 4))
    newest.write_bytes(newest.read_bytes()[:-200])
    said = r"0000000005\.npz is damaged: .* Continuing from 0000000004\.npz"
    with pytest.warns(DamagedCheckpointWarning, match=said) as warned:
        resume(copy, log=lambda row: None)
    assert [one.filename for one in warned] == [__file__]
    assert_same(copy, whole)
    assert not before.exists(), "it had its time"


def test_where_all_checkpoints_are_damaged_nothing_is_begun_anew(copy):
    for file in copy.checkpoints.glob("*.npz"):
        file.write_bytes(b"")
    before = contents(copy.path)
    said = r"no checkpoint can be used: .*0000000005\.npz is .*0000000004\.npz is"
    with pytest.raises(ValueError, match=said):
        resume(copy)
    shutil.rmtree(copy.checkpoints)
    with pytest.raises(ValueError, match="is under way and its checkpoints are gone"):
        resume(copy)
    before = {k: v for k, v in before.items() if "checkpoints" not in k.parts}
    assert contents(copy.path) == before


@pytest.mark.slow
def test_a_run_killed_before_its_first_checkpoint_is_begun_anew(tmp_path, whole):
    folder = RunFolder(tmp_path / "run")
    train_until_stopped(folder.path, checkpoint_seconds=60)
    assert len(folder.progress.read()) == 6 and not folder.checkpoints.exists()
    resume(folder)
    assert_same(folder, whole)


def test_parts_of_another_run_are_not_taken(copy, tmp_path):
    other = RunFolder(tmp_path / "other")
    train_until_stopped(other.path, seed=1)
    newest = "0000000005.npz"
    for name, said in (
        (
            f"checkpoints/{newest}",
            rf"{newest} belongs to a run with another config\.json: see",
        ),
        ("episodes.csv", r"episodes\.csv does not match the checkpoint"),
    ):
        mine = (copy.path / name).read_bytes()
        shutil.copy(other.path / name, copy.path / name)
        with pytest.raises(ValueError, match=said):
            resume(copy)
        (copy.path / name).write_bytes(mine)
    summary = {"status": "finished", "final_score": 1.0, "env_steps": 1, "wall_s": 1.0}
    summary |= {"steps_per_s": 1.0, "episodes": 1, "flagged_fraction": 0.0}
    summary |= {"score_window": 50, "seed": 1}
    (copy.path / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(ValueError, match=r"summary\.json belongs to another .* seed"):
        resume(copy)


@pytest.mark.slow
def test_a_full_disk_is_named_and_the_run_goes_on_when_it_is_no_longer(
    copy, whole, monkeypatch
):
    real = np.savez

    def full(file, **arrays):
        real(file, **arrays)
        file.truncate(100)
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(OSError, match=r"No space left") as error:
            resume(copy, checkpoint_seconds=0)
    assert error.value.filename == str(copy.checkpoints / "0000000006.npz")
    assert not list(copy.path.rglob("*.partial"))
    resume(copy)
    assert_same(copy, whole)
