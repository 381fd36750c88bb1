"""What an algorithm must provide is said in words when training starts."""

from __future__ import annotations

import dataclasses
import json
import sys

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

import jaxrod
from jaxrod.envs import VectorEnvironment
from jaxrod.envs.trivial import Trivial
from jaxrod.training import (
    Algorithm,
    Metrics,
    MLPPolicy,
    find_algorithm,
    load_policy,
    save_policy,
    train,
    train_seeds,
)


@jaxrod.extend.pytree
class Config:
    num_envs: int = jaxrod.extend.static(default=4)
    speed: float = 0.5


def init(key, env, config, env_params, total_steps):
    batch = VectorEnvironment(env).reset(key, config.num_envs, env_params)
    return {"batch": batch, "speed": jnp.asarray(config.speed), "params": env_params}


def update(state):
    env, speed = VectorEnvironment(Trivial()), state["speed"]
    action = -speed * state["batch"].observation
    batch, step = env.step(state["batch"], action, state["params"])
    episodes = jax.tree.map(lambda leaf: leaf[None], step.episodes)
    return state | {"batch": batch}, Metrics({"speed": speed}, episodes)


def policy(state):
    return jax.tree_util.Partial(lambda speed, seen: -speed * seen, state["speed"])


PLAIN = Algorithm(
    name="plain",
    config_type=Config,
    steps_per_update=lambda config: config.num_envs,
    init=init,
    update=update,
    policy=policy,
)
"""An algorithm of nothing but what it must have; its state is a dictionary."""


def test_the_least_there_can_be_trains_and_resumes(tmp_path):
    run = {"steps": 4 * 30, "out": tmp_path, "progress": False, "chunk_steps": 1}
    begun = train(Trivial(), PLAIN, **run)
    assert begun.summary["episodes"] == 4
    again = train(Trivial(), PLAIN, resume=True, **run)
    assert again.summary == begun.summary
    config = json.loads((tmp_path / "config.json").read_text())
    assert find_algorithm(config["algorithm"]) is PLAIN
    _, metrics = train_seeds(Trivial(), PLAIN, steps=4 * 20, seeds=(0, 1))
    assert metrics["episodes"].sum(axis=1).tolist() == [4, 4]


def test_a_run_without_partition_has_one_device():
    with pytest.raises(ValueError, match="devices must be one for plain"):
        train(Trivial(), PLAIN, steps=100, devices=2 * jax.devices())


@dataclasses.dataclass(frozen=True)
class Unregistered:
    speed: float = 0.5


@jaxrod.extend.pytree
class Wordy:
    num_envs: int = jaxrod.extend.static(default=4)
    word: str = "fast"


def grown(state):
    state, metrics = update(state)
    return state | {"speed": jnp.zeros(3)}, metrics


def told_otherwise(**changes):
    def changed(state):
        state, metrics = update(state)
        return state, dataclasses.replace(metrics, **changes)

    return changed


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": ""}, "name must be text, got ''"),
        ({"init": None}, "init of plain must be a function"),
        ({"partition": 3}, "partition of plain must be a function or None"),
        ({"config_type": dict}, "config_type of plain must be .* jaxrod.extend.pytree"),
        (
            {"config_type": Unregistered},
            "Unregistered, must be made by jaxrod.extend.pytree",
        ),
        ({"config_type": Wordy}, "word of Wordy must be a number, or .* got 'fast'"),
        ({"steps_per_update": lambda config: 2.5}, "steps_per_update .* got 2.5"),
        ({"update": lambda state: state}, r"must return \(state, Metrics\)"),
        ({"update": lambda state: (state, {})}, "Metrics beside the state, got dict"),
        ({"update": grown}, r"\['speed'\] was float64\[\] and becomes float64\[3\]"),
        (
            {"update": told_otherwise(scalars={"a": jnp.zeros(2)})},
            "metrics.scalars of plain must be single numbers",
        ),
        (
            {"update": told_otherwise(episodes=jnp.zeros(3))},
            r"must be an EpisodeRecord .* \(steps, num_envs\)",
        ),
        ({"policy": lambda state: state}, r"policy of plain .* got a dict"),
        (
            {"policy": lambda state: jax.tree_util.Partial(lambda x: x[0])},
            r"observations of shape \(1,\) to actions of shape \(1,\), got \(\)",
        ),
        (
            {"policy": lambda s: jax.tree_util.Partial(jnp.dot, jnp.ones((1, 1)))},
            r"policy of plain must map observations of shape \(3, 1\)",
        ),
        (
            {
                "partition": lambda state: [PartitionSpec()],
                "update": lambda state, axis_name=None: update(state),
            },
            "partition of plain must return a tree prefix of the train state",
        ),
    ],
)
def test_what_an_algorithm_lacks_is_said(tmp_path, changes, words):
    learner = dataclasses.replace(PLAIN, **changes)
    with pytest.raises(ValueError, match=words):
        train(
            Trivial(), learner, steps=100, out=tmp_path / "run", devices=jax.devices()
        )
    # What is refused leaves no trace.
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.parametrize(
    ("algorithm", "words"),
    [
        ("magic", "one of dagger, .* or module:NAME; got 'magic'"),
        (3, "a name, an import path or a jaxrod.training.Algorithm, got 3"),
        (":X", "an import path is module:NAME, got ':X'"),
        ("json:dumps", "'json:dumps' must be a .*Algorithm, got a function"),
    ],
)
def test_what_is_no_algorithm_is_refused(algorithm, words):
    with pytest.raises(ValueError, match=words):
        train(Trivial(), algorithm, steps=100)


