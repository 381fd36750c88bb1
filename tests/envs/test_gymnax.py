"""Learners written for gymnax see what the functional environments do."""

import dataclasses
import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import ActionRepeat, make
from jaxrod.envs.gymnax_env import GymnaxEnv
from jaxrod.envs.trivial import Trivial

pytestmark = pytest.mark.default_precision


@dataclasses.dataclass(frozen=True)
class Breaking(Trivial):
    """The point on a line; its reward is not a number where the action is 1."""

    def step(self, key, state, action, params):
        observation, state, reward, *others = super().step(key, state, action, params)
        return observation, state, jnp.where(action[0] == 1, jnp.nan, reward), *others


def functional(env, key, state, action, params):
    """A step and a restart by hand, as gymnax splits the key."""
    moving, restarting = jax.random.split(key)
    step = env.step(moving, state, action, params)
    return step, env.reset(restarting, params)


def test_steps_and_restarts_are_those_of_the_functional_environment():
    task, env = make("trivial"), GymnaxEnv("trivial")
    params = env.default_params
    observation, state = jax.jit(env.reset)(jax.random.key(3), params)
    np.testing.assert_array_equal(
        observation, task.reset(jax.random.key(3), params.task)[0]
    )
    one, by_hand = jax.jit(env.step), jax.jit(functools.partial(functional, task))
    terminations = truncations = 0
    for number in range(60):
        key = jax.random.key(number)
        action = jnp.array([1.0 if number < 25 else 0.0])
        wanted, fresh = by_hand(key, state.task, action, params.task)
        seen, after, reward, terminated, truncated, info = wanted
        observation, state, paid, done, known = one(key, state, action, params)
        assert bool(done) == bool(terminated | truncated)
        shown, inside = fresh if done else (seen, after)
        np.testing.assert_array_equal(observation, shown)
        np.testing.assert_array_equal(state.observation, shown)
        np.testing.assert_array_equal(state.final_observation, seen)
        jax.tree.map(np.testing.assert_array_equal, state.task, inside)
        assert paid == reward and known["truncated"] == (truncated & ~terminated)
        assert (state.time == 0) == done
        for name in info:
            assert known[name] == info[name]
        terminations += int(terminated)
        truncations += int(truncated)
    assert terminations > 0 and truncations > 0


def test_numbers_that_are_not_finite_end_the_episode_unseen():
    env = GymnaxEnv(Breaking())
    params = env.default_params
    before, state = env.reset(jax.random.key(0), params)
    _, after, reward, done, info = env.step(
        jax.random.key(1), state, jnp.ones(1), params
    )
    assert done and info["truncated"] and info["flagged"] and not info["terminated"]
    assert reward == 0
    np.testing.assert_array_equal(after.final_observation, before)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("given", [True, False], ids=["params", "None"])
def test_a_learner_scans_a_batch_under_jit(given):
    """Types and structures stay. Keys may be raw or typed, and parameters left out."""
    env = GymnaxEnv("trivial", episode_length=5)
    traces = []

    @jax.jit
    def train(keys, params):
        traces.append(0)
        reset = jax.vmap(env.reset, (0, None))
        step = jax.vmap(env.step, (0, 0, 0, None))

        def one(carry, _):
            observation, state = carry
            action = jnp.clip(-observation, -1, 1)
            observation, state, *rest = step(keys, state, action, params)
            return (observation, state), (observation, rest)

        return jax.lax.scan(one, reset(keys, params), length=12)

    params = env.default_params if given else None
    raw = jax.random.split(jax.random.PRNGKey(0), 4)
    (_, state), (seen, (reward, done, info)) = train(raw, params)
    assert seen.shape == (12, 4, 1) and reward.dtype == seen.dtype == jnp.float32
    np.testing.assert_array_equal(np.flatnonzero(done.all(axis=1)), [4, 9])
    assert done.sum() == info["truncated"].sum() == 8
    assert state.time.tolist() == [2] * 4
    _, (again, _) = train(jax.random.wrap_key_data(raw), params)
    np.testing.assert_array_equal(again, seen)
    _, (usual, _) = train(raw, env.default_params)
    np.testing.assert_allclose(usual, seen, rtol=1e-6)
    if given:
        count = len(traces)
        shorter = dataclasses.replace(params, max_steps_in_episode=jnp.int32(3))
        longer = dataclasses.replace(params, max_steps_in_episode=jnp.int32(9))
        _, (_, (_, done, _)) = train(raw, shorter)
        np.testing.assert_array_equal(np.flatnonzero(done.all(axis=1)), [2, 5, 8, 11])
        _, (_, (_, done, _)) = train(raw, longer)
        np.testing.assert_array_equal(np.flatnonzero(done.all(axis=1)), [4, 9])
        assert len(traces) == count + 1  # an integer becomes an array once


def test_held_actions_count_as_several_control_steps():
    env = GymnaxEnv(ActionRepeat(make("trivial"), 4))
    _, state = env.reset(jax.random.key(0))
    _, state, *_ = env.step(jax.random.key(0), state, jnp.zeros(1))
    assert state.time == 4


def test_spaces_are_those_of_the_task():
    env = GymnaxEnv("tracking", variant="clean", episode_length=7)
    params = env.default_params
    assert (env.name, env.num_actions) == ("tracking", 12)
    assert params.max_steps_in_episode == 7
    actions, seen = env.action_space(params), env.observation_space(params)
    assert (actions.low, actions.high, actions.shape) == (-1, 1, (12,))
    assert seen.shape == (44,) and seen.dtype == jnp.float32
    drawn = actions.sample(jax.random.key(0))
    assert actions.contains(drawn) and not actions.contains(3 * drawn)


def test_bad_input_is_refused_in_words():
    with pytest.raises(ValueError, match=r"no options, got .*variant"):
        GymnaxEnv(make("trivial"), variant="clean")
    env = GymnaxEnv("trivial")
    _, state = env.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"shape \(1,\), got \(2,\)"):
        env.step(jax.random.key(0), state, jnp.zeros(2))


@pytest.mark.slow
def test_nothing_is_imported_from_gymnax():
    program = (
        "import sys, jaxrod.envs.gymnax_env\n"
        "assert not {'gymnax', 'chex', 'flax', 'gymnasium'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.slow
def test_ppo_of_rejax_improves_on_tracking_as_ours_does():
    """At least half the gain of our PPO in 200,000 steps, from -104 to -46."""
    rejax = pytest.importorskip("rejax", reason="rejax is not installed")
    learner = rejax.get_algo("ppo").create(
        env=GymnaxEnv("tracking", variant="clean", episode_length=250),
        total_timesteps=196_608,
        eval_freq=98_304,
        num_envs=64,
        num_steps=64,
        num_epochs=8,
        num_minibatches=4,
        learning_rate=1e-3,
        gamma=0.98,
        ent_coef=0.0,
        max_grad_norm=0.5,
        normalize_observations=True,
        normalize_rewards=True,
    )
    _, (lengths, returns) = jax.jit(learner.train)(jax.random.PRNGKey(0))
    assert np.all(lengths == 250)
    assert returns[-1].mean() > -75
