"""The snake crawls as its published gait does, and its task keeps its promises."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.envs import make
from jaxrod.envs.soft_bodies.snake_body import FlatGround
from jaxrod.envs.tasks.snake import CONTROL_PERIOD, PERIOD, crosses_itself
from jaxrod.rods.motion import motion_of
from playing import (
    KEY,
    check_vmap_is_a_loop,
    gradient_error,
    play,
    start,
    stepping,
)

PYELASTICA_FORWARD = 0.15874
"""Mean of periods 3 to 9 of PyElastica 1.0's snake, forward [lengths per period]."""


def crawl(env, periods, **of_body):
    """Way along the heading under the published gait in each period [lengths]."""
    params = env.default_params()
    of_body = {name: jnp.asarray(value) for name, value in of_body.items()}
    body = dataclasses.replace(params.body, **of_body)
    params = dataclasses.replace(params, body=body)
    each = round(PERIOD / CONTROL_PERIOD)

    def step(state, _):
        action = env.scripted_action(state, params)
        _, state, reward, *_, info = env.step(KEY, state, action, params)
        return state, (reward, info["flagged"])

    run = jax.jit(lambda state: jax.lax.scan(step, state, length=periods * each))
    _, (rewards, flagged) = run(env.reset(KEY, params)[1])
    assert not np.any(flagged)
    return np.asarray(rewards).reshape(periods, each).sum(axis=1) / 100


@pytest.mark.slow
def test_the_published_gait_is_as_fast_as_pyelastica_s():
    """Without the viscosity, which theirs has not and which takes 4 % of the speed."""
    env = make("snake")
    elastic = crawl(env, 5, relaxation_time=0.0)[3:]
    viscous = crawl(env, 5)[3:]
    # From period to period the same.
    assert np.ptp(elastic) < 1e-4 and np.ptp(viscous) < 1e-4
    assert abs(np.mean(elastic) / PYELASTICA_FORWARD - 1) < 0.01
    assert 0.03 < 1 - np.mean(viscous) / np.mean(elastic) < 0.05


@pytest.mark.slow
def test_the_speed_does_not_hang_on_the_number_of_elements():
    ways = [crawl(make("snake", n_elements=n), 4)[-1] for n in (21, 42)]
    assert abs(ways[1] / ways[0] - 1) < 0.02


@pytest.mark.slow
def test_the_ground_is_that_of_contact_under_the_whole_weight():
    """Friction of nodes that slip alike, along elements that all point one way."""
    angle, speed = 0.3, np.array([0.02, -0.05, 0.0])
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    rod, state = jaxrod.straight_rod(
        6,
        length=0.35,
        radius=0.004,
        density=1000.0,
        youngs_modulus=1e6,
        direction=direction,
        normal=(0.0, 0.0, 1.0),
    )
    line = float(rod.linear_density[0])
    weight, depth, friction = line * 9.81, 2e-4, jnp.asarray([0.1, 0.15, 0.2])
    lying = dataclasses.replace(
        state,
        positions=state.positions.at[2].add(-depth),
        velocities=jnp.tile(jnp.asarray(speed)[:, None], (1, 7)),
    )
    ours = FlatGround(jnp.asarray(weight), friction, jnp.asarray(1000 * line))
    contact = jaxrod.contact(
        jaxrod.shapes.plane((0.0, 0.0, -0.004), (0.0, 0.0, 1.0)),
        stiffness=weight / depth,
        # The onset is done with long before this depth.
        onset=1e-6,
        friction=friction,
        friction_drag=1000 * line,
    )
    motion = motion_of(lying)
    found = ours.loads(rod, motion).forces
    expected = contact.loads(rod, motion).forces
    for axis in (0, 1):
        np.testing.assert_allclose(found[axis], expected[axis], rtol=1e-5)
    assert np.abs(found[0]).max() > 1e-4 and np.abs(found[2]).max() < 1e-15


@pytest.mark.slow
def test_steps_are_stable_and_the_body_is_the_published_one():
    for n in (14, 21, 42):
        env = make("snake", n_elements=n)
        params = env.default_params()
        bound = jaxrod.stable_dt(params.body.scene(), 1.0).dt
        assert 0.6 < params.dt / bound < 0.83
    rod = params.body.rod
    np.testing.assert_allclose(rod.length, 0.35, rtol=1e-12)
    mass = 1000 * np.pi * (0.011 * 0.35) ** 2 * 0.35
    np.testing.assert_allclose(np.sum(rod.node_masses), mass, rtol=1e-12)


