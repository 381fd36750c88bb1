"""DAgger learns what the planner does, from visited states alone."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.trivial import Trivial
from jaxrod.training import DAggerConfig, evaluate, train
from jaxrod.training.algorithms.dagger import better_actions, model_of

CONFIG = DAggerConfig(
    num_envs=16,
    rollout_steps=8,
    action_repeat=1,
    hidden_sizes=(32, 32),
    lookahead=1,
    effort=1e-6,
    gradient_steps=32,
    batch_size=128,
    buffer_size=20_000,
    planner_steps=1000.0,
    learning_rate=3e-3,
)


@pytest.mark.slow
@pytest.mark.default_precision
def test_trivial_task_is_learned_to_its_known_optimum():
    env = Trivial()
    result = train(
        env,
        "dagger",
        steps=12_000,
        config=CONFIG,
        progress=False,
        evaluation_episodes=0,
        chunk_steps=128,
    )
    score = evaluate(env, result.policy, episodes=1000).mean
    assert env.optimal_return - 0.1 < score < env.optimal_return + 0.05
    assert result.summary["final_score"] > env.optimal_return - 1
    # The planner acts at first, and leaves the policy alone after a thousand steps.
    shares = [row["planner_share"] for row in result.progress]
    assert shares[0] == 1 and shares[8:] == [0] * len(shares[8:])
    assert shares[4] == pytest.approx(1 - 4 * 128 / 1000)
    # Of the model: four passes of one control step for each of 128 decisions.
    assert {row["model_steps"] for row in result.progress} == {4 * 128}
    # A fifth of what SAC and TD3 are given, and all that was said is remembered.
    assert int(result.state.advice.written) * 16 == result.summary["env_steps"]


@pytest.mark.slow
def test_the_planner_says_the_best_action_within_its_bounds():
    env = Trivial()
    params = env.default_params()
    keys = jax.random.split(jax.random.key(0), 50)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    effort, stride = jnp.asarray(1e-4), params.stride
    said, reached = better_actions(
        env, params, states, jnp.zeros((50, 1)), 2, effort, 3
    )
    # min (x + 2 s u)^2 + e u^2, by hand; damping of a step leaves a thousandth.
    best = -2 * stride * states.position / (4 * stride**2 + effort)
    np.testing.assert_allclose(said[:, 0], jnp.clip(best, -1, 1), atol=1e-3)
    left = (states.position + 2 * stride * said[:, 0]) ** 2
    np.testing.assert_allclose(reached, left + effort * said[:, 0] ** 2, atol=1e-12)


@pytest.mark.slow
def test_the_planner_brings_an_arm_nearer_and_a_broken_one_is_left_alone():
    env = make("tracking", variant="clean", n_elements=10, substeps=2)
    params = env.default_params()
    keys = jax.random.split(jax.random.key(1), 3)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    broken = states.arm.velocities.at[2].set(jnp.nan)
    arm = dataclasses.replace(states.arm, velocities=broken)
    states = dataclasses.replace(states, arm=arm)
    begun = jnp.full((3, env.action_size), 0.1)
    said, reached = jax.jit(
        lambda states, begun: better_actions(
            env, params, states, begun, 24, jnp.asarray(1e-2), 2
        )
    )(states, begun)
    assert np.isfinite(said).all() and float(jnp.max(jnp.abs(said))) <= 1
    np.testing.assert_array_equal(said[2], begun[2])

    def cost(state, action):
        state = env.predict(state, action, params, 24)
        return env.cost(state, action, params) + 1e-2 * jnp.sum(action**2)

    for which in range(2):
        state = jax.tree.map(lambda leaf, i=which: leaf[i], states)
        after = float(cost(state, said[which]))
        assert after == pytest.approx(float(reached[which]), rel=1e-6)
        assert after < 0.8 * float(cost(state, begun[which]))


@pytest.mark.slow
def test_a_run_that_was_interrupted_ends_as_if_it_had_not(tmp_path):
    run = {
        "config": dataclasses.replace(CONFIG, gradient_steps=4, hidden_sizes=(8,)),
        "progress": False,
        "evaluation_episodes": 0,
        "chunk_steps": 128,
        "checkpoint_seconds": 0.0,
    }
    whole = train(Trivial(), "dagger", steps=1280, **run)

    class Stop(Exception):
        pass

    def stop(row):
        if row["env_steps"] >= 640:
            raise Stop

    with pytest.raises(Stop):
        train(Trivial(), "dagger", steps=1280, out=tmp_path, log=stop, **run)
    again = train(Trivial(), "dagger", steps=1280, out=tmp_path, resume=True, **run)
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
        ("lookahead", 0),
        ("plan_iterations", 0),
        ("effort", 0.0),
        ("planner_steps", -1.0),
        ("learning_rate", float("nan")),
        ("batch_size", 100),
        ("buffer_size", 100),
        ("discount", 0.9),
        ("reward_scale", 1.0),
    ],
)
def test_bad_setting_is_refused_by_name_and_value(name, value):
    config = dataclasses.replace(CONFIG, **{name: value})
    with pytest.raises(ValueError, match=name) as refusal:
        train(Trivial(), "dagger", steps=1000, config=config, progress=False)
    assert str(value) in str(refusal.value)


@dataclasses.dataclass(frozen=True)
class Opaque:
    """A task that cannot be planned with."""

    env: Trivial = dataclasses.field(default_factory=Trivial)
    predict = None

    def __getattr__(self, name):
        if name in ("residuals", "cost") or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.env, name)


def test_a_task_that_cannot_be_planned_with_is_refused_in_words():
    with pytest.raises(ValueError, match=r"Opaque cannot be planned with: .*residuals"):
        model_of(Opaque())
