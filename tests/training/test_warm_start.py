"""Learning that begins with a policy goes on from it, and from nothing else."""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs.trivial import Trivial
from jaxrod.training import (
    PPO,
    SAC,
    SHAC,
    TRPO,
    MLPPolicy,
    PPOConfig,
    SACConfig,
    SHACConfig,
    TRPOConfig,
    train,
    warm_start,
)
from jaxrod.training.normalisation import RunningMoments

SMALL = PPOConfig(
    num_envs=8,
    rollout_steps=16,
    epochs=2,
    minibatches=2,
    hidden_sizes=(8,),
    quiet_action="median",
)
SEEN = np.linspace(-1, 1, 7)[:, None]


def some_policy(hidden=8, limit=0.7, **more):
    """With a bound of observations that is not the usual one."""
    draw = np.random.default_rng(3)
    return MLPPolicy(
        moments=RunningMoments(*(jnp.asarray(x) for x in (50.0, [0.1], [0.3]))),
        limit=jnp.asarray(limit),
        layers=tuple(
            (jnp.asarray(draw.normal(size=(i, o))), jnp.asarray(draw.normal(size=o)))
            for i, o in ((1, hidden), (hidden, 1))
        ),
        **more,
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("algorithm", "config", "output"),
    [
        (PPO, SMALL, "clip"),
        pytest.param(
            TRPO,
            TRPOConfig(num_envs=8, rollout_steps=16, hidden_sizes=(8,)),
            "clip",
            marks=pytest.mark.slow,
        ),
        (SHAC, SHACConfig(num_envs=8, hidden_sizes=(8,)), "tanh"),
    ],
)
def test_the_first_policy_is_the_one_that_is_given(algorithm, config, output):
    given = some_policy(output=output, action_repeat=config.action_repeat)
    config = dataclasses.replace(config, quiet_action="median")
    begun = warm_start(algorithm, given)
    state, usual = jax.jit(
        lambda key: tuple(a.init(key, Trivial(), config) for a in (begun, algorithm))
    )(jax.random.key(0))
    np.testing.assert_array_equal(begun.policy(state)(SEEN), given(SEEN))
    assert np.max(np.abs(algorithm.policy(usual)(SEEN) - given(SEEN))) > 1e-3
    # All else is that of a run which begins with chance.
    for name in ("environments", "action_keys", "optimiser", "updates"):
        jax.tree.map(
            np.testing.assert_array_equal,
            jax.tree.map(_numbers, getattr(state, name)),
            jax.tree.map(_numbers, getattr(usual, name)),
        )


def test_a_recurrent_policy_begins_as_the_perceptron_that_is_given():
    given, config = some_policy(), dataclasses.replace(SMALL, gru_units=4)
    learner = warm_start(PPO, given)
    state = jax.jit(lambda key: learner.init(key, Trivial(), config))(jax.random.key(0))
    policy = learner.policy(state)
    memory = policy.init(SEEN, None)
    for seen in (SEEN, 2 * SEEN):
        action, memory = policy.act(memory, seen, None)
        np.testing.assert_array_equal(action, given(seen))
    # It remembers.
    assert np.all(np.std(memory, axis=0) > 1e-3)


def _numbers(leaf):
    keys = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if keys else leaf


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_good_policy_stays_good_where_chance_has_learned_nothing():
    env = Trivial()
    quick = PPOConfig(
        num_envs=32,
        rollout_steps=64,
        epochs=4,
        minibatches=4,
        learning_rate=3e-3,
        quiet_action="median",  # the mean depends on the noise, which changes here
    )
    kept = {"progress": False, "evaluation_episodes": 200}
    taught = train(env, steps=60_000, config=quick, **kept)
    short = dataclasses.replace(quick, initial_log_std=-2.0, learning_rate=3e-4)
    alone = train(env, steps=4096, config=short, **kept)
    after = train(env, warm_start(PPO, taught.policy), steps=4096, config=short, **kept)
    score = taught.summary["evaluation_score"]
    assert after.summary["evaluation_score"] > score - 0.05
    assert alone.summary["evaluation_score"] < score - 1
    assert after.summary["algorithm"] == "ppo_with_policy"


def test_what_cannot_be_begun_with_is_refused():
    given = some_policy()
    with pytest.raises(ValueError, match="the initial policy must be an MLPPolicy"):
        warm_start(PPO, lambda seen: seen)
    with pytest.raises(ValueError, match="activation 'tanh' and output 'clip'"):
        started(PPO, dataclasses.replace(given, activation="relu"), SMALL)
    with pytest.raises(ValueError, match=r"output 'tanh', as shac has; got .* 'clip'"):
        started(SHAC, given, SHACConfig(num_envs=8, hidden_sizes=(8,)))
    with pytest.raises(ValueError, match=r"\[\(1, 8\), \(8, 1\)\].* got \[\(1, 4\)"):
        started(PPO, some_policy(hidden=4), SMALL)
    recurrent = dataclasses.replace(SMALL, gru_units=4)
    with pytest.raises(ValueError, match=r"\[\(1, 8\), \(8, 1\)\].* got \[\(1, 4\)"):
        started(PPO, some_policy(hidden=4), recurrent)
    with pytest.raises(ValueError, match="activation 'tanh' and output 'clip'"):
        started(PPO, dataclasses.replace(given, activation="relu"), recurrent)
    with pytest.raises(ValueError, match="network must be None"):
        started(PPO, given, dataclasses.replace(SMALL, network=own_network))
    held = dataclasses.replace(given, action_repeat=3)
    for config in (SMALL, recurrent):
        with pytest.raises(ValueError, match=r"= 3, not .* configuration's 1"):
            started(PPO, held, config)
        started(PPO, held, dataclasses.replace(config, action_repeat=3))
    with pytest.raises(ValueError, match="sac cannot begin with a policy"):
        started(SAC, given, SACConfig(num_envs=8, buffer_size=64, hidden_sizes=(8,)))


def started(algorithm, policy, config):
    """Nothing is computed."""
    init = warm_start(algorithm, policy).init
    jax.eval_shape(lambda key: init(key, Trivial(), config), jax.random.key(0))


def own_network(role, output_size):
    return nn.Dense(output_size)
