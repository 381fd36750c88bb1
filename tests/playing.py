"""What the tests of the arm tasks share: playing episodes, contracts of every task."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

KEY = jax.random.key(0)


@functools.cache
def stepping(env):
    """The compiled step of an environment, the same for all tests."""
    return jax.jit(env.step)


@functools.cache
def parameters(env):
    """Its parameters in double precision."""
    return env.default_params()


def start(env):
    """Parameters and first state."""
    params = parameters(env)
    return params, env.reset(KEY, params)[1]


def play(env, actions):
    """State, observation, reward, ends and info after each of some actions."""
    params, state = start(env)
    steps = []
    for action in actions:
        obs, state, *others = stepping(env)(KEY, state, action, params)
        steps.append((state, obs, *others))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *steps)


def total_reward(env, actions, params):
    """The return of a sequence of actions; differentiable."""

    def body(state, action):
        _, state, reward, *_ = env.step(KEY, state, action, params)
        return state, reward

    return jnp.sum(jax.lax.scan(body, env.reset(KEY, params)[1], actions)[1])


def gradient_error(env, actions, params=None, h=1e-5, optimised=True):
    """Of the return's slope along a random direction, against finite differences.

    Not `optimised`, the program of the slope is compiled in less time.
    """
    params = env.default_params() if params is None else params
    direction = jnp.asarray(np.random.default_rng(3).normal(size=actions.shape))
    total = jax.jit(lambda actions: total_reward(env, actions, params))
    options = None if optimised else {"xla_backend_optimization_level": 0}
    slope_of = jax.jit(jax.grad(total), compiler_options=options)
    slope = jnp.sum(slope_of(actions) * direction)
    secant = (total(actions + h * direction) - total(actions - h * direction)) / (2 * h)
    assert abs(slope) > 1e-6
    return abs(slope / secant - 1)


def smooth_actions(steps, size, amplitude, seed=0):
    """Piecewise linear, a knot every 50 control steps."""
    knots = np.random.default_rng(seed).uniform(-1, 1, (steps // 50 + 2, size))
    time = np.arange(steps) / 50
    index = time.astype(int)
    part = (time - index)[:, None]
    return jnp.asarray(
        amplitude * (knots[index] * (1 - part) + knots[index + 1] * part)
    )


def check_vmap_is_a_loop(env, atol=1e-4):
    """A batch of three does what three do alone, in single precision."""
    params = env.default_params()
    keys = jax.random.split(KEY, 3)
    actions = jax.random.uniform(KEY, (3, env.action_size), minval=-1.0)
    _, states = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    step = jax.jit(env.step)
    batch = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))(
        keys, states, actions, params
    )
    for i in range(3):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        single = step(keys[i], state, actions[i], params)
        for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-4, atol=atol)
            assert a.dtype in (jnp.float32, jnp.int32, jnp.bool_)
    # One program serves all actions and all parameters.
    state = jax.tree.map(lambda leaf: leaf[0], states)
    step(KEY, state, 0 * actions[0], jax.tree.map(lambda leaf: 1.01 * leaf, params))
    assert step._cache_size() == 1
