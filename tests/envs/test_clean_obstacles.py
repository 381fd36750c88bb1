"""The obstacle tasks with the library's own physics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.envs import make
from jaxrod.rods.motion import motion_of
from physics.validation import record as record
from playing import KEY, gradient_error, smooth_actions, start, stepping

NAMES = pytest.mark.parametrize("name", ["structured", "unstructured"])
# The nest's dozen bodies take long to compile; what the maze shows holds for both.
MAZE_FIRST = pytest.mark.parametrize(
    "name", ["structured", pytest.param("unstructured", marks=pytest.mark.slow)]
)


@pytest.mark.slow
@MAZE_FIRST
def test_clean_arm_is_pushed_the_published_way_at_a_limited_rate(name):
    env = make(name, variant="clean")
    params, state = start(env)
    action = jnp.zeros(env.action_size).at[0].set(0.3)
    for _ in range(25):
        _, state, reward, terminated, truncated, info = stepping(env)(
            KEY, state, action, params
        )
    assert state.arm.tip[0] > 1e-3  # a positive normal action pushes towards +x
    np.testing.assert_allclose(state.arm.positions[1], 0.5, atol=1e-9)
    np.testing.assert_allclose(state.muscles[0], [0.3, 0], atol=1e-12)
    assert not terminated and not truncated and not info["flagged"]
    np.testing.assert_allclose(
        reward, -jnp.sum((state.arm.tip - state.target.position) ** 2)
    )


@pytest.mark.fast_sets(1)
@NAMES
def test_clean_obstacles_are_where_they_are_seen(name):
    env = make(name, variant="clean")
    params, state = start(env)
    obs = env.observe(state, params)
    points = np.asarray(obs[40:]).reshape(env.n_obstacles, 5, 3)
    obstacles = env.obstacles()
    np.testing.assert_allclose(points[:, 0], obstacles.starts.T, atol=1e-12)
    np.testing.assert_allclose(points[:, 4], obstacles.ends.T, atol=1e-12)
    (touch,) = params.arm.obstacles
    for j in range(env.n_obstacles):
        body = jax.tree.map(lambda leaf, j=j: leaf[j], touch.body)
        middle = tuple(jnp.asarray([c]) for c in points[j, 2])
        depth, _ = body.surface(middle)
        np.testing.assert_allclose(depth, -obstacles.radii[j], rtol=1e-5)


@pytest.mark.slow
@MAZE_FIRST
def test_an_unhealthy_clean_arm_is_frozen_and_truncated_not_punished(name):
    env = make(name, variant="clean")
    params, state = start(env)
    fast = dataclasses.replace(
        state.arm, velocities=state.arm.velocities.at[0, -1].set(5000.0)
    )
    state = dataclasses.replace(state, arm=fast)
    nothing = jnp.zeros(env.action_size)
    _, after, reward, terminated, truncated, info = stepping(env)(
        KEY, state, nothing, params
    )
    assert truncated and not terminated and info["flagged"] and reward > -10
    last = np.linalg.norm(state.arm.tip - state.target.position)
    np.testing.assert_allclose(info["distance"], last, rtol=1e-9)
    np.testing.assert_array_equal(after.arm.positions, state.arm.positions)


@pytest.mark.slow
# The arm's radius is 5 cm. In the maze it cannot touch an obstacle it does not look at;
# in the nest only where it overlaps with five at once, by some two centimetres.
@pytest.mark.parametrize(
    ("name", "clearance"), [("structured", 0.10), ("unstructured", 0.03)]
)
def test_obstacles_an_arm_does_not_look_at_are_out_of_its_way(name, clearance):
    env = make(name, variant="clean")
    params = env.default_params()
    (touch,) = params.arm.obstacles
    rng = np.random.default_rng(0)
    reached = rng.uniform(-1.2, 1.2, (3, 300_000)) + np.reshape([0, 0.5, 0], (3, 1))
    if name == "structured":
        reached[1] = 0.5
    points = tuple(jnp.asarray(c) for c in reached)
    distances = jax.vmap(lambda body: body.surface(points)[0])(touch.body)
    ordered = jnp.sort(distances, axis=0)
    ordered = ordered[:, ordered[0] > 0]  # the centreline stays out of obstacles
    nearest = params.arm.nearest
    assert jnp.min(ordered[nearest]) > clearance
    assert jnp.min(ordered[1]) < 0.05  # it can touch two


def touching_at_rest(env, towards):
    """Numbers of a task whose obstacles are moved until one touches the arm."""
    params = env.default_params()
    (touch,) = params.arm.obstacles
    nearer = [
        leaf.at[:, 0].add(towards) if leaf.ndim == 2 else leaf
        for leaf in jax.tree.leaves(touch.body)
    ]
    body = jax.tree.unflatten(jax.tree.structure(touch.body), nearer)
    touch = dataclasses.replace(touch, body=body)
    arm = dataclasses.replace(params.arm, obstacles=(touch,))
    loads = touch.loads(arm.rod, motion_of(arm.rest))
    assert max(float(jnp.max(jnp.abs(c))) for c in loads.forces) > 1.0
    return dataclasses.replace(params, arm=arm)


TOUCHING = pytest.mark.parametrize(
    ("name", "towards"), [("structured", 0.052), ("unstructured", 0.252)]
)


@pytest.mark.slow
@TOUCHING
def test_an_arm_that_looks_at_the_nearest_obstacles_moves_as_if_at_all(name, towards):
    env = make(name, variant="clean")
    params = touching_at_rest(env, towards)
    scene = params.arm.scene(jnp.zeros((3, env.n_controls)), params.arm.rest)
    assert scene.effects[-1].n_near == params.arm.nearest < env.n_obstacles
    careful = dataclasses.replace(params.arm, nearest=None)
    actions = smooth_actions(50, env.action_size, 1.0)

    @jax.jit
    def tips(params):
        def body(state, action):
            _, state, *_ = env.step(KEY, state, action, params)
            return state, state.arm.tip

        return jax.lax.scan(body, env.reset(KEY, params)[1], actions)[1]

    found, wanted = tips(params), tips(dataclasses.replace(params, arm=careful))
    assert jnp.max(jnp.abs(wanted - wanted[:1])) > 0.05
    np.testing.assert_allclose(found, wanted, atol=1e-9)


@pytest.mark.slow
@TOUCHING
def test_gradient_through_contact_is_that_of_finite_differences(name, towards, record):
    env = make(name, variant="clean")
    params = touching_at_rest(env, towards)
    actions = smooth_actions(50, env.action_size, 0.5)
    record(
        f"Gradient of 50 control steps' return with respect to the actions, {name}, "
        "touching",
        "finite differences",
        gradient_error(env, actions, params),
        at_most=1e-5,
    )


@pytest.mark.slow
@NAMES
@pytest.mark.parametrize(
    "limit",
    [pytest.param("smallest_stretch", marks=pytest.mark.slow), "largest_stretch"],
)
def test_an_arm_at_the_limits_of_stretch_is_stepped_stably(name, limit):
    env = make(name, variant="clean")
    params = env.default_params()
    arm, rest = params.arm, params.arm.rest
    scene = arm.scene(jnp.zeros((3, env.n_controls)))
    # What moves in the plane moves in space.
    free = dataclasses.replace(
        scene, effects=scene.effects[:3], method=jaxrod.consistent()
    )
    base = rest.positions[:, :1]
    stretched = base + getattr(arm.limits, limit) * (rest.positions - base)
    state = dataclasses.replace(rest, positions=stretched)
    assert params.dt < 0.6 * 2 / jaxrod.highest_frequency(free, state)


@pytest.mark.slow
@MAZE_FIRST
def test_the_step_is_a_stable_one_with_every_obstacle_in_view_touching(name):
    env = make(name, variant="clean")
    params = env.default_params()
    scene = params.arm.scene(jnp.zeros((3, env.n_controls)), params.arm.rest)
    assert scene.effects[-1].n_near == params.arm.nearest
    assert params.dt < jaxrod.stable_dt(scene).dt
    # A bound that contact is part of: a hundred times as stiff it would be crossed.
    (touch,) = params.arm.obstacles
    stiffer = dataclasses.replace(touch, stiffness=100 * touch.stiffness)
    arm = dataclasses.replace(params.arm, obstacles=(stiffer,))
    assert (
        params.dt
        > jaxrod.stable_dt(arm.scene(jnp.zeros((3, env.n_controls)), arm.rest)).dt
    )


@pytest.mark.slow
def test_the_step_is_a_stable_one_for_an_arm_pressed_head_on():
    """Measured with one cylinder, a quarter of the arm's radius inside its tip."""
    env = make("structured", variant="clean")
    params = env.default_params()
    arm, rest = params.arm, params.arm.rest
    (touch,) = arm.obstacles
    radius = float(touch.body.radius[0])
    ahead = rest.tip + jnp.array([0, 0, radius + 0.75 * arm.rod.radii[-1]])
    body = jaxrod.shapes.sphere(ahead, radius)
    touch = dataclasses.replace(touch, body=body, n_bodies=None)
    arm = dataclasses.replace(arm, obstacles=(touch,), nearest=None)
    scene = arm.scene(jnp.zeros((3, env.n_controls)))
    assert params.dt < 0.8 * 2 / jaxrod.highest_frequency(scene, rest)
