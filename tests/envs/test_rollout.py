"""Rollouts: the plain loop's results and gradients, with less memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make, rollout
from jaxrod.structure import pytree

KEY = jax.random.key(5)


def plain(env, start, actions, params, key=KEY):
    def one(carry, given):
        _, state = carry
        index, action = given
        seen, state, reward, *_ = env.step(
            jax.random.fold_in(key, index), state, action, params
        )
        return (seen, state), reward

    return jax.lax.scan(one, start, (jnp.arange(len(actions)), actions))


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 37])
def test_results_and_gradients_are_the_plain_loops(steps):
    env = make("trivial", episode_length=100)
    params = env.default_params()
    start = env.reset(jax.random.key(0), params)
    actions = jnp.asarray(np.random.default_rng(0).uniform(-0.3, 0.3, (steps, 1)))

    def ours(actions):
        return jnp.sum(rollout(env, start, actions, params, key=KEY).reward)

    def theirs(actions):
        return jnp.sum(plain(env, start, actions, params)[1])

    (seen, state), rewards = plain(env, start, actions, params)
    found = rollout(env, start, actions, params, key=KEY)
    np.testing.assert_allclose(found.reward, rewards, rtol=1e-14)
    np.testing.assert_allclose(found.observation, seen, rtol=1e-14)
    assert int(found.state.steps) == int(state.steps) == steps
    assert bool(found.running.all())
    np.testing.assert_allclose(
        jax.grad(ours)(actions), jax.grad(theirs)(actions), rtol=1e-12
    )


def test_ends_may_be_bools_of_python():
    class Endless:
        name, observation_size, action_size, episode_length = "endless", 1, 1, 9

        def step(self, key, state, action, params):
            return action, state + 1, 1.0, False, False, {}

    start = jnp.zeros(1), jnp.zeros((), int)
    found = rollout(Endless(), start, jnp.ones((3, 1)), None, key=KEY)
    assert found.running.tolist() == [True, True, True]


def test_an_episode_that_ends_stays_as_it_is():
    env = make("trivial", episode_length=5)
    params = env.default_params()
    start = env.reset(jax.random.key(0), params)
    found = rollout(
        env,
        start,
        jnp.zeros((8, 1)),
        params,
        collect=lambda state: state.steps,
    )
    np.testing.assert_array_equal(found.collected, [1, 2, 3, 4, 5, 5, 5, 5])
    np.testing.assert_array_equal(found.running, [True] * 4 + [False] * 4)
    assert np.all(np.asarray(found.reward[5:]) == 0) and found.reward[4] > 0


@pytree
class Counting:
    """Remembers how often it was asked."""

    gain: jax.Array

    def init(self, observation, state):
        return jnp.zeros(observation.shape[0])

    def act(self, memory, observation, state):
        return -self.gain * (memory[:, None] + 0 * observation), memory + 1


@pytree
class Holding(Counting):
    action_repeat = 3


def test_policies_act_with_and_without_memory():
    env = make("trivial", episode_length=100)
    params = env.default_params()
    start = env.reset(jax.random.key(0), params)

    def places(policy):
        found = rollout(
            env, start, policy, params, 6, collect=lambda state: state.position
        )
        return np.diff(np.concatenate([[start[1].position], found.collected])) / 0.2

    asked = places(Counting(jnp.asarray(0.1)))
    np.testing.assert_allclose(asked, -0.1 * np.arange(6), atol=1e-12)
    held = places(Holding(jnp.asarray(0.1)))
    np.testing.assert_allclose(held, [0, 0, 0, -0.1, -0.1, -0.1], atol=1e-12)
    # A plain function sees one observation, and is clipped.
    far = places(lambda observation: 3 * jnp.sign(observation))
    np.testing.assert_allclose(far, np.sign(start[1].position) * np.ones(6), atol=1e-12)


@pytest.mark.slow
def test_a_policy_is_differentiable():
    env = make("trivial", episode_length=100)
    params = env.default_params()
    start = env.reset(jax.random.key(0), params)

    def total(gain):
        found = rollout(env, start, lambda seen: -gain * seen, params, 11)
        return jnp.sum(found.reward)

    slope = jax.grad(total)(0.4)
    differences = (total(0.4 + 1e-6) - total(0.4 - 1e-6)) / 2e-6
    assert slope == pytest.approx(float(differences), rel=1e-7) and slope > 0


def test_what_does_not_fit_is_refused():
    env = make("trivial")
    params = env.default_params()
    start = env.reset(jax.random.key(0), params)
    with pytest.raises(ValueError, match="steps must be given for a policy"):
        rollout(env, start, lambda seen: seen, params)
    with pytest.raises(ValueError, match="steps is 4, but there are 3 actions"):
        rollout(env, start, jnp.zeros((3, 1)), params, 4)
    with pytest.raises(ValueError, match=r"shape \(steps, action_size\).*\(3, 2\)"):
        rollout(env, start, jnp.zeros((3, 2)), params)


@dataclasses.dataclass(frozen=True)
class Wide:
    """A state of many numbers, each pushed by the action."""

    episode_length: int = 10_000
    action_size: int = 1

    def step(self, key, state, action, params):
        state = jnp.sin(state + params * action[0])
        no = jnp.zeros((), bool)
        return state[:1], state, jnp.mean(state**2), no, no, {}


@pytest.mark.slow
def test_memory_grows_as_the_root_of_the_number_of_steps():
    env, start = Wide(), (jnp.zeros(1), jnp.linspace(0.0, 1.0, 2000))

    def ours(actions):
        return jnp.sum(rollout(env, start, actions, 0.1, key=KEY).reward)

    def theirs(actions):
        return jnp.sum(plain(env, start, actions, 0.1)[1])

    def temporary(function, steps):
        compiled = jax.jit(jax.grad(function)).lower(jnp.zeros((steps, 1))).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    # Prime numbers of steps: blocks and a remainder.
    few, more = temporary(ours, 397), temporary(ours, 1597)
    assert few < temporary(theirs, 397) / 4
    assert more < 1.3 * 2 * few


@pytest.mark.slow
def test_a_rods_gradient_is_the_plain_loops():
    env = make("reaching", variant="clean", n_elements=10, substeps=2)
    params = env.default_params()
    start = env.reset(jax.random.key(0), params)

    def ours(actions):
        return jnp.sum(rollout(env, start, actions, params, key=KEY).reward)

    def theirs(actions):
        return jnp.sum(plain(env, start, actions, params)[1])

    actions = 0.2 * jnp.asarray(
        np.random.default_rng(0).uniform(-1, 1, (23, env.action_size))
    )
    expected = jax.jit(jax.grad(theirs))(actions)
    found = jax.jit(jax.grad(ours))(actions)
    scale = float(jnp.abs(expected).max())
    assert scale > 0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * scale)
