"""The arm takes the curvature it is told to; the following task keeps its promises."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.envs import check_environment, make
from jaxrod.envs.arm.moving_target import Target, TargetParams, wander
from jaxrod.envs.soft_bodies.curved_arm import GRAVITY, curved_arm
from playing import KEY, check_vmap_is_a_loop, gradient_error, play, start, stepping

BOX = TargetParams(
    lower=jnp.asarray([-0.6, -0.6, 0.3]),
    upper=jnp.asarray([0.6, 0.6, 0.9]),
    radius=jnp.asarray(0.0),
    speed=jnp.asarray(0.5),
)


def weightless(arm):
    """The arm without gravity."""
    return dataclasses.replace(arm, weight=jaxrod.gravity((0.0, 0.0, 0.0)))


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 12, 20])
def test_angles_of_all_segments_are_the_bend_of_the_arm(n):
    """The integral of the rest curvature is the sum of the angles."""
    arm = curved_arm(n, 0.05)
    angles = jnp.asarray([[0.1, -0.2, 0.3, 0.4, 0.5], [1.0, 0.0, -1.0, 2.0, 0.3]])
    lengths = np.r_[0.5, np.ones(n - 1), 0.5] / n
    bend = np.sum(np.asarray(arm.curvatures(angles)) * lengths, axis=1)
    np.testing.assert_allclose(bend, [1.1, 2.3, 0.0], atol=1e-14)
    even = arm.curvatures(jnp.full((2, 5), 0.3))
    np.testing.assert_allclose(even[:2], 0.3 / 0.2, rtol=1e-13)


@pytest.mark.slow
def test_a_free_arm_becomes_the_arc_it_is_told_to():
    """Without weight: an arc of the angle phi ends at L sin(phi)/phi, by statics."""
    arm = weightless(curved_arm(20, 0.05))
    angle = 0.3
    scene = arm.scene(jnp.zeros((2, 5)).at[0].set(angle))
    found = jaxrod.equilibrium(scene, arm.rest)
    phi = 5 * angle
    tip = np.asarray(found.state.tip)
    assert abs(tip[2] - np.sin(phi) / phi) < 2e-3
    assert abs(np.linalg.norm(tip[:2]) - (1 - np.cos(phi)) / phi) < 2e-3


@pytest.mark.slow
def test_it_sags_under_its_weight_as_a_beam_does():
    """A small bend at the root: the weight adds to it as it does to a cantilever's."""
    arm, angles = curved_arm(20, 0.05), jnp.zeros((2, 5)).at[0].set(0.01)
    heavy = jaxrod.equilibrium(arm.scene(angles), arm.rest).state.tip
    light = jaxrod.equilibrium(weightless(arm).scene(angles), arm.rest).state.tip
    # Beam B w'' = B kappa + moment of the weight above, by collocation.
    stiffness = float(arm.rod.bend_twist_stiffness[0, 0])
    line = float(arm.rod.linear_density[0])
    s = np.linspace(0, 1, 2001)
    h = s[1]
    w = 0.5 * 0.05 * s**2
    for _ in range(200):
        tail = np.cumsum(((w[1:] + w[:-1]) * h / 2)[::-1])[::-1]
        above = np.append(tail, 0) - (1 - s) * w
        slope = np.cumsum(0.05 + line * GRAVITY / stiffness * above) * h
        w = np.cumsum(slope) * h
    expected = w[-1] / (0.5 * 0.05)
    found = np.linalg.norm(heavy[:2]) / np.linalg.norm(light[:2])
    assert found == pytest.approx(expected, rel=0.01) and found > 1.15


@pytest.mark.slow
def test_angles_change_by_what_the_action_says_and_stop_at_their_limit():
    env = make("following")
    action = jnp.zeros(10).at[0].set(0.5).at[7].set(-3.0)
    states, observed, *_ = play(env, jnp.tile(action, (3, 1)))
    np.testing.assert_allclose(states.angles[:, 0, 0], [0.025, 0.05, 0.075], rtol=1e-12)
    np.testing.assert_allclose(states.angles[:, 1, 2], [-0.05, -0.1, -0.15], rtol=1e-12)
    np.testing.assert_array_equal(observed[:, 30:40], states.angles.reshape(3, 10))
    arm = env.default_params().arm
    full = arm.turned(jnp.full((2, 5), 1.99), jnp.ones(10))
    np.testing.assert_allclose(full, 2.0, rtol=1e-14)


