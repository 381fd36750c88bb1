"""Episodes of every task: their clock, their end, and what a step returns."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from jaxrod.envs import make, names

SMALLEST = {
    "catheter": {"n_elements": 12},
    "gripper": {"n_elements": 4},
    "octopus": {"n_elements": 4},
    "snake": {"n_elements": 14},
    "trivial": {},
}
"""Options with which a task compiles fast; others have arms of ten elements."""


def smallest(name):
    """The task with an episode of two control steps."""
    return make(name, episode_length=2, **SMALLEST.get(name, {"n_elements": 10}))


# Parameters of systems take long to make.
LONG = ("gripper", "octopus")
CLOCKS = [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in names()]


@pytest.mark.fast_sets(3)
@pytest.mark.parametrize("name", CLOCKS)
def test_the_clock_counts_control_steps(name):
    """Nothing else is compiled."""
    env = smallest(name)
    zeros = lambda tree: jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), tree)
    key, action = jax.random.key(1), jnp.zeros(env.action_size)
    # The gripper chooses contact points by lengths that it must know.
    known = name == "gripper"
    params = env.default_params() if known else jax.eval_shape(env.default_params)
    _, state = jax.eval_shape(env.reset, key, params)
    state = dataclasses.replace(zeros(state), steps=jnp.asarray(7, state.steps.dtype))
    clock = jax.jit(lambda *given: env.step(key, *given)[1].steps)
    assert clock(state, action, zeros(params)) == 8


@pytest.mark.slow
@pytest.mark.parametrize("name", names())
def test_an_episode_is_cut_short_at_its_length_and_not_before(name):
    env = smallest(name)
    params = env.default_params()
    step = jax.jit(env.step)
    observation, state = jax.jit(env.reset)(jax.random.key(1), params)
    assert observation.shape == (env.observation_size,)
    for number in (1, 2):
        key = jax.random.fold_in(jax.random.key(2), number)
        action = 0.1 * jax.random.normal(key, (env.action_size,))
        observation, state, reward, terminated, truncated, info = step(
            key, state, action, params
        )
        assert observation.shape == (env.observation_size,)
        assert jnp.all(jnp.isfinite(observation)) and jnp.isfinite(reward)
        assert not terminated and not info.get("flagged", False)
        assert truncated == (number == 2)


@pytest.mark.parametrize("name", ["tracking", "reaching", "structured", "unstructured"])
def test_the_target_is_drawn_as_large_as_the_distance_of_the_second_bonus(name):
    env = make(name, variant="paper", n_elements=10)
    params = env.default_params()
    assert params.target.radius == params.bonus.touching
    assert params.bonus.touching < params.bonus.near
