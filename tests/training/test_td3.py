"""TD3 and DDPG learn; blur and delay do what they say."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs.trivial import Trivial
from jaxrod.training import DDPGConfig, TD3Config, evaluate, train
from jaxrod.training.algorithms import td3
from jaxrod.training.algorithms.td3 import smoothed_target_action

SIZES = {
    "num_envs": 32,
    "rollout_steps": 8,
    "gradient_steps": 32,
    "batch_size": 128,
    "buffer_size": 20_000,
    "hidden_sizes": (32, 32),
    "learning_starts": 1000.0,
    "policy_learning_rate": 1e-3,
    "critic_learning_rate": 3e-3,
    "reward_scale": 1.0,
    "discount": 0.9,
}


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("td3", TD3Config(**SIZES)),
        pytest.param("ddpg", DDPGConfig(**SIZES), marks=pytest.mark.slow),
    ],
)
def test_trivial_task_is_learned_to_its_known_optimum(name, config):
    env = Trivial()
    result = train(
        env, name, steps=30_000, config=config, progress=False, evaluation_episodes=0
    )
    score = evaluate(env, result.policy, episodes=1000).mean
    assert env.optimal_return - 0.1 < score < env.optimal_return + 0.05
    assert result.summary["final_score"] > env.optimal_return - 1
    learner = result.state.learner
    # 118 updates, four of which were acted at random and taught nothing.
    critic_steps = 32 * (118 - 4)
    assert int(learner.optimiser["critics"].count) == critic_steps
    assert int(learner.optimiser["policy"].count) == critic_steps / config.policy_delay
    assert len(learner.weights["critics"]) == config.critics


def test_ddpg_is_td3_without_its_precautions():
    config = DDPGConfig()
    assert (config.critics, config.policy_delay, config.target_noise) == (1, 1, 0.0)
    same = TD3Config(**dataclasses.asdict(config))
    assert dataclasses.asdict(same) == dataclasses.asdict(config)


def test_blur_is_normal_noise_within_its_limit():
    noise = jax.random.normal(jax.random.key(0), (100_000, 1))
    blur = np.asarray(smoothed_target_action(jnp.zeros_like(noise), noise, 0.2, 0.5))
    assert np.abs(blur).max() == pytest.approx(0.5)
    # Clipping at 2.5 deviations takes 2 % off the variance.
    assert blur.std() == pytest.approx(0.2, rel=0.03)
    np.testing.assert_allclose(
        smoothed_target_action(noise[:9] / 5, noise[:9], 0.0, 0.5), noise[:9] / 5
    )
    edge = smoothed_target_action(jnp.ones_like(noise), noise, 0.2, 0.5)
    assert float(jnp.max(edge)) == 1.0 and float(jnp.min(edge)) == pytest.approx(0.5)


def test_targets_follow_slowly_and_only_when_the_policy_moves():
    config = TD3Config(
        **SIZES
        | {
            "num_envs": 4,
            "rollout_steps": 4,
            "gradient_steps": 2,
            "batch_size": 8,
            "hidden_sizes": (8,),
            "learning_starts": 0.0,
            "target_rate": 0.25,
        }
    )
    before = td3.init(jax.random.key(0), Trivial(), config)
    after = jax.jit(td3.update)(before)[0]
    old, new = before.learner.weights, after.learner.weights
    for name in ("policy", "critics"):
        # One following step for two critic steps.
        for start, target, source in zip(
            jax.tree.leaves(old[name]),
            jax.tree.leaves(new[f"target_{name}"]),
            jax.tree.leaves(new[name]),
            strict=True,
        ):
            np.testing.assert_allclose(target, 0.75 * start + 0.25 * source, atol=1e-12)
            assert np.any(np.asarray(start) != np.asarray(source))


@pytest.mark.slow
def test_exploration_noise_falls_along_the_run():
    config = TD3Config(
        **SIZES | {"learning_starts": 0.0},
        exploration_noise=0.4,
        exploration_decay=0.75,
    )
    state = td3.init(jax.random.key(0), Trivial(), config, total_steps=10**6)
    total = int(state.total_updates)

    def spread(updates):
        at = dataclasses.replace(state, updates=jnp.asarray(updates, jnp.int32))
        after = jax.jit(td3.update)(at)[0]
        # The first policy does nearly nothing, so what is done is noise.
        slots = config.rollout_steps
        return np.std(np.asarray(after.replay.transitions.action)[:slots])

    assert spread(0) == pytest.approx(0.4, rel=0.1)
    assert spread(total) == pytest.approx(0.1, rel=0.15)
    assert spread(2 * total) == pytest.approx(0.1, rel=0.15)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("policy_delay", 3),
        ("critics", 0),
        ("exploration_noise", -0.1),
        ("exploration_decay", 1.5),
        ("target_noise", float("nan")),
        ("target_noise_limit", -1.0),
        ("critic_learning_rate", 0.0),
    ],
)
def test_bad_setting_is_refused_by_name_and_value(name, value):
    config = dataclasses.replace(TD3Config(**SIZES), **{name: value})
    with pytest.raises(ValueError, match=name) as refusal:
        train(Trivial(), "td3", steps=1000, config=config, progress=False)
    assert str(value) in str(refusal.value)
