"""The one-step map of small motions about a state, and the largest stable step."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import jaxrod


@partial(jax.jit, static_argnames="run")
def columns(scene, state, dt, run=jaxrod.step):
    """The one-step map of small motions, each of one number of the state alone.

    Leaf by leaf: XLA would compute a step again for every number of one long vector.
    """
    flat, unravel = ravel_pytree(state)

    def along(number):
        motion = unravel(number)
        return jax.jvp(lambda x: run(scene, x, dt), (state,), (motion,))[1]

    return jax.vmap(along)(jnp.eye(flat.size, dtype=flat.dtype))


def growth(scene, state, dt):
    """The matrix by which a step changes small motions."""
    leaves = jax.tree.leaves(columns(scene, state, dt))
    rows = [np.reshape(leaf, (len(leaf), -1)) for leaf in leaves]
    return np.concatenate(rows, axis=1).T


def swings_up(scene, state, dt):
    """Whether a motion grows that changes its sign in every step."""
    matrix = growth(scene, state, dt)
    if not np.all(np.isfinite(matrix)):
        return True
    factors = np.linalg.eigvals(matrix)
    return bool(np.any((factors.real < 0) & (np.abs(factors) > 1 + 1e-5)))


def measured_limit(scene, state, near, precision=1e-3):
    """The largest step at which no motion swings up, near another one [s].

    Args:
        scene: The scene.
        state: Where it is at rest.
        near: A step from which to search [s].
        precision: Relative.
    """
    low = high = near
    while swings_up(scene, state, low):
        low, high = low / 1.5, low
    if low == high:
        while not swings_up(scene, state, high):
            low, high = high, 1.5 * high
            if high > 1e3 * near:
                return np.inf
    while high > (1 + precision) * low:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if swings_up(scene, state, middle) else (middle, high)
    return low
