"""`jaxrod evaluate`: the numbers of the policy, and what cannot be evaluated."""

import shutil

import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.training import PPOConfig, train


def test_json_holds_every_return_and_their_mean(trained, run_json):
    found = run_json("evaluate", trained[0], "--episodes", 7, "--json")
    assert found["episodes"] == len(found["returns"]) == len(found["lengths"]) == 7
    assert found["score"] == pytest.approx(np.mean(found["returns"]))
    assert found["score_std"] == pytest.approx(np.std(found["returns"]))
    assert found["flagged_fraction"] == 0
    assert (found["task"], found["algorithm"]) == ("trivial", "ppo")


def test_the_seed_decides_the_episodes(trained, run_json):
    first, again, other = (
        run_json("evaluate", trained[0], "--episodes", 3, "--seed", s, "--json")
        for s in (1, 1, 2)
    )
    assert first["returns"] == again["returns"]
    assert first["returns"] != other["returns"]


def test_the_text_says_what_was_measured(trained, run):
    code, out, _ = run("evaluate", trained[0], "--episodes", 3)
    assert code == 0
    assert "trivial, ppo, seed 3: 3 episodes" in out
    assert "±" in out


@pytest.mark.slow
def test_a_run_can_be_evaluated_while_it_trains(tmp_path, run_json):
    scores = []

    def look(row):
        if row["env_steps"] > 512:  # after the first checkpoint
            scores.append(run_json("evaluate", tmp_path, "--json")["score"])

    train(
        make("trivial"),
        steps=1024,
        config=PPOConfig(num_envs=8, rollout_steps=64),
        out=tmp_path,
        chunk_steps=512,
        checkpoint_seconds=0,
        evaluation_episodes=0,
        progress=False,
        log=look,
    )
    assert len(scores) == 1


def damage_config(folder):
    (folder / "config.json").write_text('{"task": "tri')


def forget_the_task(folder):
    (folder / "config.json").write_text("{}")


def damage_policy(folder):
    (folder / "policy" / "policy.npz").write_bytes(b"PK\x03\x04 torn")


def damage_policy_description(folder):
    (folder / "policy" / "policy.json").write_text("{}")


def remove_policy(folder):
    shutil.rmtree(folder / "policy")


def change_the_task(folder):
    text = (folder / "config.json").read_text()
    text = text.replace('"task": "trivial"', '"task": "tracking"')
    text = text.replace('"variant": null', '"variant": "paper"')
    (folder / "config.json").write_text(text)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("break_it", "sentence"),
    [
        (damage_config, "config.json is damaged"),
        (forget_the_task, "config.json is damaged: it has no 'task'"),
        (damage_policy, "policy.npz is damaged: it is torn"),
        (damage_policy_description, "policy.json is damaged: it is of format None"),
        (remove_policy, "no policy yet"),
        (change_the_task, "config.json: its task is 'trivial'"),
        (shutil.rmtree, "does not exist"),
    ],
)
@pytest.mark.parametrize("command", ["evaluate", "render"])
def test_a_damaged_run_is_one_sentence(
    command, break_it, sentence, trained, run, tmp_path
):
    folder = tmp_path / "run"
    shutil.copytree(trained[0], folder)
    break_it(folder)
    code, _, err = run(command, folder)
    assert code == 2
    assert err.startswith(f"jaxrod {command}: ")
    assert sentence in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--episodes", "0"], "episodes must be at least 1, got 0"),
        (["--seed", "-2"], "seed must be an integer from 0 to 4294967295, got -2"),
    ],
)
def test_impossible_numbers_are_named(words, sentence, trained, run):
    code, _, err = run("evaluate", trained[0], *words)
    assert code == 2
    assert sentence in err


@pytest.mark.slow
def test_noise_costs_something(trained, run, run_json):
    words = ("evaluate", trained[0], "--episodes", 64)
    quiet, noisy = (run_json(*words, *more, "--json") for more in ([], ["--noisy"]))
    assert (quiet["noisy"], noisy["noisy"]) == (False, True)
    assert noisy["score"] < quiet["score"] - 0.1
    code, out, _ = run(*words, "--noisy")
    assert code == 0 and "64 episodes of the policy with noise" in out
