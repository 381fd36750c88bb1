"""The loop: interrupted, killed, continued, spread; and what it writes."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import VectorEnvironment
from jaxrod.envs.trivial import Trivial
from jaxrod.training import (
    PPOConfig,
    RunFolder,
    TRPOConfig,
    evaluate,
    find_algorithm,
    load_policy,
    train,
)
from jaxrod.training.progress import ProgressBar, progress_line

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
STEPS = 128 * 30
QUIET = {"progress": False, "evaluation_episodes": 2}

SLOW_RUN = """
import sys, time
from jaxrod.envs.trivial import Trivial
from jaxrod.training import PPOConfig, train
config = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
train(Trivial(), steps=128 * 30, config=config, out=sys.argv[1], chunk_steps=256,
      checkpoint_seconds=0, progress=False, log=lambda row: time.sleep(0.2))
"""

TWO_DEVICES = """
import json, sys
import jax
import jax.numpy as jnp
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_rank_promotion", "raise")
from jaxrod.envs.trivial import Trivial
from jaxrod.training import PPOConfig, train
config = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
assert len(jax.devices()) == 2
result = train(Trivial(), steps=128 * 6, config=config, chunk_steps=1, out=sys.argv[1],
               progress=False, evaluation_episodes=2, checkpoint_seconds=0)