@pytest.mark.slow
def test_observations_are_of_the_heading_s_frame():
    """Turning body and heading together changes nothing but rounding."""
    env = make("snake", turn=1.0)
    params = env.default_params()
    wriggle = 0.8 * jnp.asarray([1.0, -1, 0.5, 1, -0.3, 0.2])

    def after(state):
        for _ in range(2):
            obs, state, reward, *_ = stepping(env)(KEY, state, wriggle, params)
        return obs, reward

    _, state = env.reset(KEY, params)
    assert abs(state.heading[1]) > 0.01
    c, s = np.cos(0.7), np.sin(0.7)
    turn = jnp.asarray([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    half = jnp.asarray([np.cos(0.35), 0, 0, np.sin(0.35)])
    body = state.body
    turned = dataclasses.replace(
        state,
        body=dataclasses.replace(
            body,
            positions=turn @ body.positions,
            orientations=_product(half, body.orientations),
        ),
        heading=turn[:2, :2] @ state.heading,
    )
    for a, b in zip(after(state), after(turned), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
        assert np.abs(a).max() > 1e-3


def _product(p, q):
    """Of a quaternion about the vertical with others."""
    w, z = p[0], p[3]
    return jnp.stack(
        [
            w * q[0] - z * q[3],
            w * q[1] - z * q[2],
            w * q[2] + z * q[1],
            w * q[3] + z * q[0],
        ]
    )


def test_controls_change_no_faster_than_they_may_and_rewards_are_the_way():
    env = make("snake")
    actions = jnp.asarray([[3.0, -3, 1, -1, 0.1, 0]] * 6)
    states, obs, rewards, terminated, truncated, info = play(env, actions)
    np.testing.assert_allclose(states.controls[0], [0.2, -0.2, 0.2, -0.2, 0.1, 0])
    np.testing.assert_allclose(states.controls[5], [1, -1, 1, -1, 0.1, 0], rtol=1e-12)
    np.testing.assert_array_equal(obs[:, -6:], states.controls)
    np.testing.assert_allclose(
        np.sum(rewards) / 100 * 0.35, info["distance"][-1], rtol=1e-9
    )
    assert not np.any(terminated) and not np.any(truncated)
    assert not np.any(info["flagged"])
    # To the left where the control value is positive.
    assert obs[-1, 5] > 0.5 and obs[-1, 6] < -0.5


def test_a_crash_freezes_the_snake_pays_nothing_and_truncates():
    env = make("snake")
    params = env.default_params()
    _, state = env.reset(KEY, params)
    broken = dataclasses.replace(
        state.body, velocities=state.body.velocities.at[1, 3].set(1e4)
    )
    crashed = dataclasses.replace(state, body=broken)
    obs, after, reward, terminated, truncated, info = stepping(env)(
        KEY, crashed, jnp.ones(6), params
    )
    assert truncated and not terminated and info["flagged"] and reward == 0
    np.testing.assert_array_equal(after.body.positions, state.body.positions)
    assert np.all(np.isfinite(obs))


def test_a_line_crosses_itself_on_a_circle_and_not_on_a_spiral():
    turn = np.linspace(0, 2.2 * np.pi, 22)
    for opening, crossed in ((0.01, True), (0.3, False)):
        size = 1 + opening * np.sin(3 * turn) if crossed else 1 + opening * turn
        nodes = jnp.asarray([size * np.cos(turn), size * np.sin(turn)])
        assert bool(crosses_itself(nodes)) == crossed
        assert bool(crosses_itself(nodes[:, ::-1])) == crossed


def test_a_body_that_crosses_itself_ends_the_episode():
    env = make("snake")
    params, state = start(env)
    turn = jnp.linspace(0, 1.3 * 2 * np.pi, 21)
    edges = 0.35 / 21 * jnp.stack([jnp.cos(turn), jnp.sin(turn), 0 * turn])
    body = dataclasses.replace(
        state.body,
        positions=jnp.pad(jnp.cumsum(edges, axis=1), ((0, 0), (1, 0))),
        orientations=_product(
            (jnp.cos(turn / 2), 0, 0, jnp.sin(turn / 2)), state.body.orientations
        ),
    )
    assert np.abs(body.directors[2] - edges * 21 / 0.35).max() < 1e-12
    looped = dataclasses.replace(state, body=body)
    *_, terminated, truncated, info = stepping(env)(KEY, looped, jnp.zeros(6), params)
    assert terminated and not truncated and not info["flagged"]


@pytest.mark.slow
def test_headings_are_drawn_up_to_the_turn():
    env = make("snake", turn=0.5)
    params = env.default_params()
    keys = jax.random.split(KEY, 200)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    angles = np.arctan2(states.heading[:, 1], states.heading[:, 0])
    assert angles.min() < -0.4 and angles.max() > 0.4 and np.abs(angles).max() <= 0.5


@pytest.mark.slow
def test_episodes_end_in_time():
    env = make("snake", episode_length=3)
    *_, truncated, info = play(env, jnp.zeros((3, 6)))
    assert truncated.tolist() == [False, False, True]
    np.testing.assert_allclose(info["distance"], 0, atol=1e-12)


@pytest.mark.slow
def test_gradient_of_the_return_is_that_of_finite_differences():
    env = make("snake", n_elements=7)
    time = np.arange(6)[:, None]
    actions = jnp.asarray(0.15 * np.sin(0.7 * time + np.arange(6)))
    assert gradient_error(env, actions) < 1e-6


@pytest.mark.slow
@pytest.mark.default_precision
def test_vmap_is_a_loop_and_numbers_are_single():
    # Nodes that stick and slip: 147 steps of round-off in velocities of 0.1 m/s.
    check_vmap_is_a_loop(make("snake"), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variant": "paper"}, "variant must be one of clean"),
        ({"n_elements": 20}, "n_elements must be a multiple of 7, got 20"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
        ({"turn": -0.1}, "turn must .* got -0.1"),
        ({"turn": 4.0}, "turn must be at most pi rad, got 4 rad"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("snake", **options)
