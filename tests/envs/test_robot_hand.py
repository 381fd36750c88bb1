"""A robot's joints instead of a hand that moves freely, in the task `lift`."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.randomised.run import BODIES
from jaxrod import envs, training

FILE = Path(__file__).parents[2] / "examples" / "robot_arm.urdf"
PERIOD = 0.1


def robot(**more):
    arm = jaxrod.robot_arm(FILE, "hand", position=(-0.45, 0.0, 0.0))
    params = envs.make("lift").default_params()
    return envs.robot_hand(arm, params.hand, **more), params


def inside(arm, coordinates):
    """Whether all coordinates are in the ranges of the joints."""
    found = np.asarray(coordinates)
    return np.all((np.asarray(arm.lower) <= found) & (found <= np.asarray(arm.upper)))


@pytest.mark.slow
def test_the_hand_reaches_the_floor_of_the_task():
    hand, _ = robot()
    draws = jax.random.uniform(jax.random.key(0), (32, 2), minval=-0.1, maxval=0.1)
    points = jnp.concatenate([draws, jnp.full((32, 1), 0.005)], axis=1)
    found = jax.jit(jax.vmap(hand.reaching))(points)
    places = jax.vmap(hand.place)(found)
    np.testing.assert_allclose(places, points, atol=1e-6)
    assert inside(hand.arm, found)


def test_joints_keep_their_ranges_and_the_hand_its_height():
    hand, _ = robot(speed=(1.0, 1.5, 2.0), acceleration=7.5, lowest=0.3)

    @jax.jit
    def play(actions):
        def step(now, action):
            after = hand.moved(*now, action, PERIOD)
            return after, (*after, hand.place(after[0]))

        start = hand.reaching(jnp.array([0.0, 0.0, 0.5])), jnp.zeros(3)
        return jax.lax.scan(step, start, actions)[1]

    actions = jax.random.uniform(jax.random.key(1), (400, 3), minval=-2.0, maxval=2.0)
    at, rates, places = play(jnp.repeat(actions[:80], 5, axis=0))
    assert inside(hand.arm, at)
    assert np.all(np.abs(rates) <= np.array([1.0, 1.5, 2.0]))
    assert float(jnp.min(places[:, 2])) >= 0.3 - 1e-9
    assert float(jnp.max(jnp.abs(rates))) > 1.0  # It moved.


@pytest.mark.slow
def test_a_robot_lifts_its_end_of_the_rope():
    """The held end is where the arm has it, along an episode of the task."""
    hand, params = robot(lowest=0.005)
    env, params = envs.make("lift"), replace(params, hand=hand)
    _, state = env.reset(jax.random.key(0), params)
    np.testing.assert_allclose(state.body.positions[2, 0], 0.005, atol=1e-6)
    step = jax.jit(env.step)
    for _ in range(8):
        action = jnp.array([0.1, -0.6, 0.2])
        out = step(jax.random.key(0), state, action, params)
        state = out[1]
        held = hand.place(state.coordinates)
        np.testing.assert_allclose(state.body.positions[:, 0], held, atol=1e-6)
        assert not out[-1]["flagged"]
    assert float(state.body.positions[2, 0]) > 0.2


@pytest.mark.slow
@pytest.mark.default_precision
def test_ppo_learns_to_lift_with_a_robot():
    hand, params = robot(lowest=0.005)
    env, params = envs.make("lift"), replace(params, hand=hand)
    found = training.train(
        env,
        steps=400_000,
        config=training.PPOConfig(**BODIES),
        env_params=params,
        evaluation_episodes=0,
        progress=False,
    )
    played = {"episodes": 64, "seed": 2, "env_params": params}
    result = training.evaluate(env, found.policy, **played)
    print(f"return of PPO with a robot: {result.mean:.1f}")
    assert result.mean > 60 and result.flagged_fraction < 0.05


def test_joints_without_limits_are_refused():
    hand, params = robot()
    endless = replace(hand.arm, upper=jnp.full(3, jnp.inf))
    with pytest.raises(ValueError, match="all joints need limits"):
        envs.robot_hand(endless, params.hand)
    with pytest.raises(ValueError, match="speed"):
        envs.robot_hand(hand.arm, params.hand, speed=-1.0)
