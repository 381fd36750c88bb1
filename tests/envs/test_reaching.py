"""The reaching task is the published one, and its clean variant is sound."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.tasks.reaching import (
    Goal,
    frame_at_yaw,
    random_goal,
    reaching_reward,
    tip_frame,
)
from playing import (
    KEY,
    check_vmap_is_a_loop,
    gradient_error,
    play,
    smooth_actions,
    start,
    stepping,
)
from published_oracle import OracleArm

VARIANTS = pytest.mark.parametrize("variant", ["paper", "clean"])


@pytest.fixture(scope="module")
def paper():
    return make("reaching", variant="paper")


def quaternion(matrix):
    """As published, of the matrix whose rows are d1, d2, d3."""
    w = np.sqrt(1 + np.trace(matrix)) / 2
    x = (matrix[2, 1] - matrix[1, 2]) / (4 * w)
    y = (matrix[0, 2] - matrix[2, 0]) / (4 * w)
    z = (matrix[1, 0] - matrix[0, 1]) / (4 * w)
    return np.array([w, x, y, z])


@pytest.mark.slow
def test_paper_arm_moves_as_an_independent_implementation_says(paper):
    actions = smooth_actions(60, 18, 1.0)
    # Held actions leave the couples as they are.
    actions = jnp.concatenate([actions, jnp.tile(actions[-1:], (20, 1))])
    states, obs, *_ = play(paper, actions)
    arm = OracleArm()
    for action in np.asarray(actions):
        arm.control_step(action)
    assert np.max(np.abs(arm.x[-1] - [0, 1, 0])) > 0.05  # it did move
    np.testing.assert_allclose(states.arm.positions[-1].T, arm.x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(states.arm.velocities[-1].T, arm.v, rtol=0, atol=1e-7)
    np.testing.assert_allclose(obs[-1, 37:41], quaternion(arm.Q[-1]), atol=1e-10)


@pytest.mark.slow
@VARIANTS
def test_observation_is_nodes_tip_velocity_tip_frame_and_goal(variant):
    env = make("reaching", variant=variant)
    states, obs, *_ = play(env, smooth_actions(20, 18, 0.5))
    state = jax.tree.map(lambda leaf: np.asarray(leaf[-1]), states)
    obs = np.asarray(obs[-1])
    assert obs.shape == (env.observation_size,) == (52,)
    every = env.n_elements // 10
    np.testing.assert_array_equal(obs[:33], state.arm.positions[:, ::every].ravel())
    velocity = state.arm.velocities[:, -1]
    speed = np.linalg.norm(velocity)
    np.testing.assert_allclose(obs[33:37], [speed, *(velocity / speed)], rtol=1e-12)
    frame = np.asarray(states.arm.orientations)[-1]
    rows = np.asarray(dataclasses.replace(state.arm, orientations=frame).directors)
    np.testing.assert_allclose(obs[37:41], quaternion(rows[..., -1]), atol=1e-12)
    np.testing.assert_array_equal(obs[41:44], state.target.position)
    np.testing.assert_array_equal(obs[44:48], 0)
    np.testing.assert_array_equal(obs[48:], state.target.orientation)


def test_tip_at_rest_shows_four_halves(paper):
    obs, _ = paper.reset(KEY, paper.default_params())
    np.testing.assert_allclose(obs[37:41], 0.5, atol=1e-15)
    np.testing.assert_array_equal(obs[33:37], 0)


@pytest.mark.parametrize("yaw", [-np.pi / 2, -1.0, 0.0, 0.7, 1.5])
def test_goal_frame_is_turned_about_the_vertical(yaw):
    d1 = [-np.sin(yaw), 0, np.cos(yaw)]
    d2 = [np.cos(yaw), 0, np.sin(yaw)]
    expected = quaternion(np.array([d1, d2, [0, 1, 0]]))
    np.testing.assert_allclose(frame_at_yaw(jnp.asarray(yaw)), expected, atol=1e-14)


def test_goals_fill_the_box_and_all_yaws():
    params = make("reaching").default_params().target
    goals = jax.vmap(lambda k: random_goal(k, params))(jax.random.split(KEY, 4000))
    low, high = np.array([-0.6, 0.3, -0.6]), np.array([0.6, 0.9, 0.6])
    position = np.asarray(goals.position)
    assert np.all((position >= low) & (position <= high))
    spread = 4 * (high - low) / np.sqrt(12 * 4000)
    assert np.all(np.abs(position.mean(axis=0) - (low + high) / 2) < spread)
    w, _, y, _ = np.asarray(goals.orientation).T
    yaw = np.pi / 2 - 2 * np.arctan2(w, y)
    assert yaw.min() > -np.pi / 2 and yaw.max() < np.pi / 2
    assert abs(yaw.mean()) < 4 * np.pi / np.sqrt(12 * 4000)
    assert abs(yaw.std() - np.pi / np.sqrt(12)) < 0.03


@pytest.mark.parametrize(
    ("distance", "angle", "expected"),
    [
        (0.2, 0.0, -0.04),
        (0.1, 0.0, -0.01 + 0.5 + 0.5 + 0.5),
        (0.05, 0.0, -0.0025 + 1.5 + 4.5),
        (0.0, 0.0, 6.0),
        (0.0, 30.0, None),
        (0.0, 36.0, None),
        (0.0, 38.0, None),
        (0.07, 36.0, None),
        (0.07, 90.0, None),
        (0.5, 180.0, -0.25 - 0.5),
    ],
)
def test_reward_is_the_published_one(distance, angle, expected, paper):
    params = paper.default_params()
    delta = np.sin(np.deg2rad(angle) / 2) ** 2
    if expected is None:
        expected = -(distance**2) - 0.5 * delta**2
        if distance <= 0.1:
            expected += 0.5 + 0.5 * (1 - delta) + 0.5 * (angle <= 36.87)
        if distance <= 0.05:
            expected += 1.5 + 1.5 * (1 - delta) + 1.5 * (angle <= 25.84)
    reward = reaching_reward(jnp.asarray(distance**2), jnp.asarray(delta), params)
    np.testing.assert_allclose(reward, expected, rtol=1e-12, atol=1e-12)


def test_step_pays_for_distance_and_frame_of_the_tip(paper):
    params, state = start(paper)
    goal = Goal(jnp.asarray([0.0, 0.93, 0.0]), frame_at_yaw(jnp.asarray(1.0)))
    state = dataclasses.replace(state, target=goal)
    _, _, reward, *_, info = stepping(paper)(KEY, state, jnp.zeros(18), params)
    delta = np.sin(0.5) ** 2
    expected = -(0.07**2) - 0.5 * delta**2 + 0.5 + 0.5 * (1 - delta)
    np.testing.assert_allclose(reward, expected, rtol=1e-9)
    np.testing.assert_allclose(info["misalignment"], delta, rtol=1e-9)


def test_frames_shown_have_no_sign():
    _, state = start(make("reaching"))
    turned = dataclasses.replace(state.arm, orientations=-state.arm.orientations)
    np.testing.assert_array_equal(tip_frame(turned), tip_frame(state.arm))


def test_doing_nothing_scores_what_was_published(paper):
    """Minus 654 on average: the arm at rest stays where it is."""
    params = paper.default_params()

    def reward(key):
        goal = random_goal(key, params.target)
        squared = jnp.sum((goal.position - jnp.asarray([0.0, 1.0, 0.0])) ** 2)
        cosine = jnp.sum(goal.orientation * 0.5)
        return reaching_reward(squared, 1 - cosine**2, params)

    rewards = jax.jit(jax.vmap(reward))(jax.random.split(KEY, 40_000))
    assert abs(1428 * rewards.mean() + 654) < 10


@pytest.mark.fast_sets(1)
@VARIANTS
def test_positive_actions_push_to_minus_x_to_plus_z_and_twist(variant):
    env = make("reaching", variant=variant)

    def push(action):
        return play(env, jnp.tile(action, (40, 1)))[0].arm

    for row, axis, sign in ((0, 0, -1), (1, 2, 1)):
        arm = push(jnp.zeros((3, 6)).at[row].set(0.1).ravel())
        tip = np.asarray(arm.tip)[-1]
        assert sign * tip[axis] > 1e-3
        assert abs(tip[2 - axis]) < 1e-6
    arm = push(jnp.zeros((3, 6)).at[2].set(0.1).ravel())
    np.testing.assert_allclose(arm.tip[-1], [0, 1, 0], atol=1e-9)
    # A positive couple about d3 turns d1 = z towards d2 = x.
    assert (
        dataclasses.replace(arm, orientations=arm.orientations[-1]).directors[0, 0, -1]
        > 1e-3
    )


def test_a_broken_paper_arm_costs_ten_thousand_and_ends_the_episode(paper):
    params, state = start(paper)
    for leaf in ("velocities", "angular_momenta"):
        values = getattr(state.arm, leaf)
        broken = dataclasses.replace(state.arm, **{leaf: values.at[0, 5].set(jnp.nan)})
        obs, _, reward, terminated, truncated, info = stepping(paper)(
            KEY, dataclasses.replace(state, arm=broken), jnp.zeros(18), params
        )
        assert reward == -10_000 and terminated and not truncated and info["flagged"]
        np.testing.assert_array_equal(obs, 0)
        check_last_sound(info, state)


def check_last_sound(info, state):
    """A crashed step reports the arm before it, not the best there is."""
    last = np.linalg.norm(state.arm.tip - state.target.position)
    np.testing.assert_allclose(info["distance"], last, rtol=1e-9)
    aligned = np.sum(tip_frame(state.arm) * state.target.orientation) ** 2
    np.testing.assert_allclose(info["misalignment"], 1 - aligned, rtol=1e-9)


def test_an_unhealthy_clean_arm_is_truncated_not_punished():
    env = make("reaching", variant="clean")
    params, state = start(env)
    fast = dataclasses.replace(
        state.arm, velocities=state.arm.velocities.at[0, -1].set(500.0)
    )
    *_, reward, terminated, truncated, info = stepping(env)(
        KEY, dataclasses.replace(state, arm=fast), jnp.zeros(18), params
    )
    assert truncated and not terminated and info["flagged"] and reward > -10
    check_last_sound(info, state)


@pytest.mark.slow
@VARIANTS
def test_gradient_of_the_return_is_that_of_finite_differences(variant):
    env = make("reaching", variant=variant, n_elements=10)
    assert gradient_error(env, smooth_actions(30, 18, 0.3)) < 1e-6


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize(
    "variant", ["paper", pytest.param("clean", marks=pytest.mark.slow)]
)
def test_vmap_is_a_loop_numbers_are_single_and_nothing_recompiles(variant):
    check_vmap_is_a_loop(make("reaching", variant=variant))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"variant": "dirty"}, "variant must be one of paper, clean; got 'dirty'"),
        ({"n_elements": 15}, "n_elements"),
        ({"substeps": 0}, "substeps"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_options_are_named(options, name):
    with pytest.raises(ValueError, match=name):
        make("reaching", **options)
