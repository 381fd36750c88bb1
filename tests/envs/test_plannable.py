"""What tasks offer to planners: smooth costs, and predictions that foresee nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.envs.arm import moving_target
from jaxrod.envs.tasks.arm_task import tip_residuals
from jaxrod.envs.tasks.tracking import HEADING_STEPS

ARMS = {
    "tracking": {"n_elements": 10},
    "reaching": {"n_elements": 10},
    "structured": {"n_elements": 10},
    "unstructured": {"n_elements": 10},
}
ALL = {**ARMS, "following": {"n_elements": 6}, "trivial": {}}
CHEAP = ("trivial", "reaching")


def each(names, cheap=CHEAP):
    return [
        name if name in cheap else pytest.param(name, marks=pytest.mark.slow)
        for name in names
    ]


def task(name):
    variant = {} if name == "trivial" else {"variant": "clean"}
    return make(name, **ALL[name], **variant)


def begun(env, seed=0):
    params = env.default_params()
    if hasattr(params, "chance"):
        params = dataclasses.replace(params, chance=jnp.asarray(0.0))
    return params, env.reset(jax.random.key(seed), params)[1]


def test_the_cost_of_a_way_is_its_square_nearby_and_linear_far_away():
    touching, width = 0.05, 0.2
    for size in (1e-4, 0.1, 0.2, 1.0, 30.0):
        way = size * np.array([0.6, 0.0, -0.8])
        found = np.asarray(tip_residuals(jnp.asarray(way), touching, width))
        over = np.sqrt(1 + (size / width) ** 2) - 1
        cost = 2 * (width / touching) ** 2 * over
        np.testing.assert_allclose(np.sum(found**2), cost, rtol=1e-7)
        np.testing.assert_allclose(np.cross(found, way), 0, atol=1e-6 * size)


def actions_of(env, steps, seed=0):
    drawn = np.random.default_rng(seed).uniform(-1, 1, (steps, env.action_size))
    return jnp.asarray(0.5 * drawn)


def stepped(env, params, state, actions, seed=1):
    def one(state, given):
        index, action = given
        key = jax.random.fold_in(jax.random.key(seed), index)
        _, state, reward, *_ = env.step(key, state, action, params)
        return state, (state, reward)

    return jax.jit(lambda s: jax.lax.scan(one, s, (jnp.arange(len(actions)), actions)))(
        state
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", each(ALL))
def test_a_prediction_is_a_step_where_nothing_random_falls(name):
    env = task(name)
    params, state = begun(env)
    actions = actions_of(env, 3)
    _, (states, _) = stepped(env, params, state, actions)
    predicted = state
    predict = jax.jit(env.predict)
    for index, action in enumerate(actions):
        predicted = predict(predicted, action, params)
        actual = jax.tree.map(lambda leaf, i=index: leaf[i], states)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12),
            predicted,
            actual,
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", each(ALL))
def test_an_action_that_is_held_is_so_many_steps(name):
    env = task(name)
    params, state = begun(env)
    action = actions_of(env, 1)[0]
    last, _ = stepped(env, params, state, jnp.stack([action] * 4))
    held = jax.jit(env.predict, static_argnums=3)(state, action, params, 4)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10), held, last
    )


@pytest.mark.slow
def test_a_turn_of_the_target_is_not_foreseen():
    env = task("tracking")
    params, state = begun(env)
    state = dataclasses.replace(state, steps=jnp.asarray(HEADING_STEPS - 1, jnp.int32))
    action = actions_of(env, 1)[0]
    last, _ = stepped(env, params, state, action[None])
    predicted = env.predict(state, action, params)
    straight = moving_target.fly(
        state.target, params.target, 0.5 * params.dt, 2 * env.substeps
    )
    np.testing.assert_array_equal(predicted.target.position, straight.position)
    np.testing.assert_array_equal(predicted.target.velocity, straight.velocity)
    np.testing.assert_allclose(predicted.target.position, last.target.position)
    assert np.abs(predicted.target.velocity - last.target.velocity).max() > 0.01


def moved_to(env, state, place):
    """The state with its goal so far from the tip."""
    if not hasattr(state, "target"):
        return dataclasses.replace(state, position=jnp.asarray(place[0]))
    position = state.arm.tip + jnp.asarray(place)
    target = dataclasses.replace(state.target, position=position)
    return dataclasses.replace(state, target=target)


@pytest.mark.slow
@pytest.mark.parametrize("name", each(ALL, cheap=tuple(ALL)))
def test_the_cost_grows_with_the_distance_and_has_a_slope_where_bonuses_have_none(name):
    env = task(name)
    params, state = begun(env)
    action = jnp.zeros(env.action_size)

    def cost(distance):
        way = distance * jnp.asarray([0.6, 0.0, 0.8])
        return env.cost(moved_to(env, state, way), action, params)

    distances = jnp.linspace(0.0, 1.5, 31)
    costs = np.asarray(jax.vmap(cost)(distances))
    assert np.all(np.diff(costs) > 0)
    slopes = np.asarray(jax.vmap(jax.grad(cost))(distances))
    assert np.all(np.isfinite(slopes)) and slopes[0] == 0 and np.all(slopes[1:] > 0)
    # By differences, at a place where the reward's bonuses are flat.
    differences = (cost(0.3 + 1e-6) - cost(0.3 - 1e-6)) / 2e-6
    assert jax.grad(cost)(0.3) == pytest.approx(float(differences), rel=1e-7)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", each(ALL, cheap=tuple(ALL)))
def test_the_cost_is_the_residuals_squares(name):
    env = task(name)
    params, state = begun(env)
    state = moved_to(env, state, (0.1, 0.2, -0.3))
    action = jnp.zeros(env.action_size)
    squares = jnp.sum(env.residuals(state, action, params) ** 2)
    assert env.cost(state, action, params) == pytest.approx(float(squares), rel=1e-12)


def test_costs_nearby_are_squares_of_touching_distances():
    env = task("structured")
    params, state = begun(env)
    state = moved_to(env, state, (0.0, 0.005, 0.0))
    cost = env.cost(state, jnp.zeros(env.action_size), params)
    assert cost == pytest.approx((0.005 / 0.05) ** 2, rel=1e-3)
    # Far away it is linear: the width says where.
    far = moved_to(env, state, (0.0, 1.0, 0.0))
    cost = env.cost(far, jnp.zeros(env.action_size), params, width=0.01)
    assert cost == pytest.approx(2 * 0.01 * (1.0 - 0.01) / 0.05**2, rel=1e-3)


def test_the_turn_of_the_tip_costs_its_misalignment():
    env = task("reaching")
    params, state = begun(env, seed=3)
    state = moved_to(env, state, (0.0, 0.0, 0.0))
    action = jnp.zeros(env.action_size)
    from jaxrod.envs.tasks.reaching import misaligned

    expected = misaligned(state.arm, state.target) / params.aligned[1]
    assert float(expected) > 0.1
    assert env.cost(state, action, params) == pytest.approx(float(expected), rel=1e-9)
    aligned = dataclasses.replace(
        state.target,
        orientation=state.arm.orientations[:, -1] * jnp.asarray([1.0, -1, -1, -1]),
    )
    state = dataclasses.replace(state, target=aligned)
    assert float(env.cost(state, action, params)) < 1e-20


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_gradients_of_predicted_costs_are_those_of_differences(name):
    env = task(name)
    params, state = begun(env)
    action, way = 0.3 * actions_of(env, 2)

    def cost(size):
        def one(state, _):
            return env.predict(state, action + size * way, params, 2), None

        last, _ = jax.lax.scan(one, state, length=5)
        return env.cost(last, action, params)

    slope = jax.jit(jax.grad(cost))(0.0)
    cost, size = jax.jit(cost), 1e-4
    differences = (
        8 * (cost(size) - cost(-size)) - (cost(2 * size) - cost(-2 * size))
    ) / (12 * size)
    assert abs(float(slope)) > 1e-3
    assert slope == pytest.approx(float(differences), rel=1e-6)