def test_where_nothing_is_found_is_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path, words in {
        "no_such_module:X": f"there is no module no_such_module, .* nor in {tmp_path}",
        "json:X": "json:X: module json has no X",
        "broken_module:X": "importing broken_module failed: ZeroDivisionError",
    }.items():
        (tmp_path / "broken_module.py").write_text("1 / 0")
        with pytest.raises(ImportError, match=words):
            find_algorithm(path)
    assert str(tmp_path) not in sys.path


def linear(role, outputs):
    return nn.Dense(outputs)


class Convolution(nn.Module):
    """Along the observation, for a change."""

    outputs: int

    @nn.compact
    def __call__(self, inputs):
        hidden = nn.relu(nn.Conv(4, (3,))(inputs[..., None]))
        return nn.Dense(self.outputs)(hidden.reshape(*inputs.shape[:-1], -1))


def convolution(role, outputs):
    # With a name of its own, as a user may give it.
    return Convolution(outputs, name=role)


def sequence(role, outputs):
    # Modules that cannot be compared: a new function in each of them.
    return nn.Sequential([nn.Dense(8), lambda x: nn.tanh(x), nn.Dense(outputs)])


def pair(role, outputs):
    # Two functions, without flax.
    def init(key, inputs):
        shape = (inputs.size, outputs)
        return {
            "kernel": 0.1 * jax.random.normal(key, shape),
            "bias": jnp.ones(outputs),
        }

    def apply(weights, inputs):
        bias = weights["bias"].reshape((1,) * (inputs.ndim - 1) + (outputs,))
        return jnp.tanh(inputs @ weights["kernel"] + bias)

    return init, apply


class Normalised(nn.Module):
    outputs: int

    @nn.compact
    def __call__(self, inputs):
        return nn.Dense(self.outputs)(nn.BatchNorm(use_running_average=True)(inputs))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("name", "dtype", "network"),
    [
        ("ppo", jnp.float32, convolution),
        ("ppo", jnp.float64, pair),
        ("trpo", jnp.float64, sequence),
        ("sac", jnp.float64, convolution),
        ("td3", jnp.float32, sequence),
    ],
)
def test_every_learner_takes_any_network(tmp_path, name, dtype, network):
    learner = find_algorithm(name)
    config = learner.config_type(num_envs=4, action_repeat=3, network=network)
    with jax.enable_x64(dtype == jnp.float64):
        key = jax.random.key(0)
        state = jax.jit(learner.init, static_argnums=(1, 4))(
            key, Trivial(), config, None, 1000
        )
        after, _ = jax.eval_shape(lambda state: learner.update(state), state)
        assert jax.tree.structure(after) == jax.tree.structure(state)
        before = [leaf.dtype for leaf in jax.tree.leaves(state)]
        assert [leaf.dtype for leaf in jax.tree.leaves(after)] == before
        found = learner.policy(state)
        assert jax.tree.structure(found) == jax.tree.structure(learner.policy(state))
        observation = jnp.linspace(-1, 1, 7)[:, None]
        assert found(observation).dtype == dtype
        save_policy(found, tmp_path)
        loaded = load_policy(tmp_path, jax.eval_shape(learner.policy, state))
        assert loaded.action_repeat == 3
        np.testing.assert_array_equal(loaded(observation), found(observation))
        np.testing.assert_allclose(
            loaded(observation[0]), found(observation)[0], rtol=1e-5
        )


@pytest.mark.parametrize(
    ("network", "words"),
    [
        (3, "network must be a function .* got 3"),
        (lambda role, outputs: outputs, "flax modules .* for 'policy' it made a int"),
        (lambda role, outputs: Normalised(outputs), "nothing else, got batch_stats"),
        (
            lambda role, outputs: nn.Dense(outputs + 1),
            r"shape \(1,\) to outputs of shape \(\d,\), but Dense returns \(\d,\)",
        ),
    ],
)
@pytest.mark.parametrize("name", ["trpo", "td3"])
def test_a_network_that_will_not_do_is_refused(name, network, words):
    config = find_algorithm(name).config_type(network=network)
    with pytest.raises(ValueError, match=words):
        train(Trivial(), name, steps=10_000, config=config, progress=False)


def test_a_network_that_no_file_can_name_is_refused_where_there_is_a_folder(tmp_path):
    config = find_algorithm("ppo").config_type(network=lambda role, n: nn.Dense(n))
    with pytest.raises(ValueError, match=r"network must be .* got <function"):
        train(Trivial(), steps=20_000, config=config, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("text", ["nothing:here", "json", "json:__doc__"])
def test_a_network_that_is_not_found_is_named(text):
    from jaxrod.cli.settings import configure

    default = find_algorithm("ppo").config_type()
    with pytest.raises((ValueError, ImportError), match=text.split(":")[0]):
        configure(default, {}, [f"network={text}"])
    chosen = configure(default, {}, [f"network={__name__}:linear"])
    assert chosen.network is linear
    assert configure(chosen, {"network": None}, []).network is None


@pytest.mark.slow
def test_a_policy_without_a_framework_is_written_as_it_was(tmp_path):
    learner = find_algorithm("ppo")
    state = learner.init(jax.random.key(0), Trivial(), learner.config_type(num_envs=4))
    save_policy(learner.policy(state), tmp_path)
    assert json.loads((tmp_path / "policy.json").read_text())["format"] == 1
    assert isinstance(load_policy(tmp_path), MLPPolicy)
