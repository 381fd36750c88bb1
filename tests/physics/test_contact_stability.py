"""The stable step knows of stiffness, damping and friction of contact."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxrod
from physics.rods import arm


def pressed(share, faces):
    """An arm pressed onto a floor, in equilibrium with it.

    The floor's stiffness is a share of what would double the squared frequency. Without
    faces the arm's ends count as places where other rods go on.
    """
    rod, state = arm(3, radius=0.02)
    frequency = jaxrod.stable_dt(jaxrod.make_scene(rod), 1.0).angular_frequency
    line = rod.linear_density[0]
    stiffness = share * frequency**2 * line
    depth = 0.1 * 0.02
    floor = jaxrod.contact(
        jaxrod.shapes.plane((0.0, depth - 0.02, 0.0), (0.0, 1.0, 0.0)),
        stiffness=stiffness,
    )
    if not faces:
        floor = floor.with_free_ends(jnp.zeros(2))
    down = jnp.asarray([0.0, -1.0, 0.0])
    scene = jaxrod.make_scene(rod, jaxrod.uniform_load(down * stiffness * depth), floor)
    return scene, state


@jax.jit
def excursion(scene, state, dt):
    """How far a rod disturbed by 1e-8 gets from its place in 2000 steps [m]."""
    noise = 1e-8 * jax.random.normal(jax.random.key(0), state.positions.shape)
    disturbed = replace(state, positions=state.positions + noise)
    after = jaxrod.advance(scene, disturbed, dt, jnp.asarray(2000))
    return jnp.max(jnp.abs(after.positions - state.positions)[1])


@pytest.mark.slow
@pytest.mark.parametrize("faces", [False, True])
@pytest.mark.parametrize("share", [0.01, 1.0, 100.0])
def test_the_stable_step_knows_of_the_stiffness_of_contact(share, faces, record):
    """The bound allows for ends that lean; here they lie flat, so that it is lower."""
    scene, state = pressed(share, faces)
    bound = float(jaxrod.stable_dt(scene, 1.0).dt)
    measured = float(jaxrod.stable_dt(scene, 1.0, state=state).dt)
    record(
        f"Stable step divided by the true limit, contact of {share:g} times the rod's "
        f"squared frequency, {'with' if faces else 'without'} faces",
        "2/omega_max by iteration, touching",
        bound / measured,
        between=(0.75 if faces else 0.99, 1.001),
    )
    assert excursion(scene, state, 0.99 * measured) < 1e-6
    assert not excursion(scene, state, 1.03 * measured) < 1e-4


@jax.jit
def columns(scene, state, dt):
    """The one-step map of small motions, each of one number of the state alone.

    Leaf by leaf: XLA would compute a step again for every number of one long vector.
    """
    flat, unravel = ravel_pytree(state)

    def along(number):
        motion = unravel(number)
        return jax.jvp(lambda x: jaxrod.step(scene, x, dt), (state,), (motion,))[1]

    return jax.vmap(along)(jnp.eye(flat.size))


def growth(scene, state, dt):
    """The matrix by which a step changes small motions."""
    leaves = jax.tree.leaves(columns(scene, state, dt))
    rows = [np.reshape(leaf, (len(leaf), -1)) for leaf in leaves]
    return np.concatenate(rows, axis=1).T


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "drag"), [(0.5, 0.0), (0.0, 0.1), (0.2, 0.05)])
def test_the_stable_step_knows_of_damping_and_friction(damping, drag, record):
    """Rates of damping and drag as shares of the highest frequency of the rod."""
    scene, state = pressed(0.5, True)
    unit = (
        float(jaxrod.stable_dt(scene, 1.0).angular_frequency)
        * scene.rod.linear_density[0]
    )
    contact = replace(
        scene.effects[1],
        damping=damping * unit,
        friction=jnp.asarray(0.5),
        friction_drag=drag * unit,
    )
    scene = replace(scene, effects=(scene.effects[0], contact))
    bound = float(jaxrod.stable_dt(scene, 1.0).dt)

    def is_stable(dt):
        factors = np.linalg.eigvals(growth(scene, state, dt))
        return np.max(np.abs(factors)) < 1 + 1e-3

    low, high = 0.25 * bound, 4 * bound
    for _ in range(10):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    record(
        f"Stable step divided by the true limit, contact with damping {damping:g} and "
        f"friction drag {drag:g} of the rod's frequency",
        "eigenvalues of a step, touching",
        bound / low,
        between=(0.5, 1.005),
    )
