"""Automatic widening: the share moves as the rule says, and runs with it resume."""

import csv
import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import envs
from jaxrod.training import PPOConfig, train
from jaxrod.training.runs.widening import Widening, check_holds_params

SMALL = PPOConfig(
    num_envs=8, rollout_steps=16, epochs=2, minibatches=2, hidden_sizes=(8,)
)
VARIED = {
    "parameters": {
        "stride": {"uniform": [0.5, 1.5], "scaled": True},
        "edge": {"normal": [3.0, 0.1]},
    },
    "noise": {"position": 0.1},
    "dropout": {"position": 0.5},
    "delay": [1, 3],
    "lag": [0.5, 2.0],
    "saturation": [0.3, 0.6],
}
pytestmark = pytest.mark.default_precision


def task(**rule):
    widening = {"widening": rule} if rule else {}
    return envs.make("trivial", randomise=VARIED | widening)


def run_of(env, params, steps=6):
    """Observations, rewards and parameters of an episode with random actions."""
    found = []
    observation, state = env.reset(jax.random.key(3), params)
    for k in range(steps):
        action = jax.random.uniform(jax.random.key(k), (1,), minval=-1.0)
        out = env.step(jax.random.fold_in(jax.random.key(5), k), state, action, params)
        found.append((observation, out[2]))
        observation, state = out[:2]
    return found, state


@pytest.mark.slow
def test_a_share_of_zero_is_the_nominal_task_and_of_one_the_full_one():
    wide = task(above=0.0)
    params = wide.default_params()
    assert float(params.share) == 1.0
    plain = envs.make("trivial")
    # Without their keys' own draws, observations of both start alike.
    for share, other in ((0.0, plain), (1.0, task())):
        own = dataclasses.replace(params, share=jnp.float32(share))
        ours, state = run_of(wide, own)
        theirs, _ = run_of(other, other.default_params())
        for one, two in zip(ours, theirs, strict=True):
            for a, b in zip(one, two, strict=True):
                np.testing.assert_array_equal(a, b)
    assert float(state.share) == 1.0


@pytest.mark.parametrize("share", [0.25, 0.7])
def test_draws_are_that_share_of_the_way_from_the_nominal(share):
    wide = task(above=0.0)
    params = wide.default_params()
    part = dataclasses.replace(params, share=jnp.float32(share))
    nominal = {"delay": 0, "lag": 0, "saturation": 1}
    for k in range(5):
        key = jax.random.key(k)
        whole, some = (wide.reset(key, p)[1] for p in (params, part))
        full, drawn = (
            wide.task_params(state, p) for state, p in ((whole, params), (some, part))
        )
        for name in ("stride", "edge"):
            first = getattr(params.task, name)
            expected = first + share * (getattr(full, name) - first)
            np.testing.assert_allclose(getattr(drawn, name), expected, rtol=1e-6)
        for name, usual in nominal.items():
            expected = usual + share * (whole.actuator[name] - usual)
            if name == "delay":
                expected = np.floor(expected)
            np.testing.assert_allclose(some.actuator[name], expected, rtol=1e-6)


@pytest.mark.slow
def test_noise_and_dropout_shrink_with_the_share():
    sensors = {name: VARIED[name] for name in ("noise", "dropout")}
    wide = envs.make("trivial", randomise=sensors | {"widening": {"above": 0.0}})
    params = wide.default_params()
    for share in (0.0, 0.5, 1.0):
        own = dataclasses.replace(params, share=jnp.float32(share))

        def seen(key, own=own):
            observation, state = wide.reset(key, own)
            _, later, *_ = wide.step(key, state, jnp.ones(1), own)
            held = later.seen == observation
            return observation - state.clean, held

        noise, held = jax.vmap(seen)(jax.random.split(jax.random.key(0), 4000))
        np.testing.assert_allclose(np.std(noise), 0.1 * share, rtol=0.06)
        np.testing.assert_allclose(np.mean(held), 0.5 * share, atol=0.03)


def test_the_share_moves_by_means_over_new_episodes():
    rule = {"above": 5.0, "below": 1.0, "start": 0.5, "step": 0.2, "episodes": 3}
    found = Widening(rule)
    shares = []
    for chunk in ([6, 6], [6], [2, 2, 2], [9, 0], [0], [0, 0, 0], [0] * 9, [7] * 3):
        found.take([float(x) for x in chunk])
        shares.append(round(found.share, 6))
    assert shares == [0.5, 0.7, 0.7, 0.7, 0.7, 0.5, 0.3, 0.5]
    for _ in range(9):
        found.take([9.0] * 3)
    assert found.share == 1.0


RULE = {"above": -1e9, "start": 0.05, "step": 0.3, "episodes": 10}


def trained(folder, **more):
    env = envs.make(
        "trivial", randomise={"parameters": VARIED["parameters"], "widening": RULE}
    )
    quiet = {"progress": False, "evaluation_episodes": 0, "chunk_steps": 256}
    return train(env, steps=128 * 20, config=SMALL, out=folder, **quiet, **more)


def test_a_run_widens_and_says_how_far(tmp_path):
    whole = trained(tmp_path / "run")
    shares = [row["randomisation_share"] for row in whole.progress]
    # Episodes of 20 control steps, 12 in each chunk: most chunks widen.
    assert shares[0] < shares[-1] == whole.summary["randomisation_share"] == 1.0
    assert {round(b - a, 6) for a, b in pairwise(shares)} <= {
        0.0, 0.3, 0.05
    }  # fmt: skip
    assert float(whole.state.env_params.share) == 1.0
    again = Widening(RULE)
    with (tmp_path / "run" / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    before = [row for row in rows if int(row["env_steps"]) <= 768]
    again.take_again(before)
    assert again.share == shares[2] < 1.0
    again.take_again(rows[len(before) :])
    assert again.share == 1.0


@pytest.mark.slow
def test_a_run_that_widens_resumes_bit_for_bit(tmp_path):
    whole = trained(tmp_path / "whole")

    def stop(row):
        if row["env_steps"] >= 768:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "cut", log=stop, checkpoint_seconds=0)
    again = trained(tmp_path / "cut", resume=True)
    for a, b in zip(
        jax.tree.leaves(whole.state), jax.tree.leaves(again.state), strict=True
    ):
        np.testing.assert_array_equal(
            *(
                jax.random.key_data(x)
                if jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
                else x
                for x in (a, b)
            )
        )
    tables = []
    for name in ("whole", "cut"):
        with (tmp_path / name / "progress.csv").open() as file:
            tables.append([row["randomisation_share"] for row in csv.DictReader(file)])
    assert tables[0] == tables[1]


def test_an_algorithm_without_the_parameters_cannot_widen():
    params = task(above=0.0).default_params()
    check_holds_params({"weights": jnp.ones(3), "env": [params]}, "own")
    with pytest.raises(ValueError, match=r"widening needs an algorithm whose.* own"):
        check_holds_params({"weights": jnp.ones(3)}, "own")


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ({"start": 0.5}, "widening needs above"),
        ({"above": 1.0, "bellow": 0.0}, "no option 'bellow'"),
        ({"above": 1.0, "below": 2.0}, "below of widening must be less than above"),
        ({"above": 1.0, "step": 0.0}, "step of widening must be above 0"),
        ({"above": 1.0, "start": 1.5}, "start of widening"),
        ({"above": 1.0, "episodes": 0}, "episodes of widening"),
        ({"above": float("nan")}, "above of widening"),
    ],
)
def test_bad_rules_are_refused(rule, words):
    with pytest.raises(ValueError, match=words):
        envs.Randomisation(**VARIED, widening=rule)
