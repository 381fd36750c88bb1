"""Exported policies: the same actions as in JAX, or a refusal that says why."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import re
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from exported import compiled
from jaxrod.envs import Channel
from jaxrod.envs.trivial import Trivial
from jaxrod.extend import pytree
from jaxrod.training import (
    PPO,
    MLPPolicy,
    PPOConfig,
    algorithm_names,
    export_c,
    export_onnx,
    find_algorithm,
    restore_policy,
    train,
    untrained_policy,
)
from jaxrod.training.normalisation import RunningMoments
from missing import pretend_missing

pytestmark = pytest.mark.default_precision
KINDS = [
    (activation, output)
    for activation in ("tanh", "relu", "elu")
    for output in ("clip", "tanh")
]


@dataclasses.dataclass(frozen=True)
class Sized:
    """The part of an environment that an export needs."""

    observation_size: int = 7
    action_size: int = 2
    name: str = "sized"
    control_period: float = 0.02


def perceptron(activation="tanh", output="clip", sizes=(7, 16, 16, 2), **more):
    random = np.random.default_rng(1)
    single = lambda array: jnp.asarray(array, jnp.float32)
    return MLPPolicy(
        moments=RunningMoments(
            single(100.0),
            single(random.normal(size=sizes[0])),
            single(0.5 + random.random(sizes[0])),
        ),
        limit=single(4.0),
        layers=tuple(
            (single(random.normal(size=(a, b)) / a**0.5), single(random.normal(size=b)))
            for a, b in itertools.pairwise(sizes)
        ),
        activation=activation,
        output=output,
        **more,
    )


def observations(policy, count=10_000):
    """Observations as far from their mean as training has seen, and farther."""
    random, moments = np.random.default_rng(2), getattr(policy, "moments", None)
    size = 7 if moments is None else moments.mean.size
    drawn = 2 * random.normal(size=(count, size))
    if moments is not None:
        drawn = drawn * np.sqrt(moments.variance) + np.asarray(moments.mean)
    return drawn.astype(np.float32)


def onnx_session(file):
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(file), options)


def in_both(policy, folder, env):
    """The policy as functions of one observation: compiled from C, and by ONNX."""
    export_c(policy, env, folder / "policy.h")
    export_onnx(policy, env, folder / "policy.onnx")
    session = onnx_session(folder / "policy.onnx")
    by_onnx = lambda seen: session.run(["action"], {"observation": seen})[0]
    return compiled(folder / "policy.h"), by_onnx


def assert_same(policy, folder, env, seen, atol=1e-6):
    wanted = np.clip(jax.jit(policy)(seen), -1, 1)
    for act in in_both(policy, folder, env):
        found = np.stack([act(one) for one in seen])
        np.testing.assert_allclose(found, wanted, rtol=0, atol=atol)
    return wanted


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("activation", "output"), KINDS)
def test_a_perceptron_acts_as_in_jax(tmp_path, activation, output):
    policy = perceptron(activation, output)
    actions = assert_same(policy, tmp_path, Sized(), observations(policy))
    assert (np.abs(actions) < 0.9).mean() > 0.2, "hardly any action says anything"
    text = (tmp_path / "policy.h").read_text()
    assert not re.search(r"\b(malloc|calloc|realloc|free|alloca)\b", text)
    assert re.findall(r"#include .*", text) == ["#include <math.h>"]


@pytest.mark.parametrize("output", ["clip", "tanh"])
def test_a_perceptron_that_acts_with_the_mean_acts_as_in_jax(tmp_path, output):
    std = jnp.asarray([0.2, 1.0], jnp.float32)
    policy = perceptron("tanh", output, action_std=std, quiet_action="mean")
    seen = observations(policy, 2000)
    actions = assert_same(policy, tmp_path, Sized(), seen)
    median = dataclasses.replace(policy, quiet_action="median")(seen)
    assert np.abs(actions - np.clip(median, -1, 1)).max() > 0.1


def exactly(policy, seen):
    """Actions of a policy evaluated in float64."""
    with jax.enable_x64(True):
        wide = lambda array: jnp.asarray(np.asarray(array, np.float64))
        return np.asarray(jax.tree.map(wide, policy)(wide(seen)))


def steep():
    """A policy like those of TD3: its actions change four times as fast as others'."""
    policy = perceptron("relu", "tanh", sizes=(7, 64, 64, 2))
    *hidden, (kernel, bias) = policy.layers
    layers = (*hidden, (4 * kernel, 4 * bias))
    return dataclasses.replace(policy, layers=layers)