@pytest.mark.slow
def test_rewards_are_those_of_the_distance():
    env = make("following")
    params, state = start(env)
    action = jnp.zeros(10)
    for distance, bonus in ((0.04, 2.0), (0.08, 0.5), (0.3, 0.0)):
        # The target moves by 5 cm before the reward; the upright arm stays.
        velocity = jnp.asarray([0.5, 0.0, 0.0])
        place = jnp.asarray([distance - 0.05, 0.0, 0.8])
        tip = state.arm.tip
        there = dataclasses.replace(
            params.target, upper=jnp.asarray([9.0, 9.0, 9.0]), speed=jnp.asarray(0.5)
        )
        at = dataclasses.replace(params, target=there, chance=jnp.asarray(0.0))
        place = place.at[2].set(tip[2])
        begun = dataclasses.replace(state, target=Target(place, velocity))
        _, after, reward, *_, info = stepping(env)(KEY, begun, action, at)
        gone = float(jnp.linalg.norm(after.arm.tip - after.target.position))
        assert gone == pytest.approx(distance, abs=2e-4)
        assert reward == pytest.approx(bonus - gone**2, rel=1e-9)
        assert info["distance"] == pytest.approx(gone, rel=1e-9)


@pytest.mark.slow
def test_the_observation_says_where_the_arm_and_the_target_are():
    env = make("following", n_elements=10)
    params, state = start(env)
    observed = env.observe(state, env.default_params())
    assert observed.shape == (env.observation_size,)
    np.testing.assert_allclose(observed[10:15], [0.2, 0.4, 0.6, 0.8, 1.0], atol=1e-12)
    np.testing.assert_array_equal(observed[40:43], state.target.position)
    np.testing.assert_allclose(
        observed[46:], state.target.position - jnp.asarray([0, 0, 1.0]), atol=1e-12
    )
    # Between the nodes of an arm that is cut otherwise the ends are where they were.
    other = make("following", n_elements=12)
    states = other.reset(KEY, other.default_params())[1]
    np.testing.assert_allclose(
        other.observe(states, env.default_params())[:15], observed[:15], atol=1e-12
    )
    del params


def test_the_target_flies_straight_and_comes_back_from_a_wall():
    dt, chance = jnp.asarray(0.1), jnp.asarray(0.0)
    target = Target(jnp.asarray([0.58, 0.0, 0.6]), jnp.asarray([0.3, 0.4, 0.0]))
    first = wander(KEY, target, BOX, chance, dt)
    np.testing.assert_allclose(first.position, [0.61, 0.04, 0.6], rtol=1e-12)
    second = wander(KEY, first, BOX, jnp.asarray(1.0), dt)
    # Behind the wall it turns back along that axis, whatever the chance.
    np.testing.assert_allclose(second.position, [0.58, 0.08, 0.6], rtol=1e-12)
    np.testing.assert_allclose(second.velocity, [-0.3, 0.4, 0.0], rtol=1e-12)


@pytest.mark.slow
def test_new_headings_come_with_their_chance_and_keep_the_speed():
    target = Target(jnp.asarray([0.0, 0.0, 0.6]), jnp.asarray([0.3, 0.4, 0.0]))
    keys = jax.random.split(KEY, 20_000)
    moved = jax.vmap(
        lambda key: wander(key, target, BOX, jnp.asarray(0.025), jnp.asarray(0.1))
    )(keys)
    turned = np.any(np.asarray(moved.velocity) != np.asarray(target.velocity), axis=1)
    # Five standard deviations of a count.
    assert abs(turned.mean() - 0.025) < 5 * np.sqrt(0.025 * 0.975 / 20_000)
    speeds = np.linalg.norm(np.asarray(moved.velocity), axis=1)
    np.testing.assert_allclose(speeds, 0.5, rtol=1e-9)
    steps = np.asarray(moved.position) - np.asarray(target.position)
    np.testing.assert_allclose(steps, 0.1 * np.asarray(moved.velocity), atol=1e-12)
    foreseen = wander(None, target, BOX, jnp.asarray(1.0), jnp.asarray(0.1))
    np.testing.assert_array_equal(foreseen.velocity, target.velocity)


