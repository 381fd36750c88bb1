"""brax's wrappers and learners see what the functional environments do."""

import contextlib
import dataclasses
import functools
import importlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import VectorEnvironment, make
from jaxrod.envs.gym import ids
from jaxrod.envs.trivial import Trivial
from missing import pretend_missing

MISSING = {"reason": "the brax extra is not installed"}
brax = pytest.importorskip("brax.envs", **MISSING)
adapter = pytest.importorskip("jaxrod.envs.brax_env", **MISSING)
ppo = pytest.importorskip("brax.training.agents.ppo.train", **MISSING)
ppo_networks = pytest.importorskip("brax.training.agents.ppo.networks", **MISSING)
sac = pytest.importorskip("brax.training.agents.sac.train", **MISSING)
acting = pytest.importorskip("brax.training.acting", **MISSING)
pmap = pytest.importorskip("brax.training.pmap", **MISSING)

pytestmark = pytest.mark.default_precision


@functools.lru_cache
def wrapped(env):
    """What brax's learners step, compiled: reset and step."""
    batch = brax.training.wrap(env, env.episode_length)
    return jax.jit(batch.reset), jax.jit(batch.step)


def started(env, num_envs, seed):
    """A batch as brax's learners start it."""
    keys = jax.random.split(jax.random.PRNGKey(seed), num_envs)
    return wrapped(env)[0](keys)


def check_same(env, num_envs, steps, rounding=0.0):
    """A batch under brax's wrappers is the functional one, restarts included."""

    def same(got, ours):
        if rounding:
            np.testing.assert_allclose(got, ours, rtol=0, atol=rounding)
        else:
            np.testing.assert_array_equal(got, ours)

    batch = VectorEnvironment(env.env)
    reset, step = jax.jit(batch.reset, static_argnums=1), jax.jit(batch.step)
    state = reset(jax.random.key(7), num_envs, env.sys)
    seen = started(env, num_envs, 7)
    same(seen.obs, state.observation)
    leaning = np.random.default_rng(0).uniform(
        -0.5, 1.5, (steps, num_envs, env.action_size)
    )
    terminations = truncations = 0
    for actions in np.clip(leaning, -1, 1).astype(np.float32):
        seen = wrapped(env)[1](seen, actions)
        state, expected = step(state, actions, env.sys)
        cut = expected.truncated & ~expected.terminated
        same(seen.obs, expected.observation)
        same(seen.reward, expected.reward)
        for got, ours in (
            (seen.done, expected.terminated | expected.truncated),
            (seen.info["truncation"], cut),
            (seen.info["time_out"], cut),
        ):
            np.testing.assert_array_equal(got, ours)
        assert seen.metrics.keys() == expected.info.keys()
        for name, value in expected.info.items():
            same(seen.metrics[name], value)
        terminations += int(expected.terminated.sum())
        truncations += int(cut.sum())
    return terminations, truncations


@pytest.mark.slow
def test_batch_is_the_functional_one_to_the_last_bit_over_many_episodes():
    assert min(check_same(TRIVIAL, 3, 60)) > 0


def test_a_randomised_batch_is_the_functional_one():
    varied = {"parameters": {"stride": {"uniform": (0.1, 0.3)}}, "delay": (0, 2)}
    env = adapter.BraxEnv(
        "trivial", episode_length=5, randomise=varied | {"noise": 0.1}
    )
    assert min(check_same(env, 2, 12, rounding=1e-6)) >= 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ids())
def test_batch_of_every_task_is_the_functional_one(name):
    """To rounding: XLA compiles the two programs, and need not fuse them alike."""
    task, variant, _ = name.removeprefix("jaxrod/").split("-")
    env = adapter.BraxEnv(task, variant=variant, episode_length=4)
    # Observations are of the order of 1, and of 10 where they are speeds.
    _, truncations = check_same(env, 2, 6, rounding=2e-4)
    assert truncations > 0


@dataclasses.dataclass(frozen=True)
class Failing(Trivial):
    """The point on a line; right of zero the simulator breaks down."""

    def step(self, key, state, action, params):
        observation, following, reward, *ends, info = super().step(
            key, state, action, params
        )
        broken = following.position > 0
        observation = jnp.where(broken, jnp.nan, observation)
        return observation, following, reward, *ends, info


TRIVIAL = adapter.BraxEnv("trivial")
FAILING = adapter.BraxEnv(Failing(episode_length=5))


def test_a_failure_is_a_truncation_to_brax_and_never_seen():
    state = started(FAILING, 3, 0)
    flagged = 0
    for _ in range(30):
        state = wrapped(FAILING)[1](state, jnp.ones((3, 1)))
        assert np.isfinite(state.obs).all() and np.isfinite(state.reward).all()
        early = np.asarray(state.metrics["flagged"] == 1)
        for mark in (state.done, state.info["truncation"], state.info["time_out"]):
            assert np.all(np.asarray(mark)[early] == 1)
        flagged += early.sum()
    assert flagged > 0


