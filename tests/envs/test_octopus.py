"""The octopus crawls by its script, and its task keeps its promises."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.envs import check_environment, make
from playing import KEY, check_vmap_is_a_loop, play, start, stepping


@pytest.mark.slow
def test_it_rests_on_the_floor_and_stays_where_it_is():
    env = make("octopus", episode_length=20)
    states, _, rewards, terminated, truncated, info = play(env, jnp.zeros((20, 16)))
    assert not np.any(info["flagged"]) and not np.any(terminated)
    assert truncated.tolist() == [False] * 19 + [True]
    # Eight arms alike: it does not know where to go.
    assert np.abs(states.body["head"].positions[-1, :2]).max() < 1e-9
    assert np.abs(np.sum(rewards)) < 1e-6
    heights = states.body["arms"].positions[-1, :, 2]
    radii = parameters_of(env).rod.radii
    assert np.all(heights[:, 1:-1] > 0.5 * radii[:, 1:]) and heights.max() < 0.015


def parameters_of(env):
    """The arms as they are in the default parameters."""
    return env.default_params().body.system.members["arms"]


@pytest.mark.slow
def test_rowing_goes_forward_and_along_the_heading():
    env = make("octopus")
    params = env.default_params()

    def way(heading):
        _, state = env.reset(KEY, params)
        state = dataclasses.replace(state, heading=jnp.asarray(heading))

        def step(state, _):
            action = env.scripted_action(state, params)
            _, state, reward, *_, info = env.step(KEY, state, action, params)
            return state, (reward, info["flagged"])

        state, (rewards, flagged) = jax.lax.scan(step, state, length=60)
        return state.body["head"].positions[:, 0], jnp.sum(rewards), jnp.any(flagged)

    go = jax.jit(way)
    place, reward, flagged = go((1.0, 0.0))
    assert reward > 4 and not flagged
    np.testing.assert_allclose(reward, 100 * place[0] / 0.2, rtol=1e-9)
    # Two arms further on everything is the same.
    turned, same, _ = go((0.0, 1.0))
    np.testing.assert_allclose(same, reward, rtol=1e-6)
    np.testing.assert_allclose(turned[1], place[0], rtol=1e-6)


@pytest.mark.slow
def test_steps_are_stable_and_weights_are_what_they_should_be():
    for n in (3, 5):
        params = make("octopus", n_elements=n).default_params()
        bound = jaxrod.stable_dt(params.body.system, 1.0).dt
        assert 0.6 < params.dt / bound < 0.83
    env = make("octopus")
    params = env.default_params()
    body = params.body
    bound = jaxrod.stable_dt(body.system, 1.0).dt
    assert 0.6 < params.dt / bound < 0.83
    assert not jaxrod.health(body.system, body.rest, params.dt).flagged
    check_environment(env)


@pytest.mark.slow
def test_muscles_bend_an_arm_to_the_left_and_upwards():
    env = make("octopus")
    first = jnp.zeros((8, 2)).at[0, 0].set(1.0).at[4, 1].set(1.0)
    states, obs, *_ = play(env, jnp.tile(jnp.ravel(first), (5, 1)))
    controls = np.asarray(states.controls)
    np.testing.assert_allclose(controls[0, 0], [0.4, 0], atol=1e-12)
    np.testing.assert_allclose(controls[4], first, atol=1e-12)
    np.testing.assert_allclose(obs[4, -16:], jnp.ravel(first), atol=1e-12)
    tips = np.asarray(states.body["arms"].positions[-1, :, :, -1])
    angle = np.pi / 8
    left = np.array([-np.sin(angle), np.cos(angle), 0.0])
    assert tips[0] @ left > 0.02
    assert tips[4, 2] > 0.03 and abs(tips[2, 2]) < 0.015


@pytest.mark.slow
def test_a_crash_freezes_it_pays_nothing_and_truncates():
    env = make("octopus")
    params, state = start(env)
    arms = state.body["arms"]
    broken = dataclasses.replace(arms, velocities=arms.velocities.at[3, 1, 3].set(1e4))
    crashed = dataclasses.replace(state, body={**state.body, "arms": broken})
    obs, after, reward, terminated, truncated, info = stepping(env)(
        KEY, crashed, jnp.ones(16), params
    )
    assert truncated and not terminated and info["flagged"] and reward == 0
    np.testing.assert_array_equal(after.body["arms"].positions, arms.positions)
    assert np.all(np.isfinite(obs))


@pytest.mark.slow
@pytest.mark.default_precision
def test_vmap_is_a_loop_and_numbers_are_single():
    check_vmap_is_a_loop(make("octopus"), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variant": "paper"}, "variant must be one of clean"),
        ({"n_elements": 2}, "n_elements"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
        ({"turn": 4.0}, "turn must be at most pi rad, got 4 rad"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("octopus", **options)


@pytest.mark.slow
def test_controls_follow_the_action_either_way_and_no_farther_than_they_may():
    env = make("octopus", n_elements=3)
    params, state = start(env)
    most = float(params.body.largest_change)
    actions = jnp.linspace(-3, 3, env.action_size)
    _, after, *_ = jax.jit(env.step)(KEY, state, actions, params)
    change = np.ravel(after.controls - state.controls)
    wanted = np.clip(actions, -1, 1) - np.ravel(state.controls)
    assert 0 < most < 1
    np.testing.assert_allclose(change, np.clip(wanted, -most, most), rtol=1e-5)