def test_exported_policies_are_no_farther_from_float64_than_in_jax(tmp_path):
    policy = steep()
    seen = observations(policy, 3000)
    wanted = exactly(policy, seen)
    rms = lambda actions: float(np.sqrt(np.mean((actions - wanted) ** 2)))
    own = rms(jax.jit(policy)(seen))
    assert 5e-8 < own < 5e-7
    for act in in_both(policy, tmp_path, Sized()):
        assert rms(np.stack([act(one) for one in seen])) < 1.25 * own


def test_all_algorithms_make_such_policies():
    env = Trivial()
    made = [untrained_policy(env, algorithm) for algorithm in algorithm_names()]
    assert len(made) >= 7
    assert {(policy.activation, policy.output) for policy in made} <= set(KINDS)


@dataclasses.dataclass(frozen=True)
class Seen(Trivial):
    """The point on a line, observed in several ways and in other units."""

    observation_size: int = 6
    observation_channels = None

    def reset(self, key, params):
        observation, state = super().reset(key, params)
        return self.shown(observation, state), state

    def step(self, key, state, action, params):
        observation, state, *rest = super().step(key, state, action, params)
        return self.shown(observation, state), state, *rest

    def shown(self, observation, state):
        x, time = observation[0], state.steps / self.episode_length
        return jnp.stack([x, 1e3 * x + 5, jnp.sin(7 * x), x**2, time, x * time])


SMALL = {
    "dagger": {"num_envs": 16, "action_repeat": 1, "gradient_steps": 16},
    "ppo": {"num_envs": 16, "rollout_steps": 32, "minibatches": 4},
    "shac": {"num_envs": 16, "rollout_steps": 8},
    "trpo": {"num_envs": 16, "rollout_steps": 32},
}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", algorithm_names())
def test_the_policy_of_every_algorithm_acts_as_in_jax(tmp_path, algorithm):
    env, run = Seen(), tmp_path / "run"
    kind = find_algorithm(algorithm).config_type
    config = kind(**SMALL.get(algorithm, {"num_envs": 16}))
    settings = {"evaluation_episodes": 0, "progress": False, "out": run}
    train(env, algorithm, steps=12_000, config=config, **settings)
    policy = restore_policy(run, env)
    seen = observations(policy)
    exact = exactly(policy, seen)
    # A steep policy makes more of the round-off that JAX has itself.
    own = float(np.max(np.abs(policy(seen) - exact)))
    actions = assert_same(policy, tmp_path, env, seen, atol=1e-6 + 2 * own)
    off = lambda act: np.max(np.abs(np.stack([act(one) for one in seen]) - exact))
    in_c = off(compiled(tmp_path / "policy.h"))
    by_session = onnx_session(tmp_path / "policy.onnx")
    by_onnx = off(lambda one: by_session.run(None, {"observation": one})[0])
    # What the last bit of a sensor changes.
    nearby = exactly(policy, np.nextafter(seen, np.float32(np.inf)))
    rounded = np.max(np.abs(nearby - exact))
    print(
        f"{algorithm}, from float64: JAX {own:.1e}, C {in_c:.1e}, ONNX {by_onnx:.1e}; "
        f"the last bit of the observation changes {rounded:.1e}"
    )
    assert in_c < 1e-6 + 1.5 * own and by_onnx < 1e-6 + 1.5 * own
    assert own < 1e-5 and np.ptp(actions) > 0.2
    act = compiled(tmp_path / "policy.h", "-O3")
    many, took = observations(policy, 1000), []
    for _ in range(5):
        began = time.process_time()
        for seen in many:
            act(seen)
        took.append((time.process_time() - began) / len(many))
    assert min(took) < 100e-6


