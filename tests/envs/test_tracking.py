"""The tracking task is the published one, and its clean variant is accurate."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.arm import moving_target
from jaxrod.envs.arm.moving_target import Target
from jaxrod.envs.tasks.tracking import HEADING_STEPS, tracking
from jaxrod.tradeoff import reference, tracking_arm
from published_oracle import OracleArm

KEY = jax.random.key(0)


def play(env, actions, params=None, key=KEY):
    """States, observations, rewards and info of a sequence of actions."""
    params = env.default_params() if params is None else params
    _, state = env.reset(key, params)

    def body(state, action):
        obs, state, reward, terminated, truncated, info = env.step(
            key, state, action, params
        )
        return state, (state, obs, reward, terminated, truncated, info)

    return jax.jit(lambda s: jax.lax.scan(body, s, actions))(state)[1]


def smooth_actions(steps, amplitude, seed=0):
    knots = np.random.default_rng(seed).uniform(-1, 1, (steps // 50 + 2, 12))
    time = np.arange(steps) / 50
    index = time.astype(int)
    part = (time - index)[:, None]
    return jnp.asarray(
        amplitude * (knots[index] * (1 - part) + knots[index + 1] * part)
    )


@pytest.mark.slow
def test_paper_arm_moves_as_an_independent_implementation_says():
    # Some are held: their couples stay as they are, whatever the arm does.
    actions = jnp.repeat(smooth_actions(100, 1.0)[::10], 10, axis=0)
    actions = jnp.concatenate([smooth_actions(50, 1.0), actions])
    # Short numbers: moving from one to another by their difference is exact.
    actions = jnp.round(1024 * actions) / 1024
    states, *_ = play(make("tracking", variant="paper"), actions)
    arm = OracleArm()
    for action in np.asarray(actions):
        arm.control_step(action)
    assert np.max(np.abs(arm.x[-1] - [0, 1, 0])) > 0.05  # it did move
    np.testing.assert_allclose(states.arm.positions[-1].T, arm.x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(states.arm.velocities[-1].T, arm.v, rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", ["paper", pytest.param("clean", marks=pytest.mark.slow)]
)
def test_positive_normal_action_pushes_to_minus_x_and_binormal_to_plus_z(variant):
    env = make("tracking", variant=variant)
    for action, axis, sign in (
        ([0.1] * 6 + [0] * 6, 0, -1),
        ([0] * 6 + [0.1] * 6, 2, 1),
    ):
        states, *_ = play(env, jnp.tile(jnp.asarray(action), (50, 1)))
        tip = np.asarray(states.arm.tip)[-1]
        assert sign * tip[axis] > 1e-3
        assert abs(tip[2 - axis]) < 1e-6


@pytest.mark.parametrize(
    "variant", ["paper", pytest.param("clean", marks=pytest.mark.slow)]
)
def test_observation_is_nodes_tip_velocity_target_and_its_velocity(variant):
    env = make("tracking", variant=variant)
    states, obs, *_ = play(env, smooth_actions(20, 0.5))
    state = jax.tree.map(lambda leaf: np.asarray(leaf[-1]), states)
    obs = np.asarray(obs[-1])
    assert obs.shape == (env.observation_size,) == (44,)
    every = env.n_elements // 10
    np.testing.assert_array_equal(obs[:33], state.arm.positions[:, ::every].ravel())
    velocity = state.arm.velocities[:, -1]
    speed = np.linalg.norm(velocity)
    np.testing.assert_allclose(obs[33:37], [speed, *(velocity / speed)], rtol=1e-12)
    np.testing.assert_array_equal(obs[37:40], state.target.position)
    np.testing.assert_allclose(obs[40], 0.5, rtol=1e-12)
    np.testing.assert_allclose(obs[41:] * 0.5, state.target.velocity, rtol=1e-12)


@pytest.mark.fast_sets(2)
@pytest.mark.parametrize(
    ("distance", "bonus"), [(0.04, 2.0), (0.06, 0.5), (0.099, 0.5), (0.11, 0.0)]
)
def test_reward_is_minus_squared_distance_plus_two_tiers(distance, bonus):
    env = make("tracking", variant="paper")
    params = env.default_params()
    _, state = env.reset(KEY, params)
    target = Target(jnp.asarray([0.0, 1.0 - distance, 0.0]), jnp.zeros(3))
    state = dataclasses.replace(state, target=target)
    _, _, reward, *_ = env.step(KEY, state, jnp.zeros(12), params)
    np.testing.assert_allclose(reward, bonus - distance**2, rtol=1e-9)


def test_target_flies_as_a_step_by_step_simulation_says():
    params = make("tracking").default_params().target
    lower, upper = np.array(params.lower), np.array(params.upper)
    fly = jax.jit(lambda t: moving_target.fly(t, params, 1e-4, 14))
    for seed in range(20):
        target = moving_target.start(jax.random.key(seed), params)
        position, velocity = np.array(target.position), np.array(target.velocity)
        for _ in range(50):
            target = fly(target)
        for _ in range(50 * 14):
            position = position + 1e-4 * velocity
            out = (position - 0.05 < lower) | (position + 0.05 > upper)
            velocity = np.where(out, -velocity, velocity)
        np.testing.assert_allclose(target.position, position, atol=1e-12)
        np.testing.assert_allclose(target.velocity, velocity, atol=1e-12)


def test_a_third_of_the_targets_is_frozen_along_some_axis():
    # Sides of 1.2, 0.6 and 1.2 m, and 5 cm at both ends of each.
    params = make("tracking").default_params().target
    keys = jax.random.split(KEY, 4000)
    start = jax.vmap(lambda k: moving_target.start(k, params))(keys)
    fly = jax.jit(jax.vmap(lambda t: moving_target.fly(t, params, 1e-4, 20)))
    later = start
    for _ in range(10):
        later = fly(later)
    frozen = np.any(np.abs(later.position - start.position) < 1.1e-4 * 0.5, axis=1)
    expected = 1 - (1 - 0.1 / 1.2) ** 2 * (1 - 0.1 / 0.6)
    assert abs(frozen.mean() - expected) < 4 * np.sqrt(0.3 * 0.7 / 4000)


@pytest.mark.slow
def test_heading_changes_every_500_control_steps_at_the_same_speed():
    env = make("tracking", variant="clean")
    params = env.default_params()
    _, state = env.reset(KEY, params)
    # In the middle of the box no wall is in the way.
    target = Target(jnp.asarray([0.0, 0.6, 0.0]), jnp.asarray([0.5, 0.0, 0.0]))
    state = dataclasses.replace(
        state, target=target, steps=jnp.asarray(HEADING_STEPS - 2, jnp.int32)
    )
    step = jax.jit(env.step)
    _, before, *_ = step(jax.random.key(1), state, jnp.zeros(12), params)
    _, after, *_ = step(jax.random.key(2), before, jnp.zeros(12), params)
    np.testing.assert_array_equal(before.target.velocity, target.velocity)
    assert np.linalg.norm(after.target.velocity - target.velocity) > 1e-3
    np.testing.assert_allclose(np.linalg.norm(after.target.velocity), 0.5, rtol=1e-12)


@pytest.mark.slow
def test_doing_nothing_scores_what_was_published():
    # Minus 3100 on average, spread 1060, over the targets of an episode; the arm at
    # rest stays where it is, so the target alone decides.
    env = make("tracking", variant="paper")
    params = env.default_params()
    tip = jnp.asarray([0.0, 1.0, 0.0])

    def episode(key):
        def body(target, k):
            target = moving_target.fly(target, params.target, 1e-4, 14)
            squared = jnp.sum((target.position - tip) ** 2)
            reward = -squared + 0.5 * (squared <= 0.01) + 1.5 * (squared <= 0.0025)
            turned = moving_target.heading(jax.random.fold_in(key, k), 0.5)
            velocity = jnp.where((k + 1) % 500 == 0, turned, target.velocity)
            return Target(target.position, velocity), reward

        start = moving_target.start(key, params.target)
        return jnp.sum(jax.lax.scan(body, start, jnp.arange(7142))[1])

    returns = jax.jit(jax.vmap(episode))(jax.random.split(KEY, 256))
    assert abs(returns.mean() + 3100) < 250
    assert abs(returns.std() - 1060) < 250


def test_a_broken_paper_arm_costs_a_thousand_and_ends_the_episode():
    env = make("tracking", variant="paper")
    params = env.default_params()
    _, state = env.reset(KEY, params)
    broken = dataclasses.replace(
        state.arm, velocities=state.arm.velocities.at[0, 5].set(jnp.nan)
    )
    obs, after, reward, terminated, truncated, info = env.step(
        KEY, dataclasses.replace(state, arm=broken), jnp.zeros(12), params
    )
    assert reward == -1000 and terminated and not truncated and info["flagged"]
    assert np.all(np.isfinite(obs))
    last = np.linalg.norm(state.arm.tip - after.target.position)
    np.testing.assert_allclose(info["distance"], last, rtol=1e-9)


@pytest.mark.slow
def test_an_unhealthy_clean_arm_is_truncated_not_punished():
    env = make("tracking", variant="clean")
    params = env.default_params()
    _, state = env.reset(KEY, params)
    fast = dataclasses.replace(
        state.arm, velocities=state.arm.velocities.at[0, -1].set(500.0)
    )
    _, after, reward, terminated, truncated, info = env.step(
        KEY, dataclasses.replace(state, arm=fast), jnp.zeros(12), params
    )
    assert truncated and not terminated and info["flagged"] and reward > -10
    last = np.linalg.norm(state.arm.tip - after.target.position)
    np.testing.assert_allclose(info["distance"], last, rtol=1e-9)


@pytest.mark.slow
def test_clean_arm_is_as_accurate_as_it_says():
    """0.55 % of the length under bang-bang actions of a trained policy."""
    problem = tracking_arm()
    exact = reference(problem, 80)
    actions = problem.controls[: len(exact.tips)]
    arm = play(tracking("clean"), jnp.asarray(actions))[0].arm
    error = np.linalg.norm(np.asarray(arm.tip) - exact.tips, axis=1)
    assert exact.error < 1e-3
    assert 0.004 < np.sqrt(np.mean(error**2)) < 0.008


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["paper", "clean"])
def test_gradient_of_the_return_is_that_of_finite_differences(variant):
    env = tracking(variant, n_elements=10, substeps=3 if variant == "clean" else 7)
    params = env.default_params()
    actions = smooth_actions(30, 0.3)
    direction = jnp.asarray(np.random.default_rng(3).normal(size=actions.shape))

    @jax.jit
    def total(actions):
        _, state = env.reset(KEY, params)

        def body(state, action):
            _, state, reward, *_ = env.step(KEY, state, action, params)
            return state, reward

        return jnp.sum(jax.lax.scan(body, state, actions)[1])

    slope = jnp.sum(jax.grad(total)(actions) * direction)
    h = 1e-5
    secant = (total(actions + h * direction) - total(actions - h * direction)) / (2 * h)
    assert abs(slope) > 1e-6
    np.testing.assert_allclose(slope, secant, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize(
    "variant", [pytest.param("paper", marks=pytest.mark.slow), "clean"]
)
def test_vmap_is_a_loop_and_numbers_are_single(variant):
    env = make("tracking", variant=variant)
    params = env.default_params()
    keys = jax.random.split(KEY, 3)
    actions = jax.random.uniform(KEY, (3, 12), minval=-1.0)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    step = jax.jit(env.step)
    batch = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))(
        keys, states, actions, params
    )
    for i in range(3):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        single = step(keys[i], state, actions[i], params)
        for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-4, atol=1e-4)
            assert a.dtype in (jnp.float32, jnp.int32, jnp.bool_)


@pytest.mark.slow
def test_changing_every_number_recompiles_nothing():
    env = make("tracking", variant="clean")
    params = env.default_params()
    _, state = env.reset(KEY, params)
    step = jax.jit(env.step)
    step(KEY, state, jnp.zeros(12), params)
    step(KEY, state, jnp.ones(12), jax.tree.map(lambda leaf: 1.01 * leaf, params))
    assert step._cache_size() == 1


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"variant": "dirty"}, "variant"),
        ({"n_elements": 15}, "n_elements"),
        ({"n_elements": 0}, "n_elements"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_options_are_named(options, name):
    with pytest.raises(ValueError, match=name):
        make("tracking", **options)
