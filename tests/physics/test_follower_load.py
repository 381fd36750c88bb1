"""A distributed load that turns with the rod."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxrod
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    split_quaternion,
    to_world,
)
from jaxrod.rods.motion import motion_of
from physics.rods import arm, deformed, difference, random_rod

# Of an example of PyElastica's: tips over the length under q L^3 / EI.
PUBLISHED = {1.0: (0.9910, 0.1251), 3.0: (0.9213, 0.3622), 5.0: (0.7935, 0.5628)}


def inextensible(load):
    """Tip of an inextensible cantilever whose load stays normal to it, by shooting.

    Along the wall's normal and across, over the length. Nothing acts at the tip, so
    the shape is found from there, and turned.
    """

    def slope(_, y):
        angle, _, along, across = y[:4]
        c, s = np.cos(angle), np.sin(angle)
        return y[1], along * s - across * c, load * s, -load * c, c, s

    tight = {"rtol": 1e-12, "atol": 1e-12}
    angle, _, _, _, x, y = solve_ivp(slope, (1, 0), np.zeros(6), **tight).y[:, -1]
    c, s = np.cos(angle), np.sin(angle)
    return np.array([-(c * x + s * y), s * x - c * y])


@pytest.mark.parametrize("load", PUBLISHED)
def test_the_reference_is_the_published_one(load):
    apart = inextensible(load) - PUBLISHED[load]
    assert np.linalg.norm(apart) < 5e-3


@pytest.mark.slow
def test_tips_under_a_load_that_follows(record):
    rod, state = arm(40, radius=0.005)
    wall, stiffness = jaxrod.clamp(state), float(rod.joint_stiffness[0, 0])
    solve = jax.jit(
        lambda load, state: jaxrod.equilibrium(
            jaxrod.make_scene(
                rod, wall, jaxrod.uniform_load((load, 0.0, 0.0), follower=True)
            ),
            state,
        )
    )
    worst = 0.0
    for step in range(1, 26):
        found = solve(step * stiffness, state)
        assert found.converged
        state = found.state
        if step % 2:
            tip = np.array([state.tip[2], state.tip[0]])
            worst = max(worst, np.linalg.norm(tip - inextensible(step)))
    record(
        "Tips under a follower load up to q L^3 / EI = 25, n = 40 [lengths]",
        "inextensible rod, by shooting",
        worst,
        at_most=5e-3,
    )


@pytest.mark.slow
def test_the_load_turns_with_the_rod():
    rod, _ = random_rod(2, 5)
    state = deformed(rod, 1)
    load = jaxrod.uniform_load((1.0, -2.0, 3.0), (0.1, 0.2, -0.3), follower=True)
    turn = rotation_exp(tuple(jnp.asarray(c) for c in (0.4, -0.9, 0.3)))
    frames = multiply_quaternions(turn, split_quaternion(state.orientations))
    turned = replace(state, orientations=join_quaternion(frames))
    loads = jax.jit(lambda at: load.loads(rod, motion_of(at)))
    before, after = loads(state), loads(turned)
    assert difference(after.forces, to_world(directors(turn), before.forces)) < 1e-13
    assert difference(after.couples, before.couples) < 1e-15
    size = np.linalg.norm(vectors.join(before.forces).sum(axis=1))
    assert 0 < size < np.sqrt(14) * float(rod.length)


def test_torsion_free_refuses_what_turns_with_the_elements():
    rod, _ = arm(3)
    load = jaxrod.uniform_load((1.0, 0.0, 0.0), follower=True)
    with pytest.raises(ValueError, match="follower=True"):
        jaxrod.make_scene(rod, load, method=jaxrod.torsion_free())
