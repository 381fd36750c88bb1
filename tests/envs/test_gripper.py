"""The gripper lifts the ball by its script, and its task keeps its promises."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.envs import check_environment, make
from jaxrod.envs.soft_bodies import gripper_body
from jaxrod.envs.soft_bodies.gripper_body import BALL, MOST_PRESSURE, SUNK
from jaxrod.envs.tasks import gripper
from jaxrod.envs.tasks.gripper import SLACK
from jaxrod.schedules import Ramp
from playing import KEY, check_vmap_is_a_loop, gradient_error, play, start, stepping


def placed(state, x, y):
    """A state with the ball elsewhere on the table."""
    ball = state.body["ball"]
    place = ball.positions.at[:2, 0].set(jnp.stack([x, y]))
    ball = dataclasses.replace(ball, positions=place)
    return dataclasses.replace(state, body={**state.body, "ball": ball})


def moved(params, way, ball=0.0):
    """Parameters with wrist and fingers elsewhere, and the ball."""
    body = params.body
    driven, *others = body.fingers.effects
    path = dataclasses.replace(driven.place, start=driven.place.start + way[None])
    effects = (dataclasses.replace(driven, place=path), *others)
    fingers = dataclasses.replace(body.fingers, effects=effects)
    members = {**body.system.members, "fingers": fingers}
    rest = {
        name: dataclasses.replace(
            body.rest[name], positions=body.rest[name].positions + by
        )
        for name, by in (("fingers", way[None, :, None]), ("ball", ball))
    }
    system = dataclasses.replace(body.system, members=members)
    return dataclasses.replace(
        params, body=dataclasses.replace(body, system=system, rest=rest)
    )


@pytest.mark.slow
def test_the_script_lifts_the_ball_and_holds_it_from_wherever_it_lies():
    env = make("gripper", lowered=0.0)
    params = env.default_params()

    @jax.jit
    def lifted(x, y):
        first = placed(env.reset(KEY, params)[1], x, y)

        def step(state, _):
            action = env.scripted_action(state, params)
            _, state, reward, _, _, info = env.step(KEY, state, action, params)
            return state, (reward, info)

        return first, *jax.lax.scan(step, first, length=env.episode_length)

    ways = []
    for angle in (0.3, 0.3 + 2 * np.pi / 3):
        x, y = 0.012 * np.cos(angle), 0.012 * np.sin(angle)
        first, last, (rewards, info) = lifted(x, y)
        assert not np.any(info["flagged"])
        assert info["score"][-1] > 75
        # The return is the mean score.
        np.testing.assert_allclose(np.sum(rewards), np.mean(info["score"]), rtol=1e-9)
        assert info["borne"][6] < 0.1 and info["borne"][-1] == 1
        # It hangs still: the wrist is above the height to reach.
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
    env = make("gripper", lowered=0.0, episode_length=6)
    states, _, _, terminated, truncated, info = play(
        env, jnp.tile(jnp.asarray([SLACK, 0.0, 0.0, 1.0]), (6, 1))
    )
    assert not np.any(info["flagged"]) and not np.any(terminated)
    assert truncated.tolist() == [False] * 5 + [True]
    ball = states.body["ball"].positions[..., 0]
    np.testing.assert_allclose(ball[:, :2], ball[:1, :2] * np.ones((6, 1)), atol=1e-12)
    # It sinks in until the table carries it, m g / k.
    weight = 4 / 3 * np.pi * BALL**3 * 100.0 * 9.81
    np.testing.assert_allclose(BALL - ball[-1, 2], weight / 500.0, rtol=0.02)
    np.testing.assert_allclose(SUNK, weight / 500.0, rtol=1e-12)
    assert info["borne"][-1] < 0.02
    # Fingers hang straight, a little longer.
    nodes = np.asarray(states.body["fingers"].positions[-1])
    np.testing.assert_allclose(nodes[:, :2, -1], nodes[:, :2, 0], atol=1e-9)
    assert np.all(nodes[:, 2, 0] - nodes[:, 2, -1] > 0.1)


@pytest.mark.slow
def test_pressure_bends_inwards_and_the_wrist_goes_where_it_is_told():
    env = make("gripper", lowered=0.0)
    ways = []
    for pressure in (1.0, SLACK, -1.0):
        actions = jnp.tile(jnp.asarray([pressure, 0.7, -0.2, -0.5]), (5, 1))
        states, obs, *_ = play(env, actions)
        controls = np.asarray(states.controls)
        # 0.02 m in a control step at most, of 0.045 m from the middle height.
        first = [min(pressure, SLACK + 1), 0.7, -0.2, 1 - 0.02 / 0.045]
        np.testing.assert_allclose(controls[0], first, atol=1e-12)
        np.testing.assert_allclose(controls[-1], actions[-1], atol=1e-12)
        np.testing.assert_allclose(obs[-1, 7:11], actions[-1], atol=1e-12)
        wrist = np.asarray([0.014, -0.004, -1.5 * 0.045])
        nodes = np.asarray(states.body["fingers"].positions)
        angles = 2 * np.pi * np.arange(3) / 3
        roots = 0.05 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
        roots[:, 2] = 0.2
        np.testing.assert_allclose(nodes[-1, :, :, 0], roots + wrist, atol=1e-9)
        tips = nodes[-1, :, :2, -1] - wrist[:2]
        ways.append(np.linalg.norm(tips, axis=1))
    inwards, straight, outwards = ways
    assert np.all(inwards < 0.03) and np.all(outwards > 0.06)
    assert np.all(np.abs(straight - 0.05) < 5e-3)


def in_other_order(params):
    """The same gripper with its members listed from the last to the first."""
    system, rest = params.body.system, params.body.rest
    names = list(system.members)[::-1]
    assert names != list(system.members)
    turned = jaxrod.make_system(
        {name: system.members[name] for name in names},
        *system.couplings[::-1],
        state={name: rest[name] for name in names},
    )
    return dataclasses.replace(
        params, body=dataclasses.replace(params.body, system=turned)
    )


@pytest.mark.slow
@pytest.mark.parametrize("way", ["elsewhere", "in another order"])
def test_it_lifts_the_same_elsewhere_and_with_members_in_another_order(way):
    env = make("gripper", lowered=0.0, episode_length=12)
    params = env.default_params()
    aside = jnp.asarray([0.3, -0.2, 0.0])
    pressures = jnp.asarray([*[-1.0] * 5, *[1.0] * 7])
    heights = jnp.asarray([*[-1.0] * 9, *[1.0] * 3])

    @jax.jit
    def lifted(params):
        def step(state, told):
            pressure, height = told
            action = jnp.stack([pressure, 0.05 + 0 * height, 0 * height, height])
            _, state, _, _, _, info = env.step(KEY, state, action, params)
            return state, (info["height"], state.body["fingers"].positions[:, :2, -1])

        first = env.reset(KEY, params)[1]
        return jax.lax.scan(step, first, (pressures, heights))[1]

    here, tips = lifted(params)
    # The fingers carry it up with the wrist, 0.02 m in a control step; it swings.
    assert np.all(np.diff(here[8:]) > 0.01)
    np.testing.assert_allclose(here[-1] - here[8], 0.06, atol=5e-3)
    assert here[4] < 0 and here[-1] > 0.07
    if way == "elsewhere":
        other, by = moved(params, aside, aside[:, None]), aside[:2]
    else:
        other, by = in_other_order(params), jnp.zeros(2)
    there, tips_there = lifted(other)
    np.testing.assert_allclose(there, here, atol=1e-9)
    np.testing.assert_allclose(
        tips_there - tips, np.broadcast_to(by, tips.shape), atol=1e-9
    )


@pytest.mark.slow
def test_the_score_rises_with_the_grip_from_touch_to_lift():
    env = make("gripper", lowered=0.0)
    params = env.default_params()

    @jax.jit
    @jax.vmap
    def gripped(pressure):
        first = placed(env.reset(KEY, params)[1], jnp.zeros(()), jnp.zeros(()))

        def step(state, time):
            now = jnp.where(time < 6, -1.0, pressure)
            action = jnp.stack([now, jnp.zeros(()), jnp.zeros(()), -jnp.ones(())])
            _, state, _, _, _, info = env.step(KEY, state, action, params)
            return state, info

        info = jax.lax.scan(step, first, jnp.arange(14))[1]
        return jax.tree.map(lambda leaf: leaf[-1], info)

    # Touched from about -0.2 on, lifted off from about 0.2 on.
    pressures = jnp.asarray([-0.3, -0.1, 0.0, 0.1, 0.3])
    info = gripped(pressures)
    assert not np.any(info["flagged"])
    assert info["borne"][0] < 0.02 and info["borne"][-1] == 1
    steps = np.diff(info["borne"])
    assert np.all(steps > 0.05)
    # With tips that already touch, it is the weight they bear that earns more.
    assert np.all(np.diff(info["score"])[1:3] > 1.5)
    assert np.all(np.diff(info["score"]) > 0)


def scored(place, tips, controls=(0.0, 0.0, 0.0, 0.0)):
    """Points for a ball in a place, and the ends of all fingers in another."""
    body = {
        "ball": SimpleNamespace(positions=jnp.asarray(place)[:, None]),
        "fingers": SimpleNamespace(
            positions=jnp.broadcast_to(jnp.asarray(tips)[None, :, None], (3, 3, 2))
        ),
    }
    made = SimpleNamespace(body=body, controls=jnp.asarray(controls))
    return float(gripper._score(made)), np.asarray(gripper._between(made))


def test_points_are_those_of_the_table():
    """A hundred for a ball that is lifted, gripped and borne between the fingers."""
    up, aside = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    low, lift = BALL * up, gripper.LIFT * up
    _, middle = scored(low, low)
    most = (gripper_body.HIGHEST - gripper.LOWEST) / 2
    way = np.array([gripper.ASIDE, gripper.ASIDE, most])

    def told(height):
        """Controls with which the ball is between the fingers at a height."""
        return 0.0, *((low + height - middle) / way)

    high = low + lift
    assert scored(high, lift, told(lift))[0] == pytest.approx(100)
    # Half as high, and the tips half as near.
    tips = lift / 2 + gripper.OPEN / 2 * aside
    points = scored(low + lift / 2, tips, told(lift / 2))[0]
    assert points == pytest.approx(15 + 10 + 20 + 22.5)
    # Half way from near to far.
    away = high + (gripper.NEAR + gripper.FAR) / 2 * aside
    assert scored(away, lift, told(lift))[0] == pytest.approx(7.5 + 45)


@pytest.mark.slow
@pytest.mark.default_precision
def test_the_ball_lies_anywhere_near_the_middle_on_the_table():
    env = make("gripper")
    params = env.default_params()
    keys = jax.random.split(KEY, 64)
    _, states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    places = np.asarray(states.body["ball"].positions)[..., 0]
    rest = np.asarray(params.body.rest["ball"].positions)[:, 0]
    spread = float(params.spread)
    away = places[:, :2] - rest[:2]
    assert np.all(np.abs(away) <= spread) and spread > 0
    assert np.all(np.ptp(away, axis=0) > 1.6 * spread)
    np.testing.assert_array_equal(places[:, 2], rest[2])


@pytest.mark.slow
def test_fingers_press_the_ball_into_the_table_without_going_into_it():
    """The wrist comes down with closing fingers, as random actions have it."""
    env = make("gripper")
    params = env.default_params()

    @jax.jit
    @jax.vmap
    def pressed(key):
        reset_key, action_key = jax.random.split(key)
        actions = jax.random.uniform(action_key, (3, 4), minval=-1.0)

        def step(state, action):
            _, state, _, _, _, info = env.step(KEY, state, action, params)
            moment = params.body.system.at(0.0)
            health = jaxrod.health(moment, state.body, params.dt)
            return state, (info["flagged"], health.largest_violation, info["height"])

        return jax.lax.scan(step, env.reset(reset_key, params)[1], actions)[1]

    flagged, violation, height = pressed(jax.random.split(KEY, 64))
    assert not np.any(flagged)
    # Some press it deeper into the table than thrice its weight does.
    assert height.min() < -3 * SUNK
    assert 0.2 < violation.max() < 0.8


@pytest.mark.slow
def test_a_lowered_wrist_hangs_around_the_ball_and_touches_nothing():
    env = make("gripper")
    params = env.default_params()
    _, states = jax.vmap(env.reset, in_axes=(0, None))(
        jax.random.split(KEY, 64), params
    )
    roots = states.body["fingers"].positions[:, :, 2, 0]
    height = states.controls[:, 3] * 0.045 + 0.155
    np.testing.assert_allclose(roots, np.repeat(height[:, None], 3, 1), atol=1e-12)
    assert height.min() < 0.12 and height.max() > 0.19
    nodes = states.body["fingers"].positions
    apart = np.linalg.norm(nodes - states.body["ball"].positions[:, None], axis=2)
    assert apart.min() > BALL + 0.008
    assert nodes[:, :, 2].min() > 0.008


@pytest.mark.slow
@pytest.mark.parametrize(("n", "least"), [(4, 0.74), (7, 0.8), (8, 0.8)])
def test_steps_are_stable_at_full_pressure(n, least):
    env = make("gripper", n_elements=n)
    params = env.default_params()
    none, all_of_it = jnp.zeros((3, 3)), jnp.full(3, MOST_PRESSURE)
    times = jnp.zeros(3), jnp.ones(3)
    acting = params.body._acting(
        Ramp(none, none, *times), Ramp(all_of_it, all_of_it, *times)
    )
    assert least < params.dt / jaxrod.stable_dt(acting, 0.9).dt < 1
    still = params.body.system.at(0.0)
    assert not jaxrod.health(still, params.body.rest, params.dt).flagged
    check_environment(env)


@pytest.mark.slow
def test_slopes_through_a_touch_are_those_of_finite_differences():
    env = make("gripper", lowered=0.0, episode_length=4)
    params = env.default_params()
    # Low enough for the fingers to close on the ball.
    params = moved(params, jnp.asarray([0.0, 0.0, -0.08]))
    # Within all limits, where the return has a slope.
    actions = jnp.tile(jnp.asarray([0.9, 0.02, -0.01, 0.93]), (4, 1))
    actions = actions.at[:, 0].set(jnp.asarray([0.3, 0.95, 0.9, 0.95]))
    # A touch begins within 1e-6 of these actions, where the slope changes. The program
    # takes three and a half times as long to compile with optimisation.
    assert gradient_error(env, actions, params, 1e-7, optimised=False) < 1e-6


@pytest.mark.slow
def test_a_crash_freezes_it_pays_nothing_and_truncates():
    env = make("gripper", lowered=0.0)
    params, state = start(env)
    fingers = state.body["fingers"]
    broken = dataclasses.replace(
        fingers, velocities=fingers.velocities.at[1, 0, 4].set(1e4)
    )
    crashed = dataclasses.replace(state, body={**state.body, "fingers": broken})
    obs, after, reward, terminated, truncated, info = stepping(env)(
        KEY, crashed, jnp.ones(4), params
    )
    assert truncated and not terminated and info["flagged"] and reward == 0
    np.testing.assert_array_equal(after.body["fingers"].positions, fingers.positions)
    np.testing.assert_array_equal(after.controls, state.controls)
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
        ({"spread": 0.04}, "spread must be at most 0.02 m, got 0.04 m"),
        ({"spread": -0.01}, "spread"),
        ({"lowered": 1.5}, "lowered"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("gripper", **options)
