"""A critic that sees more than the policy: what it gains, and what the policy lacks."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.trivial import Trivial
from jaxrod.extend import pytree
from jaxrod.training import (
    PPO,
    MLPPolicy,
    PPOConfig,
    evaluate,
    restore_policy,
    train,
    warm_start,
)
from jaxrod.training.algorithms import on_policy, ppo

SMALL = PPOConfig(
    num_envs=16,
    rollout_steps=16,
    epochs=2,
    minibatches=2,
    hidden_sizes=(8,),
    privileged_critic=True,
)


@pytree
class Shown:
    """Parameter of `Luck`: by what the privileged observation is multiplied."""

    scale: float | jax.Array = 1.0


@pytree
class LuckState:
    luck: jax.Array
    steps: jax.Array


@dataclasses.dataclass(frozen=True)
class Luck:
    """Pays -1 or 1 in every step of an episode; only a critic may see which."""

    episode_length: int = 20
    name: str = "luck"
    observation_size: int = 2
    action_size: int = 1

    def default_params(self):
        return Shown()

    def reset(self, key, params):
        luck = jax.random.rademacher(key, (), float)
        return jnp.zeros(2), LuckState(luck, jnp.zeros((), jnp.int32))

    def step(self, key, state, action, params):
        steps = state.steps + 1
        seen = jnp.full(2, steps / self.episode_length)
        last = steps >= self.episode_length
        state = LuckState(state.luck, steps)
        return seen, state, state.luck, last, last, {}

    def privileged_observation(self, state, params):
        return params.scale * jnp.stack([state.luck, state.luck**2, state.luck])


@pytest.mark.slow
@pytest.mark.parametrize("units", [4, 0])
def test_the_policy_depends_on_nothing_privileged(units):
    config = dataclasses.replace(SMALL, gru_units=units)
    state = ppo.init(jax.random.key(0), Luck(), config)
    update, gather = jax.jit(ppo.update), jax.jit(on_policy.gather_experience)
    state, _ = update(state)
    other = dataclasses.replace(state, env_params=Shown(jnp.asarray(-3.0)))
    (_, a, _), (_, b, _) = gather(state), gather(other)
    np.testing.assert_array_equal(a.action, b.action)
    np.testing.assert_array_equal(a.observation[..., :2], b.observation[..., :2])
    assert (a.value != b.value)[1:].all()

    weightless = dataclasses.replace(state.config, value_weight=jnp.zeros(()))
    judging = dataclasses.replace(state, config=weightless)

    def loss(observation):
        batch = dataclasses.replace(a, observation=observation)
        return ppo._loss(state.weights, batch, judging)[0]

    slope = jax.grad(loss)(a.observation)
    assert slope[..., :2].any() and not slope[..., 2:].any()
    assert PPO.policy(state).moments.mean.shape == (2,)


@pytest.mark.slow
def test_a_critic_predicts_what_it_sees():
    errors = {}
    for privileged in (False, True):
        config = dataclasses.replace(SMALL, privileged_critic=privileged)
        config = dataclasses.replace(config, epochs=8, learning_rate=1e-2)
        run = {"progress": False, "evaluation_episodes": 0}
        result = train(Luck(), steps=256 * 40, config=config, **run)
        errors[privileged] = result.progress[-1]["value_error"]
    assert errors[True] < 0.2 * errors[False]


@pytest.mark.slow
@pytest.mark.parametrize("units", [4, 0])
def test_a_run_leaves_a_policy_of_the_task_itself(tmp_path, units):
    varied = {"parameters": {"stride": {"uniform": (0.1, 0.3)}}, "noise": 0.05}
    env = make("trivial", randomise=varied | {"delay": [0, 2]})
    config = dataclasses.replace(SMALL, gru_units=units, action_repeat=2)
    run = {"progress": False, "evaluation_episodes": 4, "out": tmp_path}
    result = train(env, steps=2048, config=config, **run)
    assert result.policy.moments.mean.shape == (1,)
    stored = restore_policy(tmp_path, env)
    assert evaluate(env, stored).mean == evaluate(env, result.policy).mean
    again = train(env, steps=2048, config=config, resume=True, **run)
    assert again.summary == result.summary


@pytest.mark.slow
def test_changed_parameters_recompile_nothing():
    update = jax.jit(lambda state: ppo.update(state))
    state = ppo.init(jax.random.key(0), Luck(), SMALL)
    state, _ = update(state)
    update(dataclasses.replace(state, env_params=Shown(2 * state.env_params.scale)))
    assert update._cache_size() == 1


def test_where_there_is_nothing_privileged_it_is_said():
    with pytest.raises(ValueError, match=r"Trivial has no privileged_observation \(ja"):
        train(Trivial(), steps=10_000, config=SMALL, progress=False)
    with pytest.raises(ValueError, match="privileged_critic must be true or false"):
        config = dataclasses.replace(SMALL, privileged_critic=1)
        train(Luck(), steps=10_000, config=config, progress=False)
    plain = dataclasses.replace(SMALL, privileged_critic=False)
    policy = PPO.policy(ppo.init(jax.random.key(0), Luck(), plain))
    assert isinstance(policy, MLPPolicy)
    with pytest.raises(ValueError, match="privileged_critic must be false to begin"):
        warm_start(PPO, policy).init(jax.random.key(0), Luck(), SMALL)
