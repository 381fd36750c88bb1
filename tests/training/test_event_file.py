"""The event file of a run: every row once, however often the run was stopped."""

import csv
import struct

import numpy as np
import pytest

from commands import run, run_json  # noqa: F401
from jaxrod.envs.trivial import Trivial
from jaxrod.training import PPOConfig, train
from jaxrod.training.runs.event_file import EventFile
from missing import pretend_missing

event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
STEPS = 128 * 8
TINY = ("--steps", "2k", "--num-envs", "8", "--set", "rollout_steps=32", "--no-replay")


def trained(out, **changed):
    asked = {"log": "tensorboard", "checkpoint_seconds": 0, "evaluation_episodes": 2}
    return train(
        Trivial(),
        steps=STEPS,
        out=out,
        config=SMALL,
        chunk_steps=128,
        progress=False,
        **{**asked, **changed},
    )


def checksum(content):
    """Castagnoli's cyclic redundancy check, bit by bit, masked as records keep it."""
    crc = 0xFFFFFFFF
    for byte in content:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def events(out):
    """All events in the folder of a run, in the order TensorBoard reads them."""
    found = []
    for file in sorted((out / "tensorboard").iterdir()):
        content = file.read_bytes()
        while content:
            length, of_length = struct.unpack("<QI", content[:12])
            message, rest = content[12 : 12 + length], content[12 + length :]
            (of_message,) = struct.unpack("<I", rest[:4])
            assert (of_length, of_message) == (
                checksum(content[:8]),
                checksum(message),
            )
            found.append(event_pb2.Event.FromString(message))
            content = rest[4:]
    return found


def scalars(out):
    """(step, name, value) of all scalars."""
    return [
        (event.step, value.tag, value.simple_value)
        for event in events(out)
        for value in event.summary.value
    ]


def rows(out):
    """The same of the table of progress, as 32-bit numbers."""
    with (out / "progress.csv").open() as stream:
        return [
            (int(row["env_steps"]), name, float(np.float32(value)))
            for row in csv.DictReader(stream)
            for name, value in row.items()
            if name not in ("env_steps", "wall_s") and value != ""
        ]


@pytest.mark.slow
def test_the_file_holds_the_table_of_progress_and_the_evaluation(tmp_path):
    result = trained(tmp_path)
    expected = rows(tmp_path)
    assert len({step for step, _, _ in expected}) == 8
    score = (STEPS, "evaluation_score", float(np.float32(result.evaluation.mean)))
    assert scalars(tmp_path) == [*expected, score]
    first = events(tmp_path)[0]
    assert first.file_version == "brain.Event:2"
    # As far apart in time as the chunks were.
    times = [event.wall_time for event in events(tmp_path) if event.summary.value]
    walls = [row["wall_s"] for row in result.progress]
    np.testing.assert_allclose(np.diff(times)[:-1], np.diff(walls), atol=1e-6)


@pytest.mark.slow
def test_a_run_killed_between_row_and_checkpoint_has_no_step_twice(
    tmp_path, monkeypatch
):
    taken = []

    def killed(self, row):
        append(self, row)
        taken.append(row)
        if len(taken) == 5:
            raise RuntimeError("killed")

    append = EventFile.append
    with monkeypatch.context() as patch:
        patch.setattr(EventFile, "append", killed)
        with pytest.raises(RuntimeError, match="killed"):
            trained(tmp_path)
    assert {step for step, _, _ in scalars(tmp_path)} == {128 * k for k in range(1, 6)}
    trained(tmp_path, resume=True)
    found = [one for one in scalars(tmp_path) if one[1] != "evaluation_score"]
    assert found == rows(tmp_path)
    assert len({one[:2] for one in found}) == len(found)


@pytest.mark.slow
def test_a_run_that_began_without_gets_its_whole_history(tmp_path):
    trained(tmp_path, log=None)
    assert not (tmp_path / "tensorboard").exists()
    trained(tmp_path, resume=True)
    assert scalars(tmp_path)[:-1] == rows(tmp_path)


@pytest.mark.slow
def test_an_event_file_of_somebody_else_stays(tmp_path):
    trained(tmp_path)
    other = tmp_path / "tensorboard" / "events.out.tfevents.1.somewhere"
    other.write_bytes(b"")
    trained(tmp_path, log=None, overwrite=True)
    assert list((tmp_path / "tensorboard").iterdir()) == [other]


def test_what_cannot_be_logged_is_said_before_anything_is_done(tmp_path):
    with pytest.raises(ValueError, match="log='tensorboard' needs a folder"):
        trained(None)
    with pytest.raises(ValueError, match="a function or 'tensorboard', got 'wandb'"):
        trained(tmp_path / "run", log="wandb")
    assert not (tmp_path / "run").exists()


def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch):
    pretend_missing(monkeypatch, "tensorboardX")
    with pytest.raises(ModuleNotFoundError, match=r'"jaxrod\[tensorboard\]"'):
        trained(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_command_says_which_extra_is_missing(tmp_path, monkeypatch, run):  # noqa: F811
    pretend_missing(monkeypatch, "tensorboardX")
    out = tmp_path / "run"
    code, _, said = run("train", "trivial", *TINY, "--out", out, "--log", "tensorboard")
    assert code == 2
    assert "tensorboardX is needed and not installed" in said
    assert 'pip install "jaxrod[tensorboard]"' in said
    assert not out.exists()


@pytest.mark.slow
def test_the_command_logs_and_a_resumed_run_goes_on_logging(tmp_path, run_json):  # noqa: F811
    words = ("train", "trivial", "--out", tmp_path, "--json", "--no-replay")
    run_json(*words, *TINY, "--log", "tensorboard")
    begun = sorted((tmp_path / "tensorboard").iterdir())
    assert scalars(tmp_path)[:-1] == rows(tmp_path)
    run_json(*words, "--resume")
    assert sorted((tmp_path / "tensorboard").iterdir()) != begun
    assert scalars(tmp_path)[:-1] == rows(tmp_path)
    last = sorted((tmp_path / "tensorboard").iterdir())
    run_json(*words, "--resume", "--log", "none")
    assert sorted((tmp_path / "tensorboard").iterdir()) == last
    run_json(*words, *TINY, "--overwrite")
    assert not (tmp_path / "tensorboard").exists()