def test_a_policy_in_double_precision_is_exported_in_single(tmp_path):
    with jax.enable_x64(True):
        policy = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), perceptron())
        assert_same(policy, tmp_path, Sized(), observations(policy, 500))


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_what_is_not_a_number_stays_so(tmp_path, activation):
    seen = np.zeros(7, np.float32)
    seen[3] = np.nan
    for act in in_both(perceptron(activation), tmp_path, Sized()):
        assert np.isnan(act(seen)).all()


def weights(*shape):
    size = np.random.default_rng(sum(shape)).normal(size=shape)
    return jnp.asarray(size / shape[0] ** 0.5, jnp.float32)


def attention(weights, seen):
    tokens = jnp.tanh(seen[..., :6].reshape(*seen.shape[:-1], 3, 2) @ weights[:2])
    scores = jnp.einsum("...id,...jd->...ij", tokens, tokens)
    mixed = jax.nn.softmax(scores, axis=-1) @ tokens
    return mixed.max(axis=-2)[..., :2]


def activations(weights, seen):
    hidden = seen @ weights[:7, :6]
    parts = [jax.nn.gelu(hidden), jax.nn.gelu(hidden, approximate=False)]
    parts += [jax.nn.silu(hidden), jax.nn.softplus(hidden), jax.nn.selu(hidden)]
    parts += [jax.nn.leaky_relu(hidden), jax.nn.hard_tanh(hidden), jnp.sign(hidden)]
    parts += [jnp.exp(-(hidden**2)), jnp.abs(hidden) ** 0.5, jnp.sin(hidden) ** -2]
    parts += [jnp.where((hidden > 0) & ~(hidden > 1), hidden, 0.5)]
    return jnp.stack([part.mean(-1) for part in parts], -1)[..., [3, 1]] / 3


def layer_norm(weights, seen):
    hidden = seen @ weights[:7]
    centred = hidden - hidden.mean(-1, keepdims=True)
    scaled = centred * jax.lax.rsqrt((centred**2).mean(-1, keepdims=True) + 1e-6)
    return jnp.concatenate([scaled[..., ::-1], seen], -1)[..., 5:7]


def moved_about(weights, seen):
    padded = jnp.pad(seen, [(0, 0)] * (seen.ndim - 1) + [(1, 2)], constant_values=0.25)
    windows = jnp.stack([padded[..., i : i + 8] for i in range(3)], -1)
    kept = windows.at[..., 2, :].set(0.5)
    return jnp.tanh(jnp.moveaxis(kept, -1, -2) @ weights[:8, :2])[..., 1, :]


def rounds(weights, seen):
    def once(hidden, bias):
        return jnp.tanh(hidden @ weights[:7, :7] + bias), hidden[..., :2]

    biases = jnp.linspace(-1, 1, 3)
    last, before = jax.lax.scan(once, seen, biases, reverse=True)
    return last[..., :2] + before[1]


def convolutions(weights, seen):
    """With strides, dilation, padding and groups, along one axis and two."""
    along = lambda *words: dict(zip(("window_strides", "padding"), words, strict=True))
    batch = seen.reshape(-1, 7)
    kernel = weights[:3, :4].reshape(3, 1, 4)
    hidden = jax.lax.conv_general_dilated(
        batch[..., None], kernel, (1,), "SAME", dimension_numbers=("NHC", "HIO", "NHC")
    )
    hidden = jax.lax.conv_general_dilated(
        jnp.tanh(hidden),
        weights[:6, :8].reshape(3, 2, 8),
        **along((2,), [(2, 1)]),
        rhs_dilation=(2,),
        feature_group_count=2,
        dimension_numbers=("NHC", "HIO", "NHC"),
    )
    image = jnp.tanh(hidden).reshape(len(batch), 1, -1, 8)
    last = jax.lax.conv(image, weights[:2, :6].reshape(2, 1, 2, 3), (1, 2), "VALID")
    return last.mean((2, 3)).reshape(*seen.shape[:-1], 2)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "network",
    [attention, activations, layer_norm, moved_about, rounds, convolutions],
)
def test_any_network_of_these_primitives_acts_as_in_jax(tmp_path, network):
    policy = jax.tree_util.Partial(network, weights(8, 8))
    seen = observations(policy, 500)
    assert_same(policy, tmp_path, Sized(), seen)


