"""Actions held for several control steps: the same steps, the same score and clock."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import ActionRepeat, VectorEnvironment
from jaxrod.envs.trivial import Trivial
from jaxrod.training import SACConfig, train


def play(env, actions, key):
    """Steps one environment; its key in step t is `fold_in(key, t)`."""
    params = env.default_params()
    step = jax.jit(env.step)
    _, state = env.reset(key, params)
    outcomes = []
    for number, action in enumerate(actions):
        outcome = step(jax.random.fold_in(key, number), state, action, params)
        state = outcome[1]
        outcomes.append(outcome)
    return outcomes


def test_a_held_action_is_the_same_action_several_times():
    env = Trivial(episode_length=50)
    actions = jax.random.uniform(jax.random.key(1), (4, env.action_size), minval=-1.0)
    single = play(env, jnp.repeat(actions, 3, axis=0), jax.random.key(0))
    held = play(ActionRepeat(env, 3), actions, jax.random.key(0))
    for k, outcome in enumerate(held):
        last = single[3 * k + 2]
        np.testing.assert_allclose(outcome[0], last[0], rtol=1e-12, atol=1e-12)
        rewards = sum(step[2] for step in single[3 * k : 3 * k + 3])
        assert float(outcome[2]) == pytest.approx(float(rewards), rel=1e-12)
        assert int(outcome[5]["control_steps"]) == 3


def test_an_episode_ends_where_it_would_and_counts_no_step_twice():
    env = Trivial(episode_length=7)
    actions = 0.1 * jnp.ones((3, env.action_size))
    outcomes = play(ActionRepeat(env, 3), actions, jax.random.key(0))
    alone = play(env, 0.1 * jnp.ones((7, env.action_size)), jax.random.key(0))
    assert [int(o[5]["control_steps"]) for o in outcomes] == [3, 3, 1]
    assert [bool(o[4]) for o in outcomes] == [False, False, True]
    total = sum(float(o[2]) for o in outcomes)
    assert total == pytest.approx(sum(float(o[2]) for o in alone), rel=1e-12)
    np.testing.assert_allclose(outcomes[-1][0], alone[-1][0], rtol=1e-12, atol=1e-12)


def test_a_batch_keeps_its_clock_in_control_steps():
    env = Trivial(episode_length=7)
    batch, params = VectorEnvironment(ActionRepeat(env, 3)), env.default_params()
    state = batch.reset(jax.random.key(0), 2, params)
    step, seen = jax.jit(batch.step), []
    for _ in range(6):
        state, outcome = step(state, jnp.zeros((2, env.action_size)), params)
        seen.append(outcome.episodes)
    assert [bool(e.finished[0]) for e in seen] == [False, False, True] * 2
    assert int(seen[2].length[1]) == 7
    assert int(seen[5].length[0]) == 7


def test_an_action_is_held_at_least_once():
    with pytest.raises(ValueError, match="times must be at least 1, got 0"):
        ActionRepeat(Trivial(), 0)


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_run_counts_control_steps():
    config = SACConfig(
        num_envs=8, rollout_steps=8, action_repeat=2, buffer_size=512, gradient_steps=2
    )
    with jax.enable_x64(False):
        found = train(
            Trivial(),
            "sac",
            steps=512,
            config=config,
            progress=False,
        )
    assert found.summary["env_steps"] == 512
    assert int(found.state.updates) == 4
    lengths = set(found.episodes.lengths)
    assert lengths == {Trivial().episode_length}