@pytest.mark.slow
def test_steps_are_stable_with_a_margin():
    env = make("following")
    params = env.default_params()
    for angle, most in ((0.0, 0.76), (2.0, 0.86)):
        scene = params.arm.scene(jnp.full((2, 5), angle))
        assert 0.6 < params.dt / jaxrod.stable_dt(scene, 1.0).dt < most
    assert not jaxrod.health(scene, params.arm.rest, params.dt).flagged
    check_environment(env)


def swung(n, scaled=True):
    """Tips of an arm under actions that change every second."""
    env = make("following", n_elements=n)
    params = env.default_params()
    if not scaled:
        rod, _ = jaxrod.straight_rod(
            n, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e7,
            direction=(0.0, 0.0, 1.0), normal=(0.0, 1.0, 0.0),
        )  # fmt: skip
        params = dataclasses.replace(
            params, arm=dataclasses.replace(params.arm, rod=rod), dt=params.dt / 2
        )
        env = dataclasses.replace(env, substeps=2 * env.substeps)
    drawn = np.random.default_rng(0).normal(size=(6, 10))
    actions = jnp.asarray(np.repeat(np.clip(drawn, -1, 1), 10, axis=0))

    def one(state, action):
        _, state, *_, info = env.step(KEY, state, action, params)
        return state, (state.arm.tip, info["flagged"])

    _, (tips, flagged) = jax.jit(
        lambda state: jax.lax.scan(one, state, actions)
    )(env.reset(KEY, params)[1])  # fmt: skip
    assert not np.any(flagged)
    return np.asarray(tips)


@pytest.mark.slow
def test_tips_are_within_a_hundredth_of_the_length():
    coarse = swung(12)
    fine = swung(24)
    assert np.linalg.norm(coarse - fine, axis=1).max() < 0.01
    # Of that the enlarged inertia is next to nothing.
    assert np.linalg.norm(coarse - swung(12, scaled=False), axis=1).max() < 1e-3


@pytest.mark.slow
def test_gradients_are_those_of_differences():
    env = make("following", n_elements=6)
    actions = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (3, 10)))
    assert gradient_error(env, actions, h=1e-4) < 1e-5


@pytest.mark.slow
def test_a_crash_freezes_it_and_truncates():
    env = make("following")
    params, state = start(env)
    broken = dataclasses.replace(
        state.arm, velocities=state.arm.velocities.at[1, 6].set(1e4)
    )
    observed, after, _, terminated, truncated, info = stepping(env)(
        KEY, dataclasses.replace(state, arm=broken), jnp.ones(10), params
    )
    assert truncated and not terminated and info["flagged"]
    np.testing.assert_array_equal(after.arm.positions, broken.positions)
    assert np.all(np.isfinite(observed))


@pytest.mark.slow
def test_an_episode_is_five_hundred_steps():
    env = make("following", episode_length=4)
    *_, terminated, truncated, _ = play(env, jnp.zeros((4, 10)))
    assert truncated.tolist() == [False] * 3 + [True] and not np.any(terminated)
    assert make("following").episode_length == 500


@pytest.mark.slow
@pytest.mark.default_precision
def test_vmap_is_a_loop_and_numbers_are_single():
    check_vmap_is_a_loop(make("following"), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variant": "paper"}, "variant must be one of clean"),
        ({"n_elements": 4}, "n_elements"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_options_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        make("following", **options)


@pytest.mark.slow
def test_an_action_that_is_no_number_leaves_the_last_sound_state():
    env = make("following", n_elements=5, substeps=90)
    params = env.default_params()
    _, state = env.reset(jax.random.key(0), params)
    broken = jnp.zeros(env.action_size).at[3].set(jnp.nan)
    seen, after, reward, _, truncated, info = jax.jit(env.step)(
        jax.random.key(1), state, broken, params
    )
    assert bool(info["flagged"]) and bool(truncated)
    assert np.all(np.isfinite(seen)) and np.isfinite(reward)
    np.testing.assert_array_equal(after.angles, state.angles)
    np.testing.assert_array_equal(after.arm.positions, state.arm.positions)
