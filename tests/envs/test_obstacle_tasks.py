"""The two obstacle tasks are the published ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.tasks.unstructured_nest import published_nest, random_nest
from playing import (
    KEY,
    check_vmap_is_a_loop,
    play,
    start,
    stepping,
)
from published_oracle import ALONG_Z, Obstacle, OracleArm

VARIANTS = pytest.mark.parametrize("variant", ["paper", "clean"])
NAMES = pytest.mark.parametrize("name", ["structured", "unstructured"])
SCORES = [("structured", 4866), ("unstructured", 3794)]
MAZE = [
    (-0.6, 0.12),
    (-0.2, 0.12),
    (-0.4, 0.37),
    (-0.4, 0.0),
    (-0.4, -0.2),
    (-0.4, -0.4),
    (-0.4, 0.57),
    (-0.4, 0.77),
]


def obstacles_of(name):
    """As described, for the independent implementation."""
    if name == "structured":
        up = (0.0, 1.0, 0.0)
        return [Obstacle((x, 0.0, z), up, up, 1.0, 0.1) for x, z in MAZE]
    nest = published_nest()
    columns = (nest.starts, nest.directions, nest.normals)
    places = zip(*(np.asarray(c).T for c in columns), strict=True)
    return [Obstacle(*place, 1.0, 0.03) for place in places]


def independent(name, knots=(0.4, 0.9)):
    return OracleArm(
        n=50,
        base=(0.0, 0.5, 0.0),
        frame=ALONG_Z,
        knots=np.asarray(knots),
        rate=0.01,
        obstacles=obstacles_of(name),
    )


def moved(arm, state):
    """Sets the independent arm to a state of ours: straight, wherever it is."""
    arm.x = np.asarray(state.arm.positions).T.copy()
    arm.base = arm.x[0].copy()
    arm.v = np.asarray(state.arm.velocities).T.copy()
    return arm


@pytest.mark.slow
@NAMES
def test_arm_moves_as_an_independent_implementation_says(name):
    """Among the obstacles, so that contact is there at once."""
    env = make(name)
    params, state = start(env)
    actions = np.zeros((5, env.action_size))
    actions[:, 0] = [0.505, 0.505, -1.0, 1.0, 1.0]
    actions[:, -1] = [0.053, 0.053, 0.053, 0.7, -0.4]
    across = jnp.asarray([-0.135, 0.0, 0.0])[:, None]
    if name == "unstructured":
        across = jnp.asarray([-0.45, 0.1, 0.1])[:, None]
    state = dataclasses.replace(
        state,
        arm=dataclasses.replace(
            state.arm,
            positions=state.arm.positions + across,
            velocities=state.arm.velocities.at[0, 1:].set(-2.0),
        ),
    )
    held = dataclasses.replace(params.arm.held, position=state.arm.positions[:, 0])
    params = dataclasses.replace(params, arm=dataclasses.replace(params.arm, held=held))
    arm = moved(independent(name), state)
    free = moved(independent(name), state)
    free.obstacles = []
    free.control_step(actions[0], 1e-4, 14)
    for i, action in enumerate(actions):
        _, state, *_ = stepping(env)(KEY, state, jnp.asarray(action), params)
        arm.control_step(action, 1e-4, 14)
        if i == 0:
            assert np.max(np.abs(arm.v - free.v)) > 0.1  # it does touch
    np.testing.assert_allclose(state.muscles.applied, arm.applied, atol=1e-12)
    np.testing.assert_allclose(state.muscles.couples.T, arm.couples, atol=1e-6)
    np.testing.assert_allclose(state.arm.positions.T, arm.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(state.arm.velocities.T, arm.v, rtol=0, atol=1e-5)


@pytest.mark.slow
@NAMES
def test_control_values_change_by_a_hundredth_per_simulation_step(name):
    env = make(name)
    goal = 0.2 * jnp.ones(env.action_size)
    states, *_ = play(env, jnp.stack([goal, goal, -goal]))
    rows = states.muscles.applied[:, : env.n_directions]
    np.testing.assert_allclose(rows[0], 0.14, atol=1e-12)
    np.testing.assert_array_equal(rows[1], 0.2)
    np.testing.assert_allclose(rows[2], 0.06, atol=1e-12)
    np.testing.assert_array_equal(states.muscles.applied[:, env.n_directions :], 0)


@NAMES
def test_arm_obstacles_and_episode_are_the_published_ones(name):
    env = make(name)
    params, state = start(env)
    size, actions, count = {"structured": (160, 2, 8), "unstructured": (220, 4, 12)}[
        name
    ]
    assert (env.observation_size, env.action_size) == (size, actions)
    assert (env.n_elements, env.substeps, env.episode_length) == (50, 14, 3571)
    np.testing.assert_allclose(params.dt, 1e-4, rtol=1e-12)
    np.testing.assert_allclose(env.control_period, 1.4e-3)
    np.testing.assert_allclose(state.arm.positions[:, 0], [0, 0.5, 0])
    np.testing.assert_allclose(state.arm.tip, [0, 0.5, 1], rtol=1e-12)
    rows = np.asarray(state.arm.directors)[..., 0]
    np.testing.assert_allclose(rows, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)
    assert params.arm.contact.cylinders.starts.shape == (3, count)
    np.testing.assert_array_equal(params.arm.contact.stiffness, 8e4)
    np.testing.assert_array_equal(params.arm.contact.damping, 4.0)
    target = [-0.8, 0.5, 0.15 if name == "structured" else 0.35]
    np.testing.assert_allclose(state.target.position, target)
    spline = params.arm.muscles.spline
    points = jnp.asarray([0.0, 0.4, 0.9, 1.0])
    values = spline(jnp.asarray([0.3, -0.7]), points)
    np.testing.assert_allclose(values, [0, 0.3, -0.7, 0], atol=1e-12)


@pytest.mark.slow
def test_observation_of_the_maze_is_nodes_tip_target_and_points_of_cylinders():
    env = make("structured")
    states, obs, *_ = play(env, jnp.full((3, 2), 0.5))
    arm = jax.tree.map(lambda leaf: np.asarray(leaf[-1]), states.arm)
    obs = np.asarray(obs[-1])
    np.testing.assert_array_equal(obs[:33], arm.positions[:, ::5].ravel())
    speed = np.linalg.norm(arm.velocities[:, -1])
    np.testing.assert_allclose(obs[33], speed, rtol=1e-12)
    np.testing.assert_allclose(obs[34:37] * speed, arm.velocities[:, -1], rtol=1e-12)
    np.testing.assert_allclose(obs[37:40], [-0.8, 0.5, 0.15])
    points = [[x, y, z] for x, z in MAZE for y in (0.0, 0.25, 0.5, 0.75, 1.0)]
    np.testing.assert_allclose(obs[40:], np.ravel(points), atol=1e-15)


def test_observation_of_the_nest_is_of_directions_from_the_base():
    env = make("unstructured")
    obs, _ = env.reset(KEY, env.default_params())
    directions = np.asarray(published_nest().directions).T
    parts = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    points = np.array([0, 0.5, 0]) + parts[:, None] * directions[:, None, :]
    np.testing.assert_allclose(obs[40:], points.ravel(), atol=1e-12)


def test_published_nest_is_of_unit_frames_and_its_figure():
    nest = published_nest()
    for field in (nest.directions, nest.normals):
        np.testing.assert_allclose(np.linalg.norm(field, axis=0), 1, atol=2e-6)
    skew = np.sum(nest.directions * nest.normals, axis=0)
    np.testing.assert_allclose(skew, 0, atol=2e-6)
    np.testing.assert_allclose(nest.starts[:, 10], [-0.8, 0.1, 0.7])
    direction = [-0.233819, -0.794479, 0.560475]
    np.testing.assert_allclose(nest.directions[:, 3], direction, atol=2e-6)
    np.testing.assert_array_equal(nest.radii, 0.03)
    # Most have their middle in the plane of the base.
    middles = np.asarray(nest.centres)[1, :10]
    np.testing.assert_allclose(middles[np.arange(10) != 5], 0.5, atol=1e-6)


def test_random_nests_lie_as_the_released_generator_puts_them():
    starts = []
    for seed in range(40):
        nest = random_nest(seed)
        np.testing.assert_allclose(np.linalg.norm(nest.directions, axis=0), 1)
        np.testing.assert_allclose(
            np.sum(nest.directions * nest.normals, axis=0), 0, atol=1e-12
        )
        np.testing.assert_allclose(nest.centres[1], 0.5, atol=1e-12)
        # -sin a, a from 60 to 120 degrees.
        assert np.all(nest.directions[1] <= -np.sqrt(0.75))
        assert np.all(np.abs(nest.directions[::2]) <= 0.5 + 1e-12)
        starts.append(np.asarray(nest.starts))
    x, _, z = np.concatenate(starts, axis=1)
    for values, low, high in ((x, -0.55, -0.40), (z, -0.15, 0.85)):
        assert low <= values.min() < low + 0.02 and high - 0.02 < values.max() <= high
    assert len(np.unique(x)) == 480
    np.testing.assert_array_equal(random_nest(3).starts, random_nest(3).starts)
    params = make("unstructured", nest=3).default_params()
    np.testing.assert_array_equal(params.arm.contact.cylinders.starts, starts[3])


@pytest.mark.slow
@NAMES
@pytest.mark.parametrize(
    ("distance", "bonus"), [(0.04, 2.0), (0.06, 0.5), (0.099, 0.5), (0.11, 0.0)]
)
def test_reward_is_minus_squared_distance_plus_two_tiers(name, distance, bonus):
    env = make(name)
    params, state = start(env)
    target = dataclasses.replace(
        state.target, position=jnp.asarray([0.0, 0.5, 1.0 - distance])
    )
    state = dataclasses.replace(state, target=target)
    nothing = jnp.zeros(env.action_size)
    _, _, reward, *_ = stepping(env)(KEY, state, nothing, params)
    np.testing.assert_allclose(reward, bonus - distance**2, rtol=1e-9)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("name", "score"), SCORES)
def test_doing_nothing_scores_what_was_published(name, score):
    env = make(name)
    _, _, rewards, terminated, truncated, _ = play(env, jnp.zeros((2, env.action_size)))
    np.testing.assert_allclose(3571 * rewards, -score, atol=0.6)
    assert not np.any(terminated) and not np.any(truncated)


@pytest.mark.fast_sets(1)
@NAMES
def test_a_broken_arm_costs_a_hundred_and_shows_what_was_last_finite(name):
    env = make(name)
    params, state = start(env)
    seen = env.observe(state, params)
    broken = dataclasses.replace(
        state.arm, velocities=state.arm.velocities.at[0, 45].set(jnp.nan)
    )
    nothing = jnp.zeros(env.action_size)
    obs, _, reward, terminated, truncated, info = stepping(env)(
        KEY, dataclasses.replace(state, arm=broken), nothing, params
    )
    assert reward == -100 and terminated and not truncated and info["flagged"]
    assert np.all(np.isfinite(obs))
    last = np.linalg.norm(state.arm.tip - state.target.position)
    np.testing.assert_allclose(info["distance"], last, rtol=1e-9)
    np.testing.assert_allclose(obs[22:30], seen[22:30], atol=1e-3)
    np.testing.assert_array_equal(obs[37:], seen[37:])


@pytest.mark.parametrize(
    ("corner", "steps", "score"),
    [
        ((-1, -1, 1, 1), 24, -115.8),
        ((-1, -1, 1, -1), 28, -116.0),
        ((-1, -1, -1, -1), 40, -127.7),
    ],
)
def test_held_corners_crash_in_the_nest_when_and_at_what_was_published(
    corner, steps, score
):
    env = make("unstructured")
    params, state = start(env)
    total, count, crashed = 0.0, 0, False
    while not crashed and count < 50:
        _, state, reward, crashed, *_ = stepping(env)(
            KEY, state, jnp.asarray(corner, float), params
        )
        total, count = total + float(reward), count + 1
    # The last step before the end is one of a blow-up: there or not.
    assert abs(count - steps) <= 1
    assert abs(total - score) < 1.5


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("controls", [2, 4, 6, 8])
def test_supplement_has_equidistant_control_points(controls):
    env = make("structured", controls=controls)
    assert env.action_size == controls
    spline = env.default_params().arm.muscles.spline
    values = np.random.default_rng(0).uniform(-1, 1, controls)
    points = jnp.arange(1, controls + 1) / (controls + 1)
    np.testing.assert_allclose(spline(jnp.asarray(values), points), values, atol=1e-10)


@pytest.mark.slow
@pytest.mark.default_precision
@VARIANTS
@NAMES
def test_vmap_is_a_loop_numbers_are_single_and_nothing_recompiles(name, variant):
    check_vmap_is_a_loop(make(name, variant=variant))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("structured", {"variant": "dirty"}, "variant must be one of paper, clean"),
        ("structured", {"controls": 1}, "controls must be at least 2, got 1"),
        ("structured", {"n_elements": 15}, "n_elements"),
        ("unstructured", {"variant": "dirty"}, "variant must be one of paper, clean"),
        ("unstructured", {"nest": -1}, "nest must be at least 0, got -1"),
        ("unstructured", {"substeps": 0}, "substeps"),
        ("unstructured", {"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_options_are_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        make(name, **options)
