"""The contracts of bare environments and of the registry."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make, names
from jaxrod.envs.trivial import Trivial


def run_episode(env, key, policy):
    params = env.default_params()
    observation, state = env.reset(key, params)
    total, steps, ended = 0.0, 0, False
    step = jax.jit(env.step)
    while not ended:
        key, sub = jax.random.split(key)
        observation, state, reward, terminated, truncated, _ = step(
            sub, state, policy(observation), params
        )
        total, steps = total + float(reward), steps + 1
        ended = bool(terminated) or bool(truncated)
    return total, steps, bool(terminated), bool(truncated)


def test_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"tracking.*trivial.*'nonsense'"):
        make("nonsense")
    assert "trivial" in names()


@pytest.mark.parametrize("name", names())
def test_an_option_it_does_not_have_is_refused_with_those_it_has(name):
    with pytest.raises(ValueError, match=rf"'{name}' has no option 'foo', it has .*ep"):
        make(name, foo=2)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", names())
def test_an_action_of_another_size_is_refused_in_words(name):
    env = make(name)
    params = env.default_params()
    key = jax.random.key(0)
    _, state = jax.eval_shape(env.reset, key, params)
    size = env.action_size
    for shape in ((), (size + 1,), (2, 6)):
        words = re.escape(f"action must have shape ({size},), got {shape}")
        with pytest.raises(ValueError, match=words):
            jax.eval_shape(env.step, key, state, jnp.zeros(shape), params)


def test_equal_environments_are_one_static_argument():
    assert hash(make("trivial")) == hash(Trivial())
    assert make("trivial") == Trivial()
    assert make("trivial", episode_length=3) != Trivial()


def test_bare_environment_truncates_at_its_episode_length():
    env = Trivial(episode_length=7)
    _, steps, terminated, truncated = run_episode(
        env, jax.random.key(0), lambda observation: jnp.zeros(1)
    )
    assert (steps, terminated, truncated) == (7, False, True)


def test_running_off_the_line_terminates():
    env = Trivial(episode_length=50)
    _, steps, terminated, truncated = run_episode(
        env, jax.random.key(0), lambda observation: jnp.ones(1)
    )
    assert terminated and not truncated and steps <= 16


def test_best_policy_earns_the_stated_optimum():
    env = Trivial()
    params = env.default_params()

    def episode(key):
        def step(state, _):
            action = jnp.clip(-state.position[None] / params.stride, -1, 1)
            _, state, reward, *_ = env.step(key, state, action, params)
            return state, reward

        _, state = env.reset(key, params)
        return jnp.sum(jax.lax.scan(step, state, length=env.episode_length)[1])

    returns = jax.vmap(episode)(jax.random.split(jax.random.key(1), 20_000))
    np.testing.assert_allclose(np.mean(returns), env.optimal_return, atol=0.01)


def test_return_is_differentiable_in_the_actions():
    env = Trivial(episode_length=3)
    params = env.default_params()

    def total(actions):
        _, state = env.reset(jax.random.key(0), params)
        total = 0.0
        for action in actions:
            _, state, reward, *_ = env.step(jax.random.key(0), state, action, params)
            total += reward
        return total

    gradient = jax.grad(total)(jnp.zeros((3, 1)))
    start = float(env.reset(jax.random.key(0), params)[1].position)
    expected = [-2 * start * 0.2 * remaining for remaining in (3, 2, 1)]
    np.testing.assert_allclose(gradient[:, 0], expected, rtol=1e-5)
