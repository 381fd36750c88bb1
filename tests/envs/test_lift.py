"""A hand keeps its limits, a held rope follows it, and the task keeps its promises."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.effects.time import Clock
from jaxrod.envs import make
from jaxrod.envs.soft_bodies.hand import Glide, Hand
from jaxrod.envs.tasks.hand_task import HELD_STEPS
from jaxrod.envs.tasks.lift import ABOVE, NEAR
from playing import KEY, check_vmap_is_a_loop, gradient_error, play, start, stepping

PERIOD = 0.1


def hand():
    """A hand whose three coordinates differ in all limits."""
    return Hand(
        lower=jnp.asarray([-0.4, -0.1, 0.0]),
        upper=jnp.asarray([0.4, 0.2, 0.9]),
        speed=jnp.asarray([0.5, 1.0, 0.3]),
        acceleration=jnp.asarray([2.5, 3.0, 5.0]),
    )


def test_a_hand_never_exceeds_its_limits():
    """Random commands, also beyond -1 and 1, held for random times."""
    one = hand()
    random = np.random.default_rng(0)
    commands = random.uniform(-1.5, 1.5, (60, 3)).repeat(random.integers(1, 25, 60), 0)

    def step(carry, action):
        after = one.moved(*carry, action, PERIOD)
        return after, after

    begun = jnp.asarray([0.1, 0.1, 0.5]), jnp.zeros(3)
    _, (places, velocities) = jax.jit(lambda a: jax.lax.scan(step, begun, a))(
        jnp.asarray(commands)
    )
    places, velocities = np.asarray(places), np.asarray(velocities)
    one = jax.tree.map(np.asarray, one)
    assert np.all(places >= one.lower - 1e-12) and np.all(places <= one.upper + 1e-12)
    assert np.all(np.abs(velocities) <= one.speed + 1e-12)
    change = np.abs(np.diff(velocities, axis=0)).max(axis=0) / PERIOD
    np.testing.assert_allclose(change, one.acceleration, rtol=1e-9)
    # Both ends of every range are reached, to a millimetre.
    np.testing.assert_allclose(places.min(axis=0), one.lower, atol=1e-3)
    np.testing.assert_allclose(places.max(axis=0), one.upper, atol=1e-3)


def test_a_glide_is_the_motion_of_uniform_acceleration():
    """Position, velocity and acceleration at any time of the step."""
    first, velocity = jnp.asarray([0.1, 0.2, 0.3]), jnp.asarray([0.4, -0.1, 0.0])
    faster = jnp.asarray([-2.0, 1.0, 0.5])
    after = velocity + faster * PERIOD
    last = first + 0.5 * PERIOD * (velocity + after)
    glide = Glide(first, last, velocity, after, jnp.asarray(PERIOD))
    for time in (0.0, 0.03, PERIOD):
        clock = Clock(jnp.int32(0), jnp.asarray(time / 1e-3), jnp.asarray(1e-3))
        found = glide(clock)
        place = first + velocity * time + 0.5 * faster * time**2
        np.testing.assert_allclose(found.position, place, rtol=1e-12)
        np.testing.assert_allclose(found.velocity, velocity + faster * time, rtol=1e-12)
        np.testing.assert_allclose(found.acceleration, faster, rtol=1e-9)


def test_rates_of_a_glide_are_derivatives_of_its_position():
    random = np.random.default_rng(1)
    glide = Glide(*jnp.asarray(random.normal(size=(4, 3))), jnp.asarray(PERIOD))

    def at(time):
        return glide(Clock(jnp.int32(0), time / 1e-3, jnp.asarray(1e-3)))

    time = jnp.asarray(0.037)
    rate = jax.jacfwd(lambda time: at(time).position)(time)
    faster = jax.jacfwd(lambda time: at(time).velocity)(time)
    np.testing.assert_allclose(at(time).velocity, rate, rtol=1e-10)
    np.testing.assert_allclose(at(time).acceleration, faster, rtol=1e-10)


def test_the_held_end_is_where_the_hand_is_and_velocities_follow_actions():
    env = make("lift")
    actions = jnp.asarray([[1.0, -3.0, 0.2]] * 4)
    states, obs, _, terminated, truncated, info = play(env, actions)
    np.testing.assert_allclose(
        states.body.positions[:, :, 0], states.coordinates, atol=1e-12
    )
    # 2.5 m/s^2 for 0.1 s, then at most 0.5 m/s.
    np.testing.assert_allclose(states.velocity[0], [0.25, -0.25, 0.1], rtol=1e-9)
    np.testing.assert_allclose(states.velocity[3], [0.5, -0.5, 0.1], rtol=1e-9)
    np.testing.assert_allclose(
        states.body.velocities[:, :, 0], states.velocity, atol=1e-9
    )
    np.testing.assert_allclose(obs[:, 9:12], states.velocity / 0.5, rtol=1e-12)
    assert not np.any(terminated) and not np.any(truncated)
    assert not np.any(info["flagged"]) and not np.any(info["success"])


def at_target(env, steps):
    """Results of a rope that lies still and whose target is its free end."""
    params, state = start(env)
    state = dataclasses.replace(state, target=state.body.tip)
    found = []
    for _ in range(steps):
        _, state, reward, *_, info = stepping(env)(KEY, state, jnp.zeros(3), params)
        found.append((int(state.held), bool(info["success"]), float(reward)))
    return params, state, found


def test_success_is_half_a_second_at_the_target_without_a_break():
    env = make("lift")
    params, state, found = at_target(env, HELD_STEPS + 1)
    held, success, rewards = zip(*found, strict=True)
    assert held == (1, 2, 3, 4, 5, 6)
    assert success == (False,) * 4 + (True,) * 2
    np.testing.assert_allclose(rewards, 100 / env.episode_length, rtol=1e-3)
    away = state.target + jnp.asarray([0, 0, 1.01 * NEAR])
    state = dataclasses.replace(state, target=away)
    _, state, _, _, _, info = stepping(env)(KEY, state, jnp.zeros(3), params)
    assert state.held == 0 and info["success"] == 0


def test_a_crash_freezes_rope_and_hand_and_pays_nothing():
    env = make("lift")
    params, state = start(env)
    obs, after, reward, terminated, truncated, info = stepping(env)(
        KEY, state, jnp.asarray([jnp.nan, 0.0, 0.0]), params
    )
    assert truncated and not terminated and info["flagged"] and reward == 0
    np.testing.assert_array_equal(after.body.positions, state.body.positions)
    np.testing.assert_array_equal(after.coordinates, state.coordinates)
    assert np.all(np.isfinite(obs))


def test_starts_are_on_the_floor_within_their_ranges():
    env = make("lift")
    params = env.default_params()
    keys = jax.random.split(KEY, 300)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    first = jax.vmap(lambda state: state.directors[2, :, 0])(states.body)
    states, params = jax.tree.map(np.asarray, (states, params))
    places, tips = states.body.positions[:, :, 0], states.body.tip
    np.testing.assert_allclose(states.body.positions[:, 2], 0.005, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(tips - places, axis=1), 0.5, rtol=1e-9)
    # Elements point along the rope.
    along = (tips - places) / 0.5
    np.testing.assert_allclose(first, along, atol=1e-9)
    assert 0.09 < np.abs(places[:, :2]).max() <= 0.1
    low, high = states.target.min(axis=0), states.target.max(axis=0)
    assert np.all(low >= params.lower) and np.all(high <= params.upper)
    assert np.all(high - low > 0.9 * (params.upper - params.lower))


@pytest.mark.slow
def test_steps_are_stable():
    for n in (4, 6, 8, 16):
        env = make("lift", n_elements=n)
        params = env.default_params()
        ratio = params.dt / jaxrod.stable_dt(params.body.scene, 1.0).dt
        assert 0.5 < ratio < 0.9, (n, ratio)


@pytest.mark.slow
def test_a_prediction_is_a_step():
    env = make("lift")
    params, state = start(env)
    action = jnp.asarray([0.3, -0.2, 1.0])
    predicted = jax.jit(env.predict, static_argnums=3)(state, action, params, 3)
    for _ in range(3):
        state = stepping(env)(KEY, state, action, params)[1]
    for a, b in zip(jax.tree.leaves(predicted), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11)


def hanging(env):
    """Parameters, and a state whose rope hangs at rest with its end at the target."""
    params, state = start(env)
    heights = jnp.linspace(0.7, 0.2, env.n_elements + 1)
    places = jnp.stack([0 * heights, 0 * heights, heights])
    body = dataclasses.replace(state.body, positions=places)
    return params, dataclasses.replace(state, body=body, target=places[:, -1])


@pytest.mark.slow
def test_the_cost_is_zero_below_the_hand_and_has_a_slope_on_the_floor():
    env = make("lift")
    params, state = hanging(env)

    def cost(way, raised=0.0):
        target = dataclasses.replace(state, target=state.target + way)
        places = state.body.positions.at[2, 0].add(raised)
        body = dataclasses.replace(state.body, positions=places)
        moved = dataclasses.replace(target, body=body)
        return env.cost(moved, jnp.zeros(3), params)

    assert cost(jnp.zeros(3)) < 1e-20
    costs = [float(cost(jnp.asarray([d, 0, -d]))) for d in (0.01, 0.1, 1.0, 10.0)]
    assert np.all(np.diff(costs) > 0)
    near = (1e-3 / NEAR) ** 2 + (1e-3 / ABOVE) ** 2
    np.testing.assert_allclose(cost(jnp.asarray([1e-3, 0, 0])), near, rtol=1e-4)
    # The hand is too low by 0.1 m: to raise it alone is worth it.
    slope = jax.grad(cost, argnums=1)(jnp.asarray([0, 0, 0.1]), 0.0)
    assert slope < -1


@pytest.mark.slow
def test_gradient_of_the_return_is_that_of_finite_differences():
    env = make("lift", n_elements=4)
    time = np.arange(5)[:, None]
    actions = jnp.asarray(0.8 * np.sin(0.7 * time + np.arange(3)) + [0, 0, 0.5])
    assert gradient_error(env, actions) < 1e-5


@pytest.mark.slow
@pytest.mark.default_precision
def test_vmap_is_a_loop_and_numbers_are_single():
    check_vmap_is_a_loop(make("lift"), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variant": "paper"}, "variant must be one of clean"),
        ({"n_elements": 3}, "n_elements .* at least 4, got 3"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("lift", **options)
