"""The maze is a planar task: its arm never leaves the plane y = 0.5 m."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import pyelastica
from jaxrod.envs import make

KEY = jax.random.key(0)


def test_cylinders_of_the_maze_stand_across_its_plane():
    """From one side to the other, so that within the plane they are circles."""
    maze = make("structured", variant="clean").obstacles()
    np.testing.assert_array_equal(maze.directions, np.eye(3)[[1]].T + 0 * maze.starts)
    np.testing.assert_allclose(
        maze.centres[1], 0.5 * maze.lengths + maze.starts[1], rtol=1e-6
    )
    np.testing.assert_array_equal(maze.centres[::2], maze.starts[::2])


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", ["paper", pytest.param("clean", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("double", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_arm_stays_in_its_plane_exactly(variant, double):
    """For whole episodes, whatever the action: held, new in every step, or both."""
    with jax.enable_x64(double):
        env = make("structured", variant=variant)
        params = env.default_params()
        corners = jnp.asarray([[1, 1], [1, -1], [-1, 1], [-1, -1], [-0.6, 0.1]], float)
        held = jnp.concatenate(
            [corners, jax.random.uniform(KEY, (3, env.action_size), minval=-1)]
        )
        shares = jnp.asarray([1.0, 1, 1, 1, 1, 1, 0, 0.5])[:, None]

        def worst(state):
            arm = state.arm
            heights = jnp.max(jnp.abs(arm.positions[1] - 0.5))
            speeds = jnp.max(jnp.abs(arm.velocities[1]))
            spins = jnp.max(jnp.abs(arm.angular_momenta[::2]))
            tilts = jnp.max(jnp.abs(arm.directors[2, 1]))
            return jnp.stack([heights, speeds, spins, tilts])

        def step(carry, key):
            states, largest = carry
            new = jax.random.uniform(key, held.shape, minval=-1)
            _, states, *_ = jax.vmap(env.step, in_axes=(None, 0, 0, None))(
                KEY, states, shares * held + (1 - shares) * new, params
            )
            # An arm of the published simulator that breaks is no arm any more.
            found = jax.vmap(worst)(states)
            whole = jnp.all(jnp.isfinite(found), axis=1, keepdims=True)
            return (states, jnp.maximum(largest, jnp.where(whole, found, 0))), whole

        @jax.jit
        def play():
            state = env.reset(KEY, params)[1]
            states = jax.tree.map(lambda x: jnp.stack([x] * len(held)), state)
            carry = states, jnp.zeros((len(held), 4))
            keys = jax.random.split(KEY, env.episode_length)
            (states, largest), whole = jax.lax.scan(step, carry, keys)
            return states.arm.positions, largest, jnp.sum(whole, axis=0)[:, 0]

        positions, largest, lasted = jax.tree.map(np.asarray, play())
    assert np.sum(lasted == env.episode_length) >= 3, lasted
    assert np.nanmin(positions[:, 0]) < -0.3
    np.testing.assert_array_equal(largest[:, :3], 0)
    assert np.max(largest[:, 3]) < 4 * np.finfo(positions.dtype).eps


@pytest.mark.slow
def test_in_the_plane_the_arm_is_the_one_in_space():
    """For as long as rounding leaves that one in the plane."""
    env = make("structured")
    params = env.default_params()
    arm = params.arm
    free = replace(arm, method=pyelastica(), contact=replace(arm.contact, plane=None))
    actions = jax.random.uniform(KEY, (50, 50, 2), minval=-1)
    actions = actions.at[:25].set(actions[:25, :1])

    @jax.jit
    def play(arm):
        def one(actions):
            def step(state, action):
                at = replace(params, arm=arm)
                _, state, *_ = env.step(KEY, state, action, at)
                return state, (state.arm, state.muscles.couples)

            return jax.lax.scan(step, env.reset(KEY, params)[1], actions)[1]

        return jax.vmap(one)(actions)

    flat, full = play(arm), play(free)
    x, _, z = np.moveaxis(np.asarray(full[0].positions), 2, 0)
    nearest = np.min(np.hypot(x + 0.2, z - 0.12), axis=-1)
    assert np.any((nearest < 0.14) & (np.min(x, axis=-1) < -0.14)), "nothing touched"
    for one, other in zip(jax.tree.leaves(flat), jax.tree.leaves(full), strict=True):
        scale = float(jnp.max(jnp.abs(other)))
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * max(scale, 1e-9))
