"""Policies with a gated recurrent unit: sequences, resets, a task that needs memory."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import MemoryPolicy, VectorEnvironment
from jaxrod.envs.trivial import Trivial
from jaxrod.extend import pytree
from jaxrod.training import (
    PPOConfig,
    RecurrentPolicy,
    evaluate,
    find_algorithm,
    restore_policy,
    train,
    train_seeds,
    untrained_policy,
)
from jaxrod.training.algorithms import on_policy, ppo
from jaxrod.training.networks import BuiltInNetwork, initial_memory, initial_weights
from jaxrod.training.normalisation import normalise

SMALL = PPOConfig(
    num_envs=8,
    rollout_steps=16,
    epochs=2,
    minibatches=2,
    hidden_sizes=(8,),
    gru_units=5,
)


def some_network():
    network = BuiltInNetwork((8,), 5, "tanh", jnp.float64)("critic", 2)
    weights = initial_weights(
        network, jax.random.key(0), jnp.zeros(3, jnp.float64), recurrent=True
    )
    # Zeros, as biases begin, would hide a wrong formula.
    leaves, tree = jax.tree.flatten(weights)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    drawn = [
        0.5 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)
    ]
    return network, jax.tree.unflatten(tree, drawn)


@partial(jax.jit, static_argnums=0)
def along(network, weights, inputs, memory, starts=None):
    return network.apply({"params": weights}, inputs, memory, starts)


@pytest.mark.slow
def test_a_sequence_equals_step_by_step():
    network, weights = some_network()
    inputs = jax.random.normal(jax.random.key(2), (7, 4, 3), jnp.float64)
    memory = initial_memory(network, (4,), jnp.float64)
    whole, last = along(network, weights, inputs, memory)
    for one, wanted in zip(inputs, whole, strict=True):
        found, memory = along(network, weights, one[None], memory)
        np.testing.assert_allclose(found[0], wanted, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(memory, last, rtol=1e-12)


def test_the_unit_is_that_of_the_formula():
    network, weights = some_network()
    memory = jax.random.normal(jax.random.key(3), (5,), jnp.float64)
    x = jax.random.normal(jax.random.key(4), (3,), jnp.float64)
    _, found = along(network, weights, x[None], memory)
    drive = x @ weights["input"]["kernel"] + weights["input"]["bias"]
    drives = np.split(np.asarray(drive), 3)
    names = ("reset", "update", "new")
    recalls = [np.asarray(memory @ weights[f"recurrent_{name}"]) for name in names]
    sigmoid = lambda x: 1 / (1 + np.exp(-x))
    r, z = (sigmoid(drives[k] + recalls[k]) for k in (0, 1))
    n = np.tanh(drives[2] + r * (recalls[2] + np.asarray(weights["shift"])))
    np.testing.assert_allclose(found, (1 - z) * n + z * np.asarray(memory), rtol=1e-12)


@pytest.mark.slow
def test_an_episode_that_begins_inside_a_sequence_remembers_nothing():
    network, weights = some_network()
    inputs = jax.random.normal(jax.random.key(2), (7, 2, 3), jnp.float64)
    memory = jnp.ones((2, 5), jnp.float64)
    starts = jnp.zeros((7, 2), bool).at[4, 0].set(True)
    found, last = along(network, weights, inputs, memory, starts)
    apart, _ = along(network, weights, inputs, memory)
    fresh = jnp.zeros((2, 5), jnp.float64)
    again, ended = along(network, weights, inputs[4:], fresh)
    np.testing.assert_allclose(found[:4], apart[:4], rtol=1e-12)
    np.testing.assert_allclose(found[:, 1], apart[:, 1], rtol=1e-12)
    np.testing.assert_allclose(found[4:, 0], again[:, 0], rtol=1e-12)
    np.testing.assert_allclose(last[0], ended[0], rtol=1e-12)

    def late(inputs):
        return jnp.sum(along(network, weights, inputs, memory, starts)[0][4:, 0] ** 2)

    slope = jax.grad(late)(inputs)
    assert not slope[:4].any() and slope[4:, 0].all()


def acted(config, updates=3, env=None):
    """A train state after some updates, and the experience of the next."""
    env = Trivial() if env is None else env
    state = ppo.init(jax.random.key(5), env, config)
    update = jax.jit(ppo.update)
    for _ in range(updates):
        state, _ = update(state)
    return state, *jax.jit(on_policy.gather_experience)(state)


def test_rollouts_and_minibatches_agree_on_memory_and_values():
    config = dataclasses.replace(SMALL, epochs=1, minibatches=1)
    state, after, experience, _ = acted(config, env=Trivial(episode_length=3))
    assert state.memory["policy"].any() and experience.starts.any()
    _, metrics = jax.jit(ppo.update)(state)
    np.testing.assert_allclose(metrics.scalars["kl"], 0, atol=1e-12)
    assert metrics.scalars["clipped"] == 0
    # The memories of environments whose episode has just ended are those of a start.
    ended = after.environments.elapsed == 0
    assert ended.any() and not ended.all()
    for memory in after.memory.values():
        assert not memory[ended].any()
        assert memory[~ended].any(axis=1).all()


@pytest.mark.slow
def test_the_value_of_a_cut_short_episode_remembers_the_episode():
    # With lambda 0 an advantage is one step's error: its target can be computed apart.
    config = dataclasses.replace(SMALL, trace_decay=0.0, rollout_steps=24)
    state, _, experience, _ = acted(config)
    network = on_policy.value_network(state.config, jnp.float64)
    bounded = lambda x: normalise(state.moments, x, state.config.observation_limit)
    state_before = state.environments
    step = jax.jit(VectorEnvironment(state.env).step)
    memory, seen = state.memory["value"], []
    weights = state.weights["value"]
    for t in range(24):
        _, memory = along(
            network, weights, bounded(state_before.observation)[None], memory
        )
        state_before, outcome = step(
            state_before, jnp.clip(experience.action[t], -1, 1), state.env_params
        )
        final, _ = along(
            network, weights, bounded(outcome.final_observation)[None], memory
        )
        done = outcome.terminated | outcome.truncated
        value = jnp.where(outcome.terminated, 0, final[0, :, 0])
        wanted = config.reward_scale * outcome.reward + config.discount * value
        np.testing.assert_allclose(
            experience.value_target[t][done], wanted[done], rtol=1e-9
        )
        seen.append(done.sum())
        memory = jnp.where(done[:, None], 0, memory)
    assert sum(seen) >= 8


@pytree
class CueState:
    cue: jax.Array
    steps: jax.Array


@dataclasses.dataclass(frozen=True)
class Cue:
    """Shows -1 or 1 once; at the end the action must be that number."""

    episode_length: int = 6
    name: str = "cue"
    observation_size: int = 2
    action_size: int = 1

    def default_params(self):
        return ()

    def reset(self, key, params):
        cue = jax.random.rademacher(key, (), float)
        return jnp.stack([cue, jnp.zeros(())]), CueState(cue, jnp.zeros((), jnp.int32))

    def step(self, key, state, action, params):
        steps = state.steps + 1
        last = steps >= self.episode_length
        reward = jnp.where(last, 1 - (action[0] - state.cue) ** 2, 0)
        shown = jnp.stack([jnp.zeros(()), steps / self.episode_length])
        return shown, CueState(state.cue, steps), reward, steps < 0, last, {}


@pytest.mark.default_precision
@pytest.mark.slow
@pytest.mark.parametrize("units", [8, 0])
def test_a_cue_is_remembered_by_a_recurrent_policy_alone(units):
    config = PPOConfig(
        num_envs=64,
        rollout_steps=12,
        epochs=4,
        minibatches=4,
        learning_rate=5e-3,
        hidden_sizes=(16,),
        gru_units=units,
        reward_scale=1.0,
    )
    run = {"progress": False, "evaluation_episodes": 0}
    policy = train(Cue(), steps=60_000, config=config, **run).policy
    score = evaluate(Cue(), policy, episodes=256).mean
    assert isinstance(policy, MemoryPolicy) == bool(units)
    # Without memory no action earns more than 0 on average.
    assert score > 0.9 if units else score < 0.1


@pytest.mark.slow
def test_a_resumed_run_ends_bit_by_bit_as_if_never_stopped(tmp_path):
    run = {"progress": False, "chunk_steps": 1, "evaluation_episodes": 4}
    whole = train(Trivial(), steps=128 * 4, config=SMALL, out=tmp_path / "a", **run)

    class Stopped(Exception):
        pass

    def stop(row):
        if row["env_steps"] == 256:
            raise Stopped

    half = {"steps": 128 * 4, "config": SMALL, "out": tmp_path / "b", **run}
    with pytest.raises(Stopped):
        train(Trivial(), **half, checkpoint_seconds=0, log=stop)
    resumed = train(Trivial(), **half, resume=True)
    assert resumed.state.memory["policy"].any()
    for a, b in zip(*map(jax.tree.leaves, (whole.state, resumed.state)), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)
    seen = jnp.linspace(-1, 1, 3)[:, None]
    restored = restore_policy(tmp_path / "a", Trivial())
    actions = [
        p.act(p.init(seen, None), seen, None)[0] for p in (whole.policy, restored)
    ]
    np.testing.assert_array_equal(*actions)


@pytest.mark.slow
def test_vectorised_seeds_equal_separate_runs():
    env, updates = Trivial(), 2
    states, metrics = train_seeds(env, steps=128 * updates, seeds=(3, 4), config=SMALL)
    update = jax.jit(ppo.update)
    for i, seed in enumerate((3, 4)):
        state = ppo.init(jax.random.key(seed), env, SMALL, None, 128 * updates)
        for j in range(updates):
            state, alone = update(state)
            for name, value in alone.scalars.items():
                np.testing.assert_allclose(
                    metrics[name][i, j], value, rtol=1e-6, atol=1e-12
                )
        np.testing.assert_allclose(states.memory["policy"][i], state.memory["policy"])


@pytest.mark.slow
def test_changed_numbers_recompile_nothing():
    update = jax.jit(lambda state: ppo.update(state))
    state = ppo.init(jax.random.key(0), Trivial(), SMALL)
    state = update(state)[0]
    numbers = dataclasses.replace(SMALL, learning_rate=1e-4, discount=0.9, clip=0.1)
    update(state)
    update(ppo.init(jax.random.key(1), Trivial(), numbers))
    assert update._cache_size() == 1


class Counting(nn.Module):
    """A memory that is no array: a mean of what was seen, and a count."""

    outputs: int

    def initial_memory(self, batch, dtype):
        return {"total": jnp.zeros((*batch, 1), dtype), "count": jnp.zeros(batch, int)}

    @nn.compact
    def __call__(self, inputs, memory, starts=None):
        dense = nn.Dense(self.outputs)

        def step(memory, now):
            seen, start = now
            total, count = memory["total"], memory["count"]
            if start is not None:
                total = jnp.where(start[..., None], 0, total)
                count = jnp.where(start, 0, count)
            memory = {"total": total + seen[..., :1], "count": count + 1}
            return memory, memory["total"] / memory["count"][..., None]

        memory, means = jax.lax.scan(step, memory, (inputs, starts))
        return dense(jnp.concatenate([inputs, means], axis=-1)), memory


def counting(role, outputs):
    return Counting(outputs)


def counting_policy(role, outputs):
    return Counting(outputs) if role == "policy" else nn.Dense(outputs)


@pytest.mark.slow
@pytest.mark.parametrize("network", [counting, counting_policy])
def test_networks_with_a_memory_of_your_own(tmp_path, network):
    config = dataclasses.replace(SMALL, network=network, gru_units=0, action_repeat=2)
    run = {"progress": False, "evaluation_episodes": 4, "out": tmp_path}
    result = train(Trivial(), steps=1024, config=config, **run)
    assert result.policy.action_repeat == 2
    stored = restore_policy(tmp_path, Trivial(), trust=(__name__,))
    assert evaluate(Trivial(), stored, episodes=4).mean == result.evaluation.mean


class Growing(Counting):
    @nn.compact
    def __call__(self, inputs, memory, starts=None):
        outputs = nn.Dense(self.outputs)(inputs)
        return outputs, memory | {"count": memory["total"]}


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("ppo", {"gru_units": -1}, "gru_units must be .* -1"),
        ("ppo", {"gru_units": 20_000}, "gru_units must be at most 16,384 .* 20,000"),
        ("ppo", {"gru_units": 4, "minibatches": 3}, "the environments .* 128, got 3"),
        ("ppo", {"network": lambda role, n: Growing(n)}, "the form of its memory"),
        ("trpo", {"network": counting}, "no memory .* only ppo trains"),
        ("sac", {"network": counting}, "no memory .* only ppo trains"),
        ("shac", {"network": counting}, "no memory .* only ppo trains"),
        ("dagger", {"network": counting}, "no memory .* only ppo trains"),
    ],
)
def test_what_cannot_be_trained_is_refused(name, changes, words):
    config = find_algorithm(name).config_type(**changes)
    with pytest.raises(ValueError, match=words):
        train(Trivial(), name, steps=200_000, config=config, progress=False)


def test_the_policy_has_the_form_that_is_announced():
    policy = untrained_policy(Trivial(), config=SMALL)
    assert isinstance(policy, RecurrentPolicy)
    assert jax.tree.structure(policy) == jax.tree.structure(
        ppo.PPO.policy(ppo.init(jax.random.key(0), Trivial(), SMALL))
    )


TWO_DEVICES = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
from jaxrod.envs.trivial import Trivial
from jaxrod.training import PPOConfig, train
config = PPOConfig(num_envs=8, rollout_steps=16, epochs=1, minibatches=2, gru_units=5)
result = train(Trivial(), steps=256, config=config, evaluation_episodes=2)
for memory in result.state.memory.values():
    assert [shard.data.shape for shard in memory.addressable_shards] == [(4, 5)] * 2
"""


@pytest.mark.slow
def test_memories_are_spread_over_devices():
    subprocess.run([sys.executable, "-W", "error", "-c", TWO_DEVICES], check=True)