def test_a_network_in_flax_acts_as_in_jax(tmp_path):
    import flax.linen as nn

    class Residual(nn.Module):
        outputs: int

        @nn.compact
        def __call__(self, inputs):
            hidden = nn.tanh(nn.Dense(16)(inputs))
            hidden = hidden + nn.swish(nn.LayerNorm()(nn.Dense(16)(hidden)))
            return nn.Dense(self.outputs)(hidden)

    config = PPOConfig(network=lambda role, outputs: Residual(outputs))
    like = untrained_policy(Trivial(), "ppo", config)
    random = np.random.default_rng(0)
    policy = jax.tree.map(
        lambda leaf: jnp.asarray(
            0.5 + 0.3 * random.normal(size=leaf.shape), leaf.dtype
        ),
        like,
    )
    assert_same(policy, tmp_path, Trivial(), observations(policy, 500))


@pytree
class Gated:
    """A gated recurrent unit and a count of decisions."""

    weights: jax.Array
    first: jax.Array
    by_observation: bool = dataclasses.field(metadata={"static": True}, default=False)

    def init(self, observation, state):
        hidden = jnp.broadcast_to(self.first, (len(observation), 6))
        hidden = hidden + observation[:, :6] if self.by_observation else hidden
        return hidden, jnp.zeros((len(observation),), jnp.int32)

    def act(self, memory, observation, state):
        hidden, count = memory
        apply = lambda k, inputs: inputs @ self.weights[k, : inputs.shape[-1]]
        both = jnp.concatenate([hidden, observation], -1)
        update, reset = (jax.nn.sigmoid(apply(k, both)) for k in (0, 1))
        new = jnp.tanh(apply(2, jnp.concatenate([reset * hidden, observation], -1)))
        hidden = (1 - update) * hidden + update * new
        shift = jnp.where(count > 3, 0.1, 0.0)[:, None]
        return hidden[:, :2] + shift, (hidden, count + 1)


def gated(**more):
    units = np.random.default_rng(0).normal(size=(3, 13, 6)) / 2
    return Gated(
        jnp.asarray(units, jnp.float32),
        jnp.linspace(-0.5, 0.5, 6, dtype=jnp.float32),
        **more,
    )


def actions_in_jax(policy, episodes):
    """Actions of a policy with memory in episodes of observations."""

    def played(memory, seen):
        action, memory = policy.act(memory, seen[None], None)
        return memory, jnp.clip(action[0], -1, 1)

    play = jax.jit(lambda e: jax.lax.scan(played, policy.init(e[:1], None), e)[1])
    return np.stack([play(episode) for episode in episodes])


def actions_by_onnx(file, contract, episodes):
    """Actions of an exported model with memory in episodes of observations."""
    session = onnx_session(file)
    found = []
    for episode in episodes:
        memory = [np.asarray(a["start"], a["type"]) for a in contract["memory"]]
        for seen in episode:
            given = {f"memory_{i}": array for i, array in enumerate(memory)}
            action, *memory = session.run(None, {"observation": seen} | given)
            found.append(action)
    return np.reshape(found, (*episodes.shape[:2], -1))


def actions_in_c(file, episodes):
    """Actions of an exported header with memory in episodes of observations."""
    act = compiled(file)
    found = []
    for episode in episodes:
        act.start(episode[0])
        found.append([act(seen) for seen in episode])
    return np.asarray(found)