shards = result.state.environments.observation.addressable_shards
assert [shard.data.shape for shard in shards] == [(4, 1), (4, 1)]
"""


def run_python(code, *arguments):
    return subprocess.Popen([sys.executable, "-W", "error", "-c", code, *arguments])


def leaves(tree):
    return [
        np.asarray(
            jax.random.key_data(leaf)
            if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
            else leaf
        )
        for leaf in jax.tree.leaves(tree)
    ]


def assert_same_run(a, b):
    for left, right in zip(leaves(a.state), leaves(b.state), strict=True):
        np.testing.assert_array_equal(left, right)
    assert a.episodes.returns == b.episodes.returns
    assert a.episodes.lengths == b.episodes.lengths
    assert a.summary["final_score"] == b.summary["final_score"]
    assert a.summary["evaluation_score"] == b.summary["evaluation_score"]
    rows = [
        [
            {k: v for k, v in row.items() if k not in ("wall_s", "steps_per_s")}
            for row in result.folder.progress.read()
        ]
        for result in (a, b)
    ]
    assert rows[0] == rows[1]


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    with jax.enable_x64(False):
        yield train(
            Trivial(),
            steps=STEPS,
            config=SMALL,
            out=folder,
            chunk_steps=256,
            **QUIET,
        )


@pytest.mark.default_precision
def test_run_killed_at_any_moment_resumes_bit_by_bit(tmp_path, whole_run):
    folder = RunFolder(tmp_path / "run")
    process = run_python(SLOW_RUN, str(folder.path))
    deadline = time.monotonic() + 120
    while len(folder.progress.read()) < 5 and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    rows = len(folder.progress.read())
    assert 5 <= rows < 15
    result = train(
        Trivial(),
        steps=STEPS,
        config=SMALL,
        out=folder.path,
        resume=True,
        chunk_steps=256,
        **QUIET,
    )
    assert 0 < len(result.progress) <= 15 - rows + 1
    assert_same_run(result, whole_run)


@pytest.mark.default_precision
def test_interrupted_run_finishes_its_chunk_saves_and_resumes(
    tmp_path, whole_run, capsys
):
    def interrupt(row):
        if row["env_steps"] == 256 * 4:
            signal.raise_signal(signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    settings = {"steps": STEPS, "config": SMALL, "out": tmp_path, "chunk_steps": 256}
    stopped = train(
        Trivial(), **settings, log=interrupt, evaluation_episodes=2, progress=True
    )
    assert signal.getsignal(signal.SIGINT) is handler
    assert stopped.summary["status"] == "interrupted"
    assert stopped.summary["env_steps"] == 256 * 4
    assert "stopped after 1,024 steps" in capsys.readouterr().err
    assert load_policy(tmp_path / "policy")(np.zeros((1, 1))).shape == (1, 1)
    resumed = train(Trivial(), **settings, resume=True, **QUIET)
    assert resumed.summary["status"] == "finished"
    assert_same_run(resumed, whole_run)


@pytest.mark.slow
@pytest.mark.default_precision
def test_second_interruption_stops_at_once(tmp_path):
    def interrupt(row):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(Trivial(), steps=STEPS, config=SMALL, log=interrupt, **QUIET)


@pytest.mark.default_precision
def test_finished_run_resumes_to_the_same_result(whole_run):
    again = train(
        Trivial(),
        steps=STEPS,
        config=SMALL,
        out=whole_run.folder.path,
        resume=True,
        chunk_steps=256,
        **QUIET,
    )
    assert again.progress == []
    assert again.summary == whole_run.summary
    assert_same_run(again, whole_run)


@pytest.mark.slow
@pytest.mark.default_precision
def test_two_devices_train_the_same_as_one(tmp_path):
    process = run_python(TWO_DEVICES, str(tmp_path / "two"))
    one = train(
        Trivial(),
        steps=128 * 6,
        config=SMALL,
        chunk_steps=1,
        out=tmp_path / "one",
        **QUIET,
    )
    assert process.wait(timeout=120) == 0
    two = RunFolder(tmp_path / "two")
    for row, other in zip(one.progress, two.progress.read(), strict=True):
        for name in ("value_loss", "return_mean", "action_std", "gradient_norm"):
            np.testing.assert_allclose(float(other[name]), row[name], rtol=1e-3)
    np.testing.assert_allclose(
        [float(row["episode_return"]) for row in two.episodes.read()],
        one.episodes.returns,
        rtol=1e-3,
    )


def test_folder_holds_what_scripts_rely_on(whole_run):
    folder = whole_run.folder
    summary = json.loads((folder.path / "summary.json").read_text())
    assert summary == whole_run.summary
    assert {
        "final_score",
        "env_steps",
        "wall_s",
        "steps_per_s",
        "flagged_fraction",
        "seed",
        "variant",
        "algorithm",
    } <= set(summary)
    assert summary["env_steps"] == STEPS
    assert (summary["task"], summary["algorithm"]) == ("trivial", "ppo")
    with (folder.path / "progress.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0])[:2] == ["env_steps", "wall_s"]
    assert "episode_return_mean" in rows[0]
    assert [int(row["env_steps"]) for row in rows] == list(range(256, STEPS + 1, 256))
    assert folder.config()["settings"]["num_envs"] == 8
    assert not [path for path in folder.path.iterdir() if path.name.startswith(".")]


@pytest.mark.default_precision
def test_a_finished_run_whose_checkpoints_are_gone_is_not_begun_anew(
    tmp_path, whole_run
):
    folder = tmp_path / "run"
    shutil.copytree(whole_run.folder.path, folder)
    shutil.rmtree(folder / "checkpoints")
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    with pytest.raises(ValueError, match="is finished and its checkpoints are gone"):
        train(
            Trivial(),
            steps=STEPS,
            config=SMALL,
            out=folder,
            chunk_steps=256,
            resume=True,
            **QUIET,
        )
    assert before == {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def test_scores_are_the_means_of_the_last_and_of_the_first_episodes(whole_run):
    returns = [float(row["episode_return"]) for row in whole_run.folder.episodes.read()]
    assert returns == whole_run.episodes.returns
    assert len(returns) > 50
    assert whole_run.summary["final_score"] == np.mean(returns[-50:])
    assert whole_run.summary["first_score"] == np.mean(returns[:50])


@pytest.mark.default_precision
def test_exported_policy_earns_the_evaluation_score(whole_run):
    policy = load_policy(whole_run.folder.policy)
    evaluation = evaluate(Trivial(), policy, episodes=2, seed=0)
    assert evaluation.mean == whole_run.summary["evaluation_score"]


@pytest.mark.slow
@pytest.mark.default_precision
def test_evaluation_of_a_plain_function_counts_whole_episodes():
    env = Trivial()
    still = evaluate(env, lambda observation: 0 * observation, episodes=500)
    assert np.all(still.lengths == env.episode_length)
    np.testing.assert_allclose(still.mean, 20 * 2 / 3, atol=1.0)
    away = evaluate(env, lambda observation: 0 * observation + 1, episodes=5)
    assert np.all(away.lengths < env.episode_length)
    assert still.flagged_fraction == 0


@pytest.mark.default_precision
def test_evaluation_holds_actions_as_the_policy_says(whole_run):
    # Straight back towards zero, so that acting late makes a difference.
    back = (np.full((1, 1), -1.0, np.float32), np.zeros(1, np.float32))
    policy = dataclasses.replace(whole_run.policy, layers=(back,), action_repeat=3)
    found = evaluate(Trivial(), policy, episodes=5, seed=4)
    start = VectorEnvironment(Trivial()).reset(
        jax.random.key(4), 5, Trivial().default_params()
    )
    position, returns = np.asarray(start.observation), np.zeros(5)
    for step in range(20):
        if step % 3 == 0:
            action = np.clip(policy(position), -1, 1)
        position = position + 0.2 * action
        returns += 1 - position[:, 0] ** 2
    np.testing.assert_allclose(found.returns, returns, rtol=1e-5)
    np.testing.assert_array_equal(found.lengths, 20)


@pytest.mark.default_precision
def test_folder_with_a_run_is_neither_mixed_nor_lost_by_accident(tmp_path):
    settings = {"steps": 256, "config": SMALL, "out": tmp_path, **QUIET}
    (tmp_path / "notes.txt").write_text("mine")
    train(Trivial(), **settings)
    with pytest.raises(ValueError, match=r"resume=True.*overwrite=True"):
        train(Trivial(), **settings)
    other = dataclasses.replace(SMALL, clip=0.3)
    with pytest.raises(ValueError, match=r"settings\.clip was 0\.2, now 0\.3"):
        train(Trivial(), **(settings | {"config": other}), resume=True)
    (tmp_path / "replay.html").write_text("of the run before")
    train(Trivial(), **settings, overwrite=True)
    assert not (tmp_path / "replay.html").exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(RunFolder(tmp_path).progress.read()) == 1


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_run_may_have_more_steps_than_32_bits_count():
    def interrupt(row):
        signal.raise_signal(signal.SIGINT)

    steps = 3_000_000_000
    settings = {"config": SMALL, "chunk_steps": 128, "log": interrupt, **QUIET}
    found = train(Trivial(), steps=steps, **settings)
    assert found.summary["status"] == "interrupted"
    assert found.summary["env_steps"] == 128
    assert int(found.state.total_updates) == -(-steps // 128)


class Endless(Trivial):
    """Every action earns the same, for ever."""

    def step(self, key, state, action, params):
        seen, state, reward, *_, info = super().step(key, state, action, params)
        never = jnp.zeros((), bool)
        return seen, state, 0 * reward - 0.25, never, never, info


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [SMALL, TRPOConfig(num_envs=8, rollout_steps=16, hidden_sizes=(8,))],
    ids=["ppo", "trpo"],
)
def test_progress_shows_rewards_until_an_episode_ends(config, capsys):
    rows = []
    name = type(config).__name__.removesuffix("Config").lower()
    train(
        Endless(episode_length=10_000),
        name,
        steps=256,
        config=config,
        evaluation_episodes=0,
        log=rows.append,
        devices=jax.devices()[:1],
    )
    assert rows[-1]["episode_return_mean"] is None
    assert {row["reward_mean"] for row in rows} == {-0.25}
    said = capsys.readouterr().err
    assert "reward -0.25 per action, no episode has ended" in said
    assert "rounded up" not in said  # 256 steps are whole updates


def test_progress_line_tells_steps_speed_time_left_and_what_is_reached():
    line = progress_line(2_500_000, 10_000_000, "steps", 50_000, "return 9,876.5")
    for part in ("25%", "2.5M/10M", "50,000 steps/s", "9,876.5", "2.5 min left"):
        assert part in line
    slow = progress_line(25, 100, "steps", 0.5, "")
    assert "0.5 steps/s  2.5 min left" in slow
    unknown = progress_line(1, 100, "steps", 0, "")
    assert "left" not in unknown and "steps/s" not in unknown


def test_progress_in_a_log_file_is_a_few_lines():
    stream = io.StringIO()
    bar = ProgressBar(1000, "steps", stream=stream)
    for done in range(1, 1001):
        bar.update(done, "")
    assert len(stream.getvalue().splitlines()) == 10
    assert "\r" not in stream.getvalue()


def test_importing_bare_folders_says_what_to_import():
    here = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
    for name in ("envs", "training"):
        done = subprocess.run(
            [sys.executable, "-c", f"import {name}"],
            cwd=here,
            capture_output=True,
            text=True,
        )
        assert done.returncode != 0
        assert f"import jaxrod.{name}, not {name}" in done.stderr


def broken(part):
    """PPO with something that is not a number from the second chunk on."""
    usual = find_algorithm("ppo")

    def spoil(leaf, state):
        late = (state.updates > 2) & jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.where(late, jnp.asarray(jnp.nan).astype(leaf.dtype), leaf)

    def update(state, axis_name=None):
        state, metrics = usual.update(state, axis_name)
        spoilt = {k: spoil(v, state) for k, v in metrics.scalars.items()}
        return state, dataclasses.replace(metrics, scalars=spoilt)

    def policy(state):
        return jax.tree.map(lambda leaf: spoil(leaf, state), usual.policy(state))

    changed = {"update": update, "policy": policy}
    return dataclasses.replace(usual, **{part: changed[part]})


@pytest.mark.parametrize(
    ("part", "name"),
    [pytest.param("update", "loss", marks=pytest.mark.slow), ("policy", "policy")],
)
def test_what_diverged_is_said_and_not_saved(tmp_path, part, name):
    with pytest.raises(FloatingPointError, match=f"{name}.* is not a number after 512"):
        train(
            Trivial(),
            broken(part),
            steps=STEPS,
            config=SMALL,
            out=tmp_path / "run",
            chunk_steps=256,
            checkpoint_seconds=0,
            progress=False,
        )
    (kept,) = (tmp_path / "run" / "checkpoints").glob("[0-9]*")
    assert kept.name == "0000000002.npz"
    for weights in jax.tree.leaves(load_policy(tmp_path / "run" / "policy")):
        assert np.isfinite(weights).all()
