"""Goals may be exchanged: rewards depend on them alone, and the body knows none."""

import importlib
import sys

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from jaxrod.envs import make
from jaxrod.envs.goal_env import GoalEnv
from jaxrod.envs.gym import GymnasiumEnv

pytestmark = pytest.mark.default_precision

SHORT = {"variant": "clean", "episode_length": 4}
TASKS = pytest.mark.parametrize("name", ["reaching", "tracking"])


def played(env, steps=4):
    """Observations and rewards of some random steps, restarts left out."""
    env.action_space.seed(0)
    seen, rewards = [env.reset(seed=0)[0]], []
    for _ in range(steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        seen.append(observation)
        rewards.append(reward)
    return seen, np.array(rewards)


@pytest.mark.slow
@TASKS
def test_rewards_are_those_of_the_goals_and_all_numbers_those_of_the_task(name):
    plain = GymnasiumEnv(name, **SHORT)
    env = GoalEnv(plain)
    seen, rewards = played(env)
    assert all(observation in env.observation_space for observation in seen)
    achieved, desired = (
        np.stack([observation[key] for observation in seen[1:]])
        for key in ("achieved_goal", "desired_goal")
    )
    computed = env.compute_reward(achieved, desired, [{}] * 4)
    np.testing.assert_allclose(computed, rewards, rtol=1e-5)
    one = env.compute_reward(achieved[0], desired[0], {})
    assert one.shape == () and one == pytest.approx(computed[0], rel=1e-6)
    # A reached goal pays all bonuses: the largest reward.
    best = env.compute_reward(achieved, achieved, None)
    np.testing.assert_allclose(best, best[0], rtol=1e-5)
    assert best[0] >= 2 and np.all(best >= computed)
    whole, again = played(plain)
    np.testing.assert_array_equal(again, rewards)
    entries = make(name, **SHORT).goal_entries
    for part, all_of in zip(seen, whole, strict=True):
        np.testing.assert_array_equal(part["observation"], all_of[[*entries.body]])
        np.testing.assert_array_equal(
            part["achieved_goal"], all_of[[*entries.achieved]]
        )


@TASKS
def test_entries_are_those_of_the_state_and_the_body_knows_no_goal(name):
    task = make(name, **SHORT)
    params, entries = task.default_params(), task.goal_entries
    reset = jax.jit(task.reset)
    first, state = jax.tree.map(np.asarray, reset(jax.random.key(0), params))
    other, elsewhere = jax.tree.map(np.asarray, reset(jax.random.key(1), params))
    np.testing.assert_array_equal(first[[*entries.achieved[:3]]], state.arm.tip)
    np.testing.assert_array_equal(first[[*entries.desired[:3]]], state.target.position)
    assert np.all(first[[*entries.desired[:3]]] != other[[*entries.desired[:3]]])
    np.testing.assert_array_equal(first[[*entries.body]], other[[*entries.body]])
    if name == "reaching":
        orientation = elsewhere.target.orientation
        np.testing.assert_array_equal(other[[*entries.desired[3:]]], orientation)
        assert entries.achieved[3:] == tuple(range(37, 41))


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped:UserWarning")
def test_the_checker_has_nothing_to_say():
    env = GoalEnv(gymnasium.make("jaxrod/reaching-clean-v0", episode_length=4))
    assert env.spec.max_episode_steps == 4
    check_env(env, skip_render_check=True)
    again = gymnasium.make(env.spec)
    seen, _ = played(env)
    twin, _ = played(again)
    np.testing.assert_array_equal(seen[-1]["observation"], twin[-1]["observation"])
    assert again.get_wrapper_attr("compute_reward")(np.zeros(7), np.zeros(7), {}) > 0


def test_held_actions_are_so_many_control_steps():
    single = GoalEnv(GymnasiumEnv("reaching", **SHORT))
    held = GoalEnv(GymnasiumEnv("reaching", **SHORT), hold=3)
    single.reset(seed=0)
    held.reset(seed=0)
    action = np.full(single.action_space.shape, 0.5, np.float32)
    for _ in range(3):
        wanted = single.step(action)
    found = held.step(action)
    for key, value in wanted[0].items():
        np.testing.assert_array_equal(found[0][key], value)
    assert found[1:] == wanted[1:] and not found[3]
    assert held.step(action)[3]  # the fourth control step ends the episode


def test_bad_input_is_refused_in_words():
    with pytest.raises(ValueError, match="trivial has no goals"):
        GoalEnv(GymnasiumEnv("trivial"))
    with pytest.raises(ValueError, match=r"of jaxrod, got .*CartPole"):
        GoalEnv(gymnasium.make("CartPole-v1"))
    env = GoalEnv(GymnasiumEnv("tracking", **SHORT))
    with pytest.raises(ValueError, match="hold must be"):
        GoalEnv(GymnasiumEnv("tracking", **SHORT), hold=0)
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.compute_reward(np.zeros(3), np.zeros(3), {})


def test_without_gymnasium_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "jaxrod.envs.goal_env")
    monkeypatch.delitem(sys.modules, "jaxrod.envs.gymnasium_batch")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "jaxrod\[gym\]"'):
        importlib.import_module("jaxrod.envs.goal_env")
