"""SHAC climbs the gradient of the simulation, and APG does without a critic."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs.trivial import Trivial, TrivialParams
from jaxrod.training import SHACConfig, evaluate, train
from jaxrod.training.algorithms import shac

CONFIG = SHACConfig(
    num_envs=16,
    rollout_steps=8,
    action_repeat=1,
    hidden_sizes=(32, 32),
    learning_rate=5e-3,
    discount=0.9,
    reward_scale=1.0,
)


def test_nothing_is_expected_after_a_task_has_ended_and_a_value_after_a_cut():
    """Three environments: one goes on, one ends, one is cut short, after two steps."""
    random, discount = np.random.default_rng(1), 0.9
    earned, value = random.normal(size=(2, 4, 3))
    terminated, done = np.zeros((2, 4, 3), bool)
    terminated[1, 1], done[1, 1:] = True, True
    names = [field.name for field in dataclasses.fields(shac.Window)]
    window = shac.Window(
        **dict.fromkeys(names)
        | {
            "earned": jnp.asarray(earned),
            "terminated": jnp.asarray(terminated),
            "done": jnp.asarray(done),
        }
    )
    found = shac.objective(window, jnp.asarray(value), discount)
    r, g = earned.T, discount
    expected = (
        r[0] @ g ** np.arange(4) + g**4 * value[3, 0],
        r[1, 0] + g * r[1, 1] + r[1, 2] + g * r[1, 3] + g**2 * value[3, 1],
        r[2, 0] + g * r[2, 1] + g**2 * value[1, 2]
        + r[2, 2] + g * r[2, 3] + g**2 * value[3, 2],
    )  # fmt: skip
    np.testing.assert_allclose(found, sum(expected) / 12, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"critic": False},
        {"objective": "reward"},
    ],
)
def test_trivial_task_is_learned_to_its_known_optimum(changes):
    env = Trivial()
    result = train(
        env,
        "shac",
        steps=20_000,
        config=dataclasses.replace(CONFIG, **changes),
        progress=False,
        evaluation_episodes=0,
    )
    score = evaluate(env, result.policy, episodes=1000).mean
    assert env.optimal_return - 0.1 < score < env.optimal_return + 0.05
    assert all(row["skipped"] == 0 for row in result.progress)


@pytest.mark.slow
def test_the_policy_climbs_what_the_batch_earns_and_differences_agree():
    config = dataclasses.replace(CONFIG, num_envs=3, rollout_steps=5, minibatches=1)
    # Some episodes of four steps end within the window.
    env = Trivial(episode_length=4)
    state = jax.jit(shac.init, static_argnums=1)(jax.random.key(0), env, config)
    noise = jax.random.normal(jax.random.key(1), (5, 3, 1))

    @jax.jit
    def earned(weights, target):
        at = dataclasses.replace(state, weights=state.weights | {"target": target})
        _, window = shac.acted(at, weights, noise)
        following = shac.target_value(at, window.final_observation)
        return shac.objective(window, following, config.discount)

    weights, target = state.weights["policy"], state.weights["target"]
    flat, back = jax.flatten_util.ravel_pytree(weights)
    slope, _ = jax.flatten_util.ravel_pytree(jax.grad(earned)(weights, target))
    way = jax.random.normal(jax.random.key(2), flat.shape)
    step = 1e-6 * way
    ahead, behind = earned(back(flat + step), target), earned(back(flat - step), target)
    assert float(jnp.linalg.norm(slope)) > 0.1
    np.testing.assert_allclose(slope @ way, (ahead - behind) / 2e-6, rtol=1e-6)
    # The value of where windows end is in it.
    nothing = jax.tree.map(jnp.zeros_like, target)
    assert float(earned(weights, target)) != float(earned(weights, nothing))


@pytest.mark.slow
def test_a_gradient_that_is_not_finite_moves_nothing_and_is_counted():
    params = TrivialParams(stride=jnp.asarray(jnp.nan))
    state = jax.jit(shac.init, static_argnums=1)(
        jax.random.key(0), Trivial(), CONFIG, params
    )
    after, metrics = jax.jit(shac.update)(state)
    assert float(metrics.scalars["skipped"]) == 1
    for old, new in zip(
        jax.tree.leaves((state.weights["policy"], state.optimiser["policy"])),
        jax.tree.leaves((after.weights["policy"], after.optimiser["policy"])),
        strict=True,
    ):
        np.testing.assert_array_equal(old, new)
    for leaf in jax.tree.leaves((after.weights, metrics.scalars)):
        assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_a_run_that_was_interrupted_ends_as_if_it_had_not(tmp_path):
    run = {
        "config": CONFIG,
        "progress": False,
        "evaluation_episodes": 0,
        "chunk_steps": 128,
        "checkpoint_seconds": 0.0,
    }
    whole = train(Trivial(), "shac", steps=1280, **run)

    class Stop(Exception):
        pass

    def stop(row):
        if row["env_steps"] >= 640:
            raise Stop

    with pytest.raises(Stop):
        train(Trivial(), "shac", steps=1280, out=tmp_path, log=stop, **run)
    again = train(Trivial(), "shac", steps=1280, out=tmp_path, resume=True, **run)
    assert 0 < len(again.progress) < len(whole.progress)
    for a, b in zip(
        jax.tree.leaves(whole.state), jax.tree.leaves(again.state), strict=True
    ):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("objective", "fame"),
        ("critic", 2),
        ("minibatches", 3),
        ("epochs", 0),
        ("target_rate", 1.5),
        ("gradient_norm", 0.0),
        ("critic_learning_rate", -1.0),
    ],
)
def test_bad_setting_is_refused_by_name_and_value(name, value):
    config = dataclasses.replace(CONFIG, **{name: value})
    with pytest.raises(ValueError, match=name) as refusal:
        train(Trivial(), "shac", steps=1000, config=config, progress=False)
    assert str(value) in str(refusal.value)


@dataclasses.dataclass(frozen=True)
class Costless:
    """A task without a smooth cost."""

    name: str = "costless"


def test_a_task_without_a_cost_is_refused_in_words():
    with pytest.raises(ValueError, match=r"Costless has no cost .* to reward"):
        shac.WithCost(Costless())
