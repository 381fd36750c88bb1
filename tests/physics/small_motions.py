"""Statics and small vibrations, worked out from the loads without stepping in time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from physics.rods import loads, no_moves, perturb


def held_freedoms(rod, node=True, element=False):
    """Which of the 3(n+1) + 3n freedoms are left with the first node, element held."""
    n = rod.n_elements
    nodes, elements = np.ones((3, n + 1), bool), np.ones((3, n), bool)
    nodes[:, 0], elements[:, 0] = not node, not element
    return np.concatenate([nodes.ravel(), elements.ravel()])


def flat(moves):
    return jnp.concatenate([moves[0].ravel(), moves[1].ravel()])


def unflat(state, vector):
    nodes, elements = no_moves(state)
    return (
        vector[: nodes.size].reshape(nodes.shape),
        vector[nodes.size :].reshape(elements.shape),
    )


def moved(state, vector):
    return perturb(state, unflat(state, vector))


@jax.jit
def unbalance(scene, state):
    """Loads on all freedoms, and minus their derivative: the tangent stiffness."""

    def at(vector):
        return flat(loads(scene, moved(state, vector)))

    start = flat(no_moves(state))
    return at(start), -jax.jacfwd(at)(start)


def frequencies(scene, state, free=None):
    """Angular frequencies of small motions about a state at rest [rad/s], rising."""
    stiffness = np.asarray(unbalance(scene, state)[1])
    transverse, polar = scene.rod.inertias
    inertia = np.ravel([transverse, transverse, polar])
    root = np.sqrt(np.concatenate([np.tile(scene.rod.node_masses, 3), inertia]))
    free = np.ones(root.shape, bool) if free is None else free
    matrix = (stiffness / root / root[:, None])[np.ix_(free, free)]
    squares = np.linalg.eigvalsh((matrix + matrix.T) / 2)
    return np.sqrt(np.maximum(squares, 0))


def equilibrium(scene_under, state, free, steps=10):
    """Where all loads balance, by Newton's method, load by load.

    Args:
        scene_under: gives the scene under a fraction of its load.
        state: the unloaded state.
        free: the freedoms that are not held.
        steps: number of load steps.
    """
    for fraction in np.arange(1, steps + 1) / steps:
        for _ in range(50):
            load, stiffness = map(np.asarray, unbalance(scene_under(fraction), state))
            move = np.zeros(len(free))
            move[free] = np.linalg.solve(stiffness[np.ix_(free, free)], load[free])
            state = moved(state, jnp.asarray(move))
            if np.max(np.abs(move)) < 1e-9:
                break
        else:
            raise AssertionError("Newton's method did not converge")
    return state
