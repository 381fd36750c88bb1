"""Contact alone lets a cable into its socket, and the task keeps its promises."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.contacts.points import contact_points
from jaxrod.envs import make
from jaxrod.envs.soft_bodies.held_cable import BORE, HIGH, LENGTH, RADIUS, WALL
from jaxrod.envs.tasks.hand_task import HELD_STEPS
from jaxrod.envs.tasks.insert import DEEP, GOAL, STRAIGHT
from playing import (
    KEY,
    check_vmap_is_a_loop,
    gradient_error,
    parameters,
    start,
    stepping,
)

LEANING = jnp.asarray([0.16, -0.12, 1.0]) / jnp.sqrt(1.04)
"""Unit vector along a socket, upwards."""


def placed(env, tip, depth=GOAL, offset=0.0, angle=0.0):
    """Parameters, and a state with a straight cable whose tip is at a point.

    The socket stands so that the tip is at the depth and offset, and the cable at the
    angle to its axis.
    """
    params, state = start(env)
    moved = tip - state.body.tip
    body = dataclasses.replace(
        state.body, positions=state.body.positions + moved[:, None]
    )
    inwards = jnp.asarray([jnp.sin(angle), 0.0, -jnp.cos(angle)])
    across = jnp.asarray([jnp.cos(angle), 0.0, jnp.sin(angle)])
    return params, dataclasses.replace(
        state,
        body=body,
        coordinates=body.positions[:, 0],
        mouth=tip - depth * inwards - offset * across,
        inwards=inwards,
    )


def test_starts_are_apart_from_the_socket_and_within_their_ranges():
    env = make("insert")
    params = parameters(env)
    keys = jax.random.split(KEY, 300)
    begin = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))
    observation, states = jax.tree.map(np.asarray, begin(keys, params))
    params = jax.tree.map(np.asarray, params)
    body, mouth = states.body.positions, states.mouth
    assert np.all(np.isfinite(observation))
    np.testing.assert_allclose(body[:, :, 0], states.coordinates, atol=1e-12)
    np.testing.assert_allclose(body[:, 2, 0] - body[:, 2, -1], LENGTH, rtol=1e-9)
    np.testing.assert_allclose(states.body.velocities, 0)
    # No node touches the socket or the floor, whatever is drawn.
    assert np.all(body[:, 2] > np.max(mouth[:, 2]) + 2 * RADIUS)
    foot = mouth + HIGH * states.inwards
    np.testing.assert_allclose(foot[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(states.inwards, axis=1), 1, rtol=1e-9)
    for drawn, lower, upper in (
        (states.coordinates, params.lower, params.upper),
        (foot[:, :2], -params.spread, params.spread),
        (states.inwards[:, :2] / states.inwards[:, 2:], -params.lean, params.lean),
    ):
        low, high = np.min(drawn, axis=0), np.max(drawn, axis=0)
        assert np.all(low >= lower - 1e-9) and np.all(high <= upper + 1e-9)
        assert np.all(high - low > 0.9 * (upper - lower))


@pytest.mark.parametrize(
    ("options", "is_there"),
    [
        ({"depth": 1.01 * DEEP}, True),
        ({"depth": 0.99 * DEEP}, False),
        ({"depth": 1.01 * HIGH}, False),
        ({"offset": 0.99 * BORE}, True),
        ({"offset": 1.01 * BORE}, False),
        ({"angle": 0.99 * STRAIGHT}, True),
        ({"angle": 1.01 * STRAIGHT}, False),
    ],
)
def test_being_there_has_a_depth_a_width_and_an_angle(options, is_there):
    env = make("insert")
    params, state = placed(env, jnp.asarray([0.05, -0.02, 0.1]), **options)
    assert env.is_there(state, params) == is_there
    _, told = env.judged(state, params)
    expected = {"depth": GOAL, "offset": 0.0, "angle": 0.0} | options
    for name, value in expected.items():
        np.testing.assert_allclose(told[name], value, rtol=1e-5, atol=2e-6)


def test_the_score_is_that_of_the_page_and_rises_on_the_way_in():
    env = make("insert")
    tip = jnp.asarray([0.05, -0.02, 0.1])

    def score(*place):
        params, state = placed(env, tip, *place)
        return float(env.judged(state, params)[0])

    assert score(GOAL) == pytest.approx(100, abs=1e-3)
    way = np.hypot(0.004, 0.01) + 2 * 0.045 / 17
    near = (40 + 20) / (1 + (way / 0.02) ** 2)
    expected = 20 / (1 + (way / 0.1) ** 2) + near
    assert score(0.025, 0.004, STRAIGHT) == pytest.approx(expected, rel=1e-3)
    # From far above, over a hover beside the axis and the mouth, down to the goal.
    path = [(-0.1, 0.1), (-0.05, 0.05), (-0.02, 0.02), (-0.02, 0.0), (0.0, 0.0)]
    rising = [score(*place) for place in [*path, (0.02, 0.0), (GOAL, 0.0)]]
    assert np.all(np.diff(rising) > 0)
    # A tip as near that stands beside the socket is worth less than above it.
    assert score(0.03, BORE + WALL + RADIUS) < score(-0.02, 0.0)


def test_success_is_half_a_second_in_the_socket_without_a_break():
    env = make("insert")
    params, state = placed(env, jnp.asarray([0.02, 0.01, 0.0152]), depth=0.0345)
    found = []
    for _ in range(HELD_STEPS + 1):
        _, state, reward, *_, info = stepping(env)(KEY, state, jnp.zeros(3), params)
        found.append((int(state.held), bool(info["success"]), float(reward)))
    held, success, rewards = zip(*found, strict=True)
    assert held == (1, 2, 3, 4, 5, 6)
    assert success == (False,) * 4 + (True,) * 2
    np.testing.assert_allclose(rewards, 100 / env.episode_length, rtol=0.01)
    away = dataclasses.replace(state, mouth=state.mouth - jnp.asarray([0, 0, 0.006]))
    _, away, *_, info = stepping(env)(KEY, away, jnp.zeros(3), params)
    assert away.held == 0 and info["success"] == 0


def test_a_crash_freezes_cable_and_hand_and_pays_nothing():
    env = make("insert")
    params, state = start(env)
    obs, after, reward, terminated, truncated, info = stepping(env)(
        KEY, state, jnp.asarray([jnp.nan, 0.0, 0.0]), params
    )
    assert truncated and not terminated and info["flagged"] and reward == 0
    np.testing.assert_array_equal(after.body.positions, state.body.positions)
    np.testing.assert_array_equal(after.coordinates, state.coordinates)
    assert np.all(np.isfinite(obs))


def test_the_socket_that_is_drawn_is_the_one_that_is_touched():
    """A leaning socket pushes a cable at its axis nowhere, and in its wall outwards."""
    body = parameters(make("insert")).body
    mouth = jnp.asarray([0.03, -0.05, 0.0]) + HIGH * LEANING
    socket = body.above(mouth, -LEANING).scene.effects[1]
    across = jnp.asarray([0.6, 0.8, 0.0])
    across = across - jnp.sum(across * LEANING) * LEANING
    across = across / jnp.linalg.norm(across)
    for offset, distance in (
        (0.0, BORE),
        (BORE - 0.002, 0.002),
        (BORE + 0.002, -0.002),
        (BORE + WALL + 0.01, 0.01),
    ):
        point = mouth - 0.4 * HIGH * LEANING + offset * across
        found, normal = socket.body.surface(tuple(point[:, None]))
        np.testing.assert_allclose(found[0], distance, atol=1e-7)
        if offset:
            inner = offset < BORE + 0.5 * WALL
            way = jnp.sum(jnp.stack(normal)[:, 0] * across)
            np.testing.assert_allclose(way, -1 if inner else 1, atol=1e-6)


@pytest.mark.slow
def test_no_wall_is_crossed_whatever_the_hand_does():
    """Random hands, above and beside sockets; contact holds, and no success is near."""
    env = make("insert")
    params = parameters_in_single(env)
    many, random = 128, np.random.default_rng(0)
    keys = jax.random.split(KEY, many)
    _, states = jax.vmap(env.reset, (0, None))(keys, params)
    # The tips begin beside the sockets, as low as hands can be, half of them far off.
    turn = jnp.asarray(random.uniform(-np.pi, np.pi, many), "float32")
    apart = jnp.where(jnp.arange(many) % 2, 0.045, 0.075)
    foot = states.mouth + HIGH * states.inwards
    beside = foot + jnp.stack(
        [apart * jnp.cos(turn), apart * jnp.sin(turn), jnp.full(many, 0.215)], axis=1
    )
    body = jax.vmap(params.body.hanging)(beside)
    states = dataclasses.replace(states, body=body, coordinates=beside)
    # They rush at the socket, then at random, and never rise.
    held = random.uniform(-1, 1, (8, many, 3)).repeat(5, axis=0)
    held[:, :, 2] = -np.abs(held[:, :, 2])
    held[:10, :, :2] = -np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rod = params.body.rod
    socket = lambda state: env.body_in(state, params).scene.effects[1]

    def pressed(state):
        """Depth at contact points, over the radius."""
        touch, place = socket(state), tuple(state.body.positions)
        distances = [
            touch.body.surface(points.of_nodes(place))[0]
            for points in contact_points(rod, touch.points_per_element)
        ]
        return 1 - jnp.min(jnp.concatenate(distances)) / RADIUS

    def step(states, actions):
        found = jax.vmap(env.step, (0, 0, 0, None))(keys, states, actions, params)
        deep = jax.vmap(lambda s: socket(s).violation(rod, s.body))(found[1])
        return found[1], (found[-1], deep, jax.vmap(pressed)(found[1]))

    _, (info, deep, at_points) = jax.jit(lambda s, a: jax.lax.scan(step, s, a))(
        states, jnp.asarray(held, "float32")
    )
    assert not np.any(info["flagged"])
    assert 0.01 < np.max(at_points) < 0.5
    # Between the contact points a pressed rod is deeper.
    assert np.max(deep) < 0.8
    assert not np.any(info["success"])


def parameters_in_single(env):
    """Parameters in single precision, as learners have them."""
    return jax.tree.map(
        lambda leaf: leaf.astype("float32") if leaf.dtype == "float64" else leaf,
        env.default_params(),
    )


@pytest.mark.slow
def test_steps_are_stable():
    for n in (6, 8, 10, 16):
        env = make("insert", n_elements=n)
        params = env.default_params()
        ratio = params.dt / jaxrod.stable_dt(params.body.scene, 1.0).dt
        assert 0.5 < ratio < 0.9, (n, ratio)


@pytest.mark.slow
def test_a_prediction_is_a_step():
    env = make("insert")
    params, state = start(env)
    action = jnp.asarray([0.3, -0.2, -1.0])
    predicted = jax.jit(env.predict, static_argnums=3)(state, action, params, 3)
    for _ in range(3):
        state = stepping(env)(KEY, state, action, params)[1]
    for a, b in zip(jax.tree.leaves(predicted), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11)


@pytest.mark.slow
def test_the_cost_is_smallest_straight_in_the_socket():
    env = make("insert")

    def cost(*place):
        params, state = placed(env, jnp.asarray([0.05, -0.02, 0.1]), *place)
        return float(env.cost(state, jnp.zeros(3), params))

    assert cost(GOAL) < 1e-6
    assert cost(GOAL, 0.002) > 1e-3 and cost(GOAL, 0.0, 0.1) > 1e-3
    path = [(-0.1, 0.1), (-0.02, 0.05), (-0.02, 0.0), (0.0, 0.0), (0.02, 0.0)]
    falling = [cost(*place) for place in [*path, (GOAL, 0.0)]]
    assert np.all(np.diff(falling) < 0)


@pytest.mark.slow
def test_gradient_of_the_return_is_that_of_finite_differences():
    env = make("insert")
    time = np.arange(5)[:, None]
    actions = jnp.asarray(0.8 * np.sin(0.7 * time + np.arange(3)) - [0, 0, 0.5])
    assert gradient_error(env, actions) < 1e-5


@pytest.mark.slow
@pytest.mark.default_precision
def test_vmap_is_a_loop_and_numbers_are_single():
    check_vmap_is_a_loop(make("insert"), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variant": "paper"}, "variant must be one of clean"),
        ({"n_elements": 5}, "n_elements .* at least 6, got 5"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("insert", **options)
