"""A catheter follows its drive and stays in its vessel; the task is what it says."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.envs import make
from jaxrod.envs.soft_bodies.branching_vessel import (
    BACK,
    BRANCH_LENGTH,
    BRANCH_LUMEN,
    FORK,
    LUMEN,
    branch_directions,
    vessel_wall,
)
from jaxrod.envs.soft_bodies.hand import Glide
from jaxrod.envs.soft_bodies.steered_catheter import (
    BENDING_LENGTH,
    LENGTH,
    MOST_BEND,
    RADIUS,
)
from jaxrod.envs.tasks.catheter import DEEP, FAR, GOAL, NEAR
from jaxrod.envs.tasks.hand_task import HELD_STEPS
from playing import (
    KEY,
    check_vmap_is_a_loop,
    gradient_error,
    parameters,
    start,
    stepping,
)


def placed(env, depth=GOAL, offset=0.0):
    """Parameters, and a state, whose tip is at a depth and offset in its branch.

    Only the fork is moved, and neither the catheter nor the wall.
    """
    params, state = start(env)
    x, y, _ = state.branch
    across = jnp.stack([-y, x, jnp.zeros(())]) / jnp.hypot(x, y)
    fork = state.body.tip - depth * state.branch - offset * across
    return dataclasses.replace(params, fork=fork), state


def distances(wall, points):
    """Distances of points (3, n) from a wall [m]."""
    return np.asarray(wall.surface(tuple(jnp.asarray(points)))[0])


def test_the_wall_is_touched_where_the_lumen_ends():
    """Around all axes, by a catheter whose centre is its radius from the wall."""
    wall = vessel_wall()
    fork = np.array([FORK, 0.0, 0.0])
    turns = np.linspace(-np.pi, np.pi, 16)
    for axis, first, last, lumen in [
        (np.array([1.0, 0.0, 0.0]), BACK - FORK + 0.005, -0.012, LUMEN),
        *((way, 0.03, BRANCH_LENGTH, BRANCH_LUMEN) for way in branch_directions().T),
    ]:
        one = np.cross(axis, [0.0, 0.6, 0.8])
        one = one / np.linalg.norm(one)
        other = np.cross(axis, one)
        around = np.outer(one, np.cos(turns)) + np.outer(other, np.sin(turns))
        places = fork[:, None] + np.outer(axis, np.linspace(first, last, 30))
        for depth in (RADIUS, 0.0, -0.001):
            points = places[:, :, None] + (lumen - depth) * around[:, None]
            found = distances(wall, points.reshape(3, -1))
            np.testing.assert_allclose(found, depth, atol=5e-4)
    ends = fork[:, None] + branch_directions() * (BRANCH_LENGTH + BRANCH_LUMEN + 0.001)
    back = np.array([[BACK - LUMEN - 0.001], [0.0], [0.0]])
    between = np.array([[FORK + 0.04], [0.0], [0.0]])
    assert np.all(distances(wall, np.hstack([ends, back, between])) < -0.0008)


def test_starts_are_straight_in_the_trunk_and_every_branch_is_drawn():
    env = make("catheter")
    params = parameters(env)
    keys = jax.random.split(KEY, 300)
    begin = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))
    observation, states = jax.tree.map(np.asarray, begin(keys, params))
    positions = states.body.positions
    assert np.all(np.isfinite(observation))
    np.testing.assert_allclose(positions[:, 0, 0], states.coordinates[:, 0], atol=1e-12)
    np.testing.assert_allclose(positions[:, 0, -1] - positions[:, 0, 0], LENGTH)
    np.testing.assert_allclose(positions[:, 1:], 0, atol=1e-12)
    np.testing.assert_allclose(states.body.velocities, 0)
    way, turn, angle = states.coordinates.T
    assert np.all((0 <= way) & (way <= 0.01)) and np.ptp(way) > 0.009
    assert np.all(np.abs(turn) <= np.pi) and np.ptp(turn) > 0.95 * 2 * np.pi
    assert np.all(angle == 0)
    # The tip would bend towards the direction in which the base is turned.
    d1 = np.asarray(jax.vmap(lambda body: body.directors[0, :, -1])(states.body))
    expected = np.stack([0 * turn, np.cos(turn), np.sin(turn)], axis=1)
    np.testing.assert_allclose(d1, expected, atol=1e-12)
    drawn = np.argmax(states.branch @ branch_directions(), axis=1)
    assert np.all(np.bincount(drawn, minlength=3) > 70)
    np.testing.assert_allclose(states.branch, branch_directions()[:, drawn].T)


@pytest.mark.slow
def test_the_free_tip_bends_by_its_angle_towards_d1():
    """At rest the last element, whose middle it is, has turned by its part of it."""
    body, angle, turn = parameters(make("catheter")).body, 0.1, 0.7
    coordinates, still = jnp.asarray([0.005, turn, angle]), jnp.zeros(3)
    path = Glide(coordinates, coordinates, still, still, jnp.asarray(1.0))
    scene = body.driven_along(path).at(0.0)
    rest = jaxrod.equilibrium(scene, body.placed(coordinates)).state
    half = 0.5 * LENGTH / body.rod.n_elements
    bent = angle * (1 - half / BENDING_LENGTH)
    aside = np.sin(bent) * np.array([np.cos(turn), np.sin(turn)])
    expected = np.array([np.cos(bent), *aside])
    np.testing.assert_allclose(rest.directors[2, :, -1], expected, atol=1e-6)
    np.testing.assert_allclose(rest.positions[:, 0], [0.005, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("options", "is_there"),
    [
        ({"depth": 1.01 * DEEP}, True),
        ({"depth": 0.99 * DEEP}, False),
        ({"offset": 0.99 * BRANCH_LUMEN}, True),
        ({"offset": 1.01 * BRANCH_LUMEN}, False),
    ],
)
def test_being_there_has_a_depth_and_a_width(options, is_there):
    env = make("catheter")
    params, state = placed(env, **options)
    assert env.is_there(state, params) == is_there
    _, told = env.judged(state, params)
    expected = {"depth": GOAL, "offset": 0.0} | options
    for name, value in expected.items():
        np.testing.assert_allclose(told[name], value, rtol=1e-5, atol=2e-6)
    ahead, aside = GOAL - expected["depth"], expected["offset"]
    np.testing.assert_allclose(told["distance"], np.hypot(ahead, aside), atol=2e-6)


def test_score_and_cost_are_those_of_the_page_and_improve_on_the_way_in():
    env = make("catheter")

    def judged(depth, offset=0.0):
        params, state = placed(env, depth, offset)
        score, _ = env.judged(state, params)
        return float(score), float(env.cost(state, jnp.zeros(3), params))

    assert judged(GOAL) == (pytest.approx(100, abs=1e-3), pytest.approx(0, abs=1e-9))
    distance = np.hypot(0.015, 0.004)
    expected = 50 / (1 + (distance / FAR) ** 2) + 50 / (1 + (distance / NEAR) ** 2)
    assert judged(GOAL - 0.015, 0.004)[0] == pytest.approx(expected, rel=1e-9)
    way = [judged(depth) for depth in (-0.03, -0.01, 0.0, 0.01, 0.02, DEEP, GOAL)]
    scores, costs = zip(*way, strict=True)
    assert np.all(np.diff(scores) > 0) and np.all(np.diff(costs) < 0)


def test_success_is_half_a_second_in_the_branch_without_a_break():
    env = make("catheter")
    params, state = placed(env)
    found = []
    for _ in range(HELD_STEPS + 1):
        _, state, reward, *_, info = stepping(env)(KEY, state, jnp.zeros(3), params)
        found.append((int(state.held), bool(info["success"]), float(reward)))
    held, success, rewards = zip(*found, strict=True)
    assert held == (1, 2, 3, 4, 5, 6)
    assert success == (False,) * 4 + (True,) * 2
    np.testing.assert_allclose(rewards, 100 / env.episode_length, rtol=1e-6)
    away = dataclasses.replace(params, fork=params.fork + 0.011 * state.branch)
    _, away, *_, info = stepping(env)(KEY, state, jnp.zeros(3), away)
    assert away.held == 0 and info["success"] == 0


def test_what_is_seen_turns_with_the_base():
    """The next branch, seen by a base that has turned as far, looks the same."""
    env = make("catheter")
    params, state = start(env)
    branches, third = np.asarray(params.branches), 2 * np.pi / 3
    seen = []
    for k in range(3):
        coordinates = jnp.asarray([0.004, -1.9 + k * third, 0.0])
        body = params.body.placed(coordinates)
        other = dataclasses.replace(
            state,
            body=body,
            coordinates=coordinates,
            branch=jnp.asarray(branches[:, k]),
        )
        seen.append(np.asarray(env.observe(other, params)))
    turn = 16
    for other in seen[1:]:
        apart = np.abs(other - seen[0]) > 1e-12
        assert np.flatnonzero(apart).tolist() == [turn]
    np.testing.assert_allclose(np.diff([s[turn] for s in seen]), third / (3 * np.pi))


def test_a_crash_freezes_catheter_and_drive_and_pays_nothing():
    env = make("catheter")
    params, state = start(env)
    obs, after, reward, terminated, truncated, info = stepping(env)(
        KEY, state, jnp.asarray([jnp.nan, 0.0, 0.0]), params
    )
    assert truncated and not terminated and info["flagged"] and reward == 0
    np.testing.assert_array_equal(after.body.positions, state.body.positions)
    np.testing.assert_array_equal(after.coordinates, state.coordinates)
    assert np.all(np.isfinite(obs))


def test_the_default_step_is_stable_with_the_tip_bent_most():
    env = make("catheter")
    params = parameters(env)
    assert params.dt < jaxrod.stable_dt(params.body.scene).dt


def steered(state):
    """Actions that turn the base to the branch, bend the tip at the fork, and push."""
    way, turn, angle = state.coordinates
    apart = jnp.arctan2(state.branch[2], state.branch[1]) - turn
    apart = (apart + np.pi) % (2 * np.pi) - np.pi
    x = state.body.tip[0]
    push = jnp.where(jnp.abs(apart) < 0.1, 0.6, 0.0)
    push = jnp.where((x > FORK - 0.007) & (angle < 0.85), 0, push)
    bend = jnp.where(x > FORK - 0.015, jnp.clip((0.9 - angle) / 0.2, -1, 1), 0)
    return jnp.stack([jnp.where(way > 0.075, 0, push), apart / 0.3, bend])


def played(env, states, actions):
    """Infos, states and depths of the wall after each step of a batch [radius].

    Actions are given for each step, or by a function of the state.
    """
    params = env.default_params()
    touch = params.body.scene.effects[2]
    fine = dataclasses.replace(touch, points_per_element=8)

    def step(states, given):
        moves = jax.vmap(actions)(states) if callable(actions) else given
        _, states, *_, info = jax.vmap(env.step, (None, 0, 0, None))(
            KEY, states, moves, params
        )
        deep = jax.vmap(lambda s: fine.violation(params.body.rod, s.body))(states)
        return states, (info, states, deep)

    many = None if callable(actions) else actions
    run = jax.jit(
        lambda states: jax.lax.scan(step, states, many, length=env.episode_length)
    )
    return jax.tree.map(np.asarray, run(states)[1])


def begun(env, many):
    """First states of a batch."""
    keys = jax.random.split(KEY, many)
    return jax.vmap(env.reset, (0, None))(keys, env.default_params())[1]


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_script_steers_into_every_branch():
    env = make("catheter")
    info, _, deep = played(env, begun(env, 64), steered)
    assert np.all(info["success"][-1] == 1) and not np.any(info["flagged"])
    assert np.max(deep) < 0.3


@pytest.mark.slow
@pytest.mark.default_precision
def test_no_wall_is_crossed_whatever_the_drive_does():
    """Drives that rush, mostly forwards: contact holds, and energy is bounded."""
    env, many = make("catheter"), 128
    random = np.random.default_rng(0)
    held = random.uniform(-1, 1, (12, many, 3)).repeat(5, axis=0)
    held = np.sign(held) * np.abs(held) ** 0.3
    forwards = random.uniform(size=held.shape[:2]) < 0.8
    held[:, :, 0] = np.abs(held[:, :, 0]) * np.where(forwards, 1, -1)
    info, states, deep = played(env, begun(env, many), jnp.asarray(held, "float32"))
    assert not np.any(info["flagged"])
    print(f"deepest {np.max(deep):.3f} of the radius")
    assert np.max(deep) < 0.5
    # Every node is inside of the vessel, even between control steps of a rush.
    nodes = np.moveaxis(states.body.positions, 2, 0).reshape(3, -1)
    assert np.min(distances(vessel_wall(), nodes)) > 0.5 * RADIUS
    rod = env.default_params().body.rod
    speeds = states.body.velocities
    kinetic = 0.5 * np.sum(np.asarray(rod.node_masses) * speeds**2, axis=(2, 3))
    fastest = np.max(np.abs(speeds))
    print(f"largest speed {fastest:.3f} m/s, energy {np.max(kinetic):.2e} J")
    # A tenth of the energy of a tip that is held straight where it would bend most.
    stiffness = float(rod.bend_twist_stiffness[0, -1])
    assert np.max(kinetic) < 0.1 * stiffness * MOST_BEND**2 / (2 * BENDING_LENGTH)
    # They get deep into branches, so the test has teeth.
    assert np.mean(np.max(states.body.positions[:, :, 0, -1], axis=0) > 0.2) > 0.5


@pytest.mark.slow
@pytest.mark.default_precision
def test_twice_the_elements_end_at_the_same_place():
    """The actions of the script with 12 elements, played with 12 and with 24."""
    env = make("catheter")
    states = begun(env, 16)
    path = played(env, states, steered)[1]
    moves = jax.vmap(jax.vmap(steered))(
        jax.tree.map(
            lambda first, later: jnp.concatenate([first[None], later[:-1]]),
            states,
            path,
        )
    )
    finer = make("catheter", n_elements=24)
    ends = [
        played(one, begun(one, 16), moves)[1].body.positions[-1, :, :, -1]
        for one in (env, finer)
    ]
    apart = np.linalg.norm(ends[0] - ends[1], axis=1)
    print(f"largest distance {1e3 * np.max(apart):.2f} mm")
    assert np.max(apart) < 0.02 * LENGTH


@pytest.mark.slow
def test_a_prediction_is_a_step():
    env = make("catheter")
    params, state = start(env)
    action = jnp.asarray([1.0, -0.4, 0.8])
    predicted = jax.jit(env.predict, static_argnums=3)(state, action, params, 3)
    for _ in range(3):
        state = stepping(env)(KEY, state, action, params)[1]
    for a, b in zip(jax.tree.leaves(predicted), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11)


@pytest.mark.slow
def test_gradient_of_the_return_is_that_of_finite_differences():
    env = make("catheter")
    time = np.arange(8)[:, None]
    actions = jnp.asarray(0.5 * np.sin(0.7 * time + np.arange(3)) + [0.4, 0, 0.3])
    assert gradient_error(env, actions) < 1e-5


@pytest.mark.slow
@pytest.mark.default_precision
def test_vmap_is_a_loop_and_numbers_are_single():
    check_vmap_is_a_loop(make("catheter"), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variant": "paper"}, "variant must be one of clean"),
        ({"n_elements": 11}, "n_elements .* at least 12, got 11"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("catheter", **options)