@pytest.mark.parametrize("by_observation", [False, True])
def test_a_policy_with_memory_acts_as_in_jax_over_episodes(tmp_path, by_observation):
    policy = gated(by_observation=by_observation)
    episodes = observations(policy, 20 * 50).reshape(20, 50, 7)
    wanted = actions_in_jax(policy, episodes)
    contract = export_c(policy, Sized(), tmp_path / "gated.h")
    found = actions_in_c(tmp_path / "gated.h", episodes)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)
    assert [array["shape"] for array in contract["memory"]] == [[1, 6], [1]]
    if by_observation:
        assert contract["memory"][0]["start"] is None
        with pytest.raises(ValueError, match="ONNX: its first memory depends"):
            export_onnx(policy, Sized(), tmp_path / "gated.onnx")
        return
    contract = export_onnx(policy, Sized(), tmp_path / "gated.onnx")
    found = actions_by_onnx(tmp_path / "gated.onnx", contract, episodes)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("double", [False, True])
def test_a_recurrent_policy_of_ppo_acts_as_in_jax_over_episodes(tmp_path, double):
    config = PPOConfig(num_envs=4, gru_units=24, hidden_sizes=(16, 16))
    with jax.enable_x64(double):
        state = PPO.init(jax.random.key(0), Seen(), config)
        # Weights as large as learned ones: untrained actions are all about zero.
        policy = jax.tree.map(
            lambda leaf: leaf + 0.3 * jax.random.normal(jax.random.key(1), leaf.shape),
            PPO.policy(state),
        )
        policy = dataclasses.replace(policy, moments=state.moments)
        single = lambda leaf: jnp.asarray(np.asarray(leaf, np.float32))
        contract = export_c(policy, Seen(), tmp_path / "gru.h")
        export_onnx(policy, Seen(), tmp_path / "gru.onnx")
    drawn = np.random.default_rng(2).normal(size=(10, 500, 6))
    # Sensors drift: memory matters if observations belong together.
    episodes = np.cumsum(0.2 * drawn, axis=1, dtype=np.float32)
    wanted = actions_in_jax(jax.tree.map(single, policy), episodes)
    assert (np.abs(wanted) < 0.9).mean() > 0.2 and np.ptp(wanted) > 1
    found = actions_in_c(tmp_path / "gru.h", episodes)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)
    found = actions_by_onnx(tmp_path / "gru.onnx", contract, episodes)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)


@pytree
class Turning:
    """Two arrays of memory that only change places."""

    def init(self, observation, state):
        first = jnp.arange(5, dtype=jnp.float32)[None] / 10
        return first, first + 0.5

    def act(self, memory, observation, state):
        one, other = memory
        action = one[:, :2] * observation[:, :2] + 0 * other[:, :2]
        return action, (other[:, ::-1], jnp.roll(one, 1, axis=1))


def test_memory_may_change_places(tmp_path):
    policy, seen = Turning(), np.full((6, 7), 0.5, np.float32)
    contract = export_onnx(policy, Sized(), tmp_path / "turning.onnx")
    session = onnx_session(tmp_path / "turning.onnx")
    export_c(policy, Sized(), tmp_path / "turning.h")
    act = compiled(tmp_path / "turning.h")
    act.start(seen[0])
    memory = policy.init(seen[:1], None)
    given = [np.asarray(a["start"], a["type"]) for a in contract["memory"]]
    for one in seen:
        wanted, memory = policy.act(memory, one[None], None)
        names = {f"memory_{i}": array for i, array in enumerate(given)}
        found, *given = session.run(None, {"observation": one} | names)
        for action in (found, act(one)):
            np.testing.assert_allclose(action, wanted[0], rtol=0, atol=1e-7)


def until(seen):
    grow = lambda x: 2 * x
    return jax.lax.while_loop(lambda x: jnp.all(x < 1), grow, jnp.abs(seen))[..., :2]


