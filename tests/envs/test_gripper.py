"""The gripper lifts the ball by its script, and its task keeps its promises."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import Ramp
from jaxrod.envs import check_environment, make
from jaxrod.envs.soft_bodies.gripper_body import BALL, MOST_PRESSURE
from playing import KEY, check_vmap_is_a_loop, gradient_error, play, start, stepping


def placed(state, x, y):
    """A state with the ball elsewhere on the table."""
    ball = state.body["ball"]
    place = ball.positions.at[:2, 0].set(jnp.stack([x, y]))
    ball = dataclasses.replace(ball, positions=place)
    return dataclasses.replace(state, body={**state.body, "ball": ball})


@pytest.mark.slow
def test_the_script_lifts_the_ball_and_holds_it_from_wherever_it_lies():
    env = make("gripper")
    params = env.default_params()

    @jax.jit
    def lifted(x, y):
        first = placed(env.reset(KEY, params)[1], x, y)

        def step(state, _):
            action = env.scripted_action(state, params)
            _, state, reward, _, _, info = env.step(KEY, state, action, params)
            return state, (reward, info)

        return first, *jax.lax.scan(step, first, length=80)

    ways = []
    for angle in (0.3, 0.3 + 2 * np.pi / 3):
        x, y = 0.012 * np.cos(angle), 0.012 * np.sin(angle)
        first, last, (rewards, info) = lifted(x, y)
        assert not np.any(info["flagged"])
        assert info["score"][-1] > 85
        # What was gained since the first step is what was paid.
        gained = info["score"][-1] - info["score"][0]
        np.testing.assert_allclose(np.sum(rewards[1:]), gained, rtol=1e-9)
        # It hangs still, by friction: the wrist is above the height to reach.
        ball = last.body["ball"]
        assert last.body["ball"].positions[2, 0] > 0.12
        assert np.abs(ball.velocities).max() < 2e-3
        np.testing.assert_allclose(ball.positions[:2, 0], [x, y], atol=2e-3)
        assert np.abs(first.body["ball"].velocities).max() == 0
        ways.append(last.body["ball"].positions[2, 0])
    # A third of a turn is the same with the fingers exchanged.
    np.testing.assert_allclose(ways[0], ways[1], rtol=1e-6)


@pytest.mark.slow
def test_nothing_moves_while_nothing_is_asked():
    env = make("gripper", episode_length=6)
    states, _, _, terminated, truncated, info = play(env, jnp.zeros((6, 6)))
    assert not np.any(info["flagged"]) and not np.any(terminated)
    assert truncated.tolist() == [False] * 5 + [True]
    ball = states.body["ball"].positions[..., 0]
    np.testing.assert_allclose(ball[:, :2], ball[:1, :2] * np.ones((6, 1)), atol=1e-12)
    # It sinks in until the table carries it, m g / k.
    weight = 4 / 3 * np.pi * BALL**3 * 200.0 * 9.81
    np.testing.assert_allclose(BALL - ball[-1, 2], weight / 500.0, rtol=0.02)
    # Fingers hang straight, a little longer.
    nodes = np.asarray(states.body["fingers"].positions[-1])
    np.testing.assert_allclose(nodes[:, :2, -1], nodes[:, :2, 0], atol=1e-9)
    assert np.all(nodes[:, 2, 0] - nodes[:, 2, -1] > 0.1)


@pytest.mark.slow
def test_pressure_bends_inwards_and_the_wrist_goes_where_it_is_told():
    env = make("gripper")
    actions = jnp.tile(jnp.asarray([1.0, 0.0, -1.0, 0.2, 0.0, -0.3]), (8, 1))
    states, obs, *_ = play(env, actions)
    controls, wrist = np.asarray(states.controls), np.asarray(states.wrist)
    np.testing.assert_allclose(controls[0], [0.5, 0, -0.5, 0.2, 0, -0.3], atol=1e-12)
    np.testing.assert_allclose(controls[2], actions[2], atol=1e-12)
    np.testing.assert_allclose(wrist[-1], [0.016, 0, -0.024], atol=1e-12)
    roots = np.asarray(states.body["fingers"].positions[..., 0])
    way = np.tile(wrist[-1] - wrist[0], (3, 1))
    np.testing.assert_allclose(roots[-1] - roots[0], way, atol=1e-9)
    tips = np.asarray(states.body["fingers"].positions[-1, :, :, -1]) - wrist[-1]
    reach = np.linalg.norm(tips[:, :2], axis=1)
    assert reach[0] < 0.03 and abs(reach[1] - 0.046) < 5e-3 and reach[2] > 0.06
    np.testing.assert_allclose(obs[-1, 10:13], controls[-1, 3:], atol=1e-12)
    np.testing.assert_allclose(obs[-1, 13:16], controls[-1, :3], atol=1e-12)


@pytest.mark.slow
def test_steps_are_stable_at_full_pressure():
    env = make("gripper")
    params = env.default_params()
    none, all_of_it = jnp.zeros((3, 3)), jnp.full(3, MOST_PRESSURE)
    times = jnp.zeros(3), jnp.ones(3)
    acting = params.body._acting(
        Ramp(none, none, *times), Ramp(all_of_it, all_of_it, *times)
    )
    assert 0.8 < params.dt / jaxrod.stable_dt(acting).dt < 1
    still = params.body.system.at(0.0)
    assert not jaxrod.health(still, params.body.rest, params.dt).flagged
    check_environment(env)


@pytest.mark.slow
def test_slopes_through_a_touch_are_those_of_finite_differences():
    env = make("gripper", episode_length=6)
    params = env.default_params()
    # Low enough for the fingers to close on the ball.
    down = jnp.asarray([0.0, 0.0, -0.08])
    rest = params.body.rest
    lowered = dataclasses.replace(
        rest["fingers"], positions=rest["fingers"].positions + down[None, :, None]
    )
    fingers = params.body.fingers
    driven, *others = fingers.effects
    path = dataclasses.replace(driven.place, start=driven.place.start + down[None])
    effects = (dataclasses.replace(driven, place=path), *others)
    members = {
        **params.body.system.members,
        "fingers": dataclasses.replace(fingers, effects=effects),
    }
    system = dataclasses.replace(params.body.system, members=members)
    body = dataclasses.replace(
        params.body, system=system, rest={**rest, "fingers": lowered}
    )
    params = dataclasses.replace(params, body=body)
    # Within all limits, where the return has a slope.
    actions = jnp.tile(jnp.asarray([0.9, 0.85, 0.8, 0.02, -0.01, -0.1]), (6, 1))
    assert gradient_error(env, actions, params) < 1e-6


@pytest.mark.slow
def test_a_crash_freezes_it_pays_nothing_and_truncates():
    env = make("gripper")
    params, state = start(env)
    fingers = state.body["fingers"]
    broken = dataclasses.replace(
        fingers, velocities=fingers.velocities.at[1, 0, 4].set(1e4)
    )
    crashed = dataclasses.replace(state, body={**state.body, "fingers": broken})
    obs, after, reward, terminated, truncated, info = stepping(env)(
        KEY, crashed, jnp.ones(6), params
    )
    assert truncated and not terminated and info["flagged"] and reward == 0
    np.testing.assert_array_equal(after.body["fingers"].positions, fingers.positions)
    np.testing.assert_array_equal(after.wrist, state.wrist)
    assert np.all(np.isfinite(obs))


@pytest.mark.slow
@pytest.mark.default_precision
def test_vmap_is_a_loop_and_numbers_are_single():
    check_vmap_is_a_loop(make("gripper"), atol=2e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variant": "paper"}, "variant must be one of clean"),
        ({"n_elements": 3}, "n_elements"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
        ({"spread": 0.04}, "spread must be at most 0.03 m, got 0.04 m"),
        ({"spread": -0.01}, "spread"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("gripper", **options)