def test_without_brax_s_clock_the_environment_ends_its_own_episodes():
    for env, push, flagged in ((TRIVIAL, 0.0, 0), (FAILING, 1.0, 1)):
        reset, step = jax.jit(env.reset), jax.jit(env.step)
        state, steps = reset(jax.random.PRNGKey(1)), 0
        while not state.done:
            state = step(state, jnp.array([push]))
            steps += 1
        assert (steps < env.episode_length) == flagged
        assert state.info["time_out"] == 1 and state.metrics["flagged"] == flagged


def test_an_episode_asked_to_be_longer_than_it_is_ends_all_the_same():
    batch = brax.training.wrap(TRIVIAL, 1000)
    state = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(1), 1))
    step = jax.jit(batch.step)
    ends = []
    for _ in range(42):
        state = step(state, jnp.zeros((1, 1)))
        ends.append(bool(state.done[0]))
    assert ends == ([False] * 20 + [True]) * 2


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("repeat", [1, 2, 3])
@pytest.mark.parametrize("length", [5, 6])
def test_a_repeated_action_ends_with_the_episode(length, repeat):
    """The wrapper repeats past the end: nothing moves, nothing is paid or lost."""
    env = adapter.BraxEnv("trivial", episode_length=length)
    batch = brax.training.wrap(env, length, action_repeat=repeat)
    state = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(1), 1))
    alone = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(1), 1)[0])
    step, one, paid, expected = jax.jit(batch.step), jax.jit(env.step), 0.0, 0.0
    for _ in range(length):
        alone = one(alone, jnp.ones(1))
        expected += float(alone.reward)
    for k in range(-(-length // repeat)):
        assert (k == 0) or not state.done[0]
        state = step(state, jnp.ones((1, 1)))
        paid += float(state.reward[0])
    assert state.done[0] == state.info["truncation"][0] == 1
    assert state.info["time_out"][0] == 1
    assert paid == pytest.approx(expected, rel=1e-5)
    assert not step(state, jnp.ones((1, 1))).done[0]


@dataclasses.dataclass(frozen=True)
class Touching(Trivial):
    """The point on a line; its aim is to cross zero, once."""

    def step(self, key, state, action, params):
        observation, following, reward, ended, *rest = super().step(
            key, state, action, params
        )
        crossed = (state.position <= 0) & (following.position > 0)
        return observation, following, reward, ended | crossed, *rest


def shapes(tree):
    """Structure, shapes and types: what a scan insists on."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def test_contract_with_brax():
    """Holds, or brax leaves the extra `all`: docs/supported_versions.md."""
    assert isinstance(TRIVIAL, brax.Env)
    batch, count = brax.training.wrap(TRIVIAL, TRIVIAL.episode_length), 3
    start = started(TRIVIAL, count, 2)
    assert start.obs.shape == (count, TRIVIAL.observation_size)
    assert start.obs.dtype == jnp.float32
    assert start.reward.shape == start.done.shape == (count,)
    assert {"truncation", "steps", "time_out"} <= start.info.keys()
    # One stands still until the clock runs out, two run off the line before.
    pushes = jnp.array([[0.0], [1.0], [-1.0]])
    with training():
        (weights,) = pmap.bcast_local_devices((jnp.ones(3),))
        end, seen = acting.generate_unroll(
            batch,
            start,
            lambda observation, key: (pushes, {}),
            jax.random.PRNGKey(0),
            TRIVIAL.episode_length,
            extra_fields=("truncation", "time_out"),
        )
    assert weights.shape == (jax.local_device_count(), 3)
    assert shapes(end) == shapes(start)
    assert seen.observation.shape == (TRIVIAL.episode_length, *start.obs.shape)
    done = 1 - np.asarray(seen.discount)  # as brax stores it
    np.testing.assert_array_equal(np.flatnonzero(done[:, 0]), [19])
    assert done[:19, 1].any() and done[:19, 2].any()
    for name in ("truncation", "time_out"):
        mark = np.asarray(seen.extras["state_extras"][name])
        np.testing.assert_array_equal(mark, done * [1, 0, 0])
    # Restarted, and somewhere else than before.
    assert end.obs[0] != start.obs[0]
    assert np.all(np.abs(end.obs) <= 2)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("task", "truncation"), [(Failing, 1), (Touching, 0)])
def test_an_early_end_among_repeats_is_not_run_past(task, truncation):
    env = adapter.BraxEnv(task(episode_length=50))
    clock = brax.training.EpisodeWrapper(brax.training.VmapWrapper(env), 50, 4)
    state = jax.jit(clock.reset)(jax.random.split(jax.random.PRNGKey(1), 8))
    starts = state.obs[:, 0]
    step, to_the_right = jax.jit(clock.step), jnp.ones((8, 1))
    for _ in range(4):
        before, state = state, step(state, to_the_right)
        ended = np.asarray((before.done == 0) & (state.done == 1))
        np.testing.assert_array_equal(state.info["truncation"][ended], truncation)
    np.testing.assert_array_equal(state.done, 1)
    # Where it ended: one stride from zero, on the side that was seen last.
    where = state.obs[:, 0]
    seen = (-0.2 < where) & (where <= 0) if truncation else (0 < where) & (where <= 0.2)
    started_left = np.asarray(starts) < 0
    assert started_left.any() and np.all(np.asarray(seen)[started_left])


def test_parameters_are_what_brax_randomises_per_environment():
    def strides(params, rng):
        one_each = jnp.linspace(0, 0.3, rng.shape[0])
        shared = jax.tree.map(lambda _: None, params)
        return (
            dataclasses.replace(params, stride=one_each),
            dataclasses.replace(shared, stride=0),
        )

    keys = jax.random.split(jax.random.PRNGKey(0), 4)
    batch = brax.training.wrap(
        TRIVIAL, 20, randomization_fn=functools.partial(strides, rng=keys)
    )
    before = jax.jit(batch.reset)(keys)
    moved = jax.jit(batch.step)(before, jnp.ones((4, 1))).obs - before.obs
    np.testing.assert_allclose(moved[:, 0], [0, 0.1, 0.2, 0.3], atol=1e-6)
    assert TRIVIAL.sys is not None and jnp.ndim(TRIVIAL.sys.stride) == 0


def test_gradients_pass_through_the_adapter():
    def paid(action):
        start = TRIVIAL.reset(jax.random.PRNGKey(0))
        end = TRIVIAL.step(start, action)
        return end.reward, end.obs[0]

    slope, there = jax.jit(jax.grad(paid, has_aux=True))(jnp.array([0.5]))
    np.testing.assert_allclose(slope, [-2 * there * 0.2], rtol=1e-5)


@contextlib.contextmanager
def training():
    """What brax's learners need: the patch, and NumPy's rules for shapes."""
    with adapter.patched_jax(), jax.numpy_rank_promotion("allow"):
        yield


SMALL = {"episode_length": 20, "num_envs": 4, "num_eval_envs": 4}


def test_what_brax_calls_is_there_inside_and_gone_outside():
    with adapter.patched_jax():
        with adapter.patched_jax():
            pass
        copies = jax.device_put_replicated({"weight": jnp.ones(3)}, jax.devices())
    assert copies["weight"].shape == (jax.device_count(), 3)
    assert not hasattr(jax, "device_put_replicated")


@pytest.mark.slow
def test_ppo_of_brax_trains():
    network = functools.partial(
        ppo_networks.make_ppo_networks,
        policy_hidden_layer_sizes=(4,),
        value_hidden_layer_sizes=(4,),
    )
    with training():
        act, params, metrics = ppo.train(
            TRIVIAL,
            400,
            **SMALL,
            unroll_length=5,
            batch_size=4,
            num_minibatches=2,
            num_updates_per_batch=1,
            bootstrap_on_timeout=True,
            network_factory=network,
            run_evals=False,
        )
        action, _ = jax.jit(act(params))(jnp.zeros((4, 1)), jax.random.PRNGKey(0))
    assert np.isfinite(metrics["training/total_loss"])
    assert action.shape == (4, 1)


@pytest.mark.slow
def test_sac_of_brax_trains():
    with training():
        _, _, metrics = sac.train(
            TRIVIAL, 200, **SMALL, batch_size=8, min_replay_size=16
        )
    assert np.isfinite(metrics["training/critic_loss"])
    assert metrics["eval/avg_episode_length"] <= 20


@pytest.mark.slow
def test_ppo_of_brax_improves_on_the_first_case():
    env = adapter.BraxEnv("tracking", variant="clean", episode_length=250)
    network = functools.partial(
        ppo_networks.make_ppo_networks,
        policy_hidden_layer_sizes=(64, 64),
        value_hidden_layer_sizes=(64, 64),
    )
    returns = []
    with training():
        ppo.train(
            env,
            800_000,
            episode_length=env.episode_length,
            num_envs=64,
            num_eval_envs=64,
            num_evals=2,
            deterministic_eval=True,
            unroll_length=25,
            batch_size=64,
            num_minibatches=8,
            num_updates_per_batch=4,
            learning_rate=1e-3,
            discounting=0.97,
            entropy_cost=1e-3,
            normalize_observations=True,
            network_factory=network,
            progress_fn=lambda _, m: returns.append(float(m["eval/episode_reward"])),
        )
    first, last = returns
    assert first < 0
    assert last > 0.5 * first, returns


def test_bad_input_is_refused_in_words():
    with pytest.raises(ValueError, match=r"no options, got .*variant"):
        adapter.BraxEnv(make("trivial"), variant="clean")


def test_without_brax_a_sentence_says_what_to_install(monkeypatch):
    pretend_missing(monkeypatch, "brax", "jaxrod.envs.brax_env")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "jaxrod\[brax\]"'):
        importlib.import_module("jaxrod.envs.brax_env")


@pytest.mark.parametrize("shape", [(), (3,), (1, 1)])
def test_an_action_of_another_shape_is_refused_as_it_was_given(shape):
    env = adapter.BraxEnv(Trivial())
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    words = re.escape(f"action must have shape (1,), got {shape}")
    with pytest.raises(ValueError, match=words):
        jax.eval_shape(env.step, state, jnp.zeros(shape))