@pytree
class Planner:
    """A policy that looks at the state."""

    def init(self, observation, state):
        return None

    def act(self, memory, observation, state):
        return state.arm.tip[:, :2], None


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (until, "primitive 'while', for which there is no rule"),
        (lambda seen: jnp.sort(seen)[..., :2], "primitive 'sort'"),
        (lambda seen: seen.astype(jnp.bfloat16)[..., :2], "numbers of type bfloat16"),
        (Planner(), "without the state of the environment"),
    ],
)
def test_what_cannot_be_exported_is_named(tmp_path, policy, words):
    if not isinstance(policy, Planner):
        policy = jax.tree_util.Partial(policy)
    for export in (export_c, export_onnx):
        with pytest.raises(ValueError, match=words):
            export(policy, Sized(), tmp_path / "policy")
    assert not list(tmp_path.iterdir())


@dataclasses.dataclass(frozen=True)
class Told(Sized):
    observation_channels = (Channel(3, "position", "m"), Channel(4, "speeds", "m/s"))
    name: str = "*/ #error /* \\"


def test_the_contract_says_what_goes_in_and_what_comes_out(tmp_path):
    file = tmp_path / "0 arm.h"
    told = export_c(perceptron(action_repeat=4), Told(), file, about={"seed": 3})
    assert told == json.loads((tmp_path / "0 arm.h.json").read_text())
    assert told["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert told["rate_hz"] == pytest.approx(12.5)
    assert told["about"]["seed"] == 3
    assert told["observation"]["entries"] == [
        {"name": "position", "unit": "m", "first": 0, "size": 3},
        {"name": "speeds", "unit": "m/s", "first": 3, "size": 4},
    ]
    moments = perceptron().moments
    scaling = told["observation"]["normalisation"]
    np.testing.assert_allclose(scaling["mean"], moments.mean)
    np.testing.assert_allclose(scaling["variance"], moments.variance)
    assert told["action"] == {"size": 2, "entries": None, "lower": -1, "upper": 1}
    assert told["functions"] == {"act": "policy_0_arm_act"}
    text = file.read_text()
    assert "3..6  speeds [m/s]" in text and "12.5 Hz" in text
    compiled(file)
    again = export_c(
        perceptron(action_repeat=4),
        Told(),
        tmp_path / "0 arm.h",
        about={"seed": 3},
        overwrite=True,
    )
    assert again == told


def test_channels_that_do_not_fit_are_refused(tmp_path):
    env = dataclasses.replace(Told(), observation_size=8)
    with pytest.raises(
        ValueError, match=r"observation_channels of .* 8 entries, got 7"
    ):
        export_c(perceptron(sizes=(8, 4, 2)), env, tmp_path / "policy.h")


def test_only_what_was_exported_is_replaced(tmp_path):
    policy, file = perceptron(), tmp_path / "policy.h"

    def export(**more):
        export_c(policy, Sized(), file, **more)

    file.write_text("mine")
    with pytest.raises(ValueError, match="does not replace it"):
        export(overwrite=True)
    assert file.read_text() == "mine"
    file.unlink()
    export()
    with pytest.raises(ValueError, match="exported before: replace it with"):
        export()
    export(overwrite=True)
    ours = file.read_text()
    file.write_text(ours + "/* tuned by hand */\n")
    with pytest.raises(ValueError, match="does not replace it"):
        export(overwrite=True)
    file.unlink()
    (tmp_path / "policy.h.json").write_text('{"mine": true}')
    with pytest.raises(ValueError, match="does not replace it"):
        export(overwrite=True)
    assert not file.exists()


def test_without_onnx_the_extra_is_named(tmp_path, monkeypatch):
    pretend_missing(monkeypatch, "onnx")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "jaxrod\[onnx\]"'):
        export_onnx(perceptron(), Sized(), tmp_path / "policy.onnx")
    export_c(perceptron(), Sized(), tmp_path / "policy.h")
