"""Plastic bending: moments, the set that is left, and its loss."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.bending import moments_along, straight

LIMIT = 0.5


def yields(rod, hardening=0.2, limit=LIMIT, into=None):
    return jaxrod.materials.plastic_bending(
        rod, yield_moment=limit, hardening=hardening, into=into
    )


def followed(rod, state, curvatures, hardening, about=(0.0, 1.0)):
    """Whole moments `(steps, 2)`, and the sets after each step `(steps, 2)`."""
    path = np.asarray(curvatures)[:, None] * np.asarray(about)[None, :]
    added, after = moments_along(yields(rod, hardening), rod, state, jnp.asarray(path))
    elastic = path * float(rod.bend_twist_stiffness[0, 0])
    return np.asarray(added) + elastic, np.asarray(after.set)[:, :2, 1]


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("hardening", [0.0, 0.2])
def test_a_single_bend_has_the_closed_form(hardening, record):
    """The moment while it bends, and the set when the moment is zero again."""
    rod, state = straight(3)
    stiffness = float(rod.bend_twist_stiffness[0, 0])
    first = LIMIT / stiffness
    curvatures = np.linspace(0, 4 * first, 9)
    moments, _ = followed(rod, state, curvatures, hardening)
    beyond = np.maximum(curvatures - first, 0)
    exact = np.minimum(stiffness * curvatures, LIMIT) + hardening * stiffness * beyond
    error = np.max(np.abs(moments[:, 1] - exact)) / LIMIT
    record(f"Moment of a bend, hardening {hardening:g}", "m_y + h B (k - k_y)", error,
           at_most=1e-9)  # fmt: skip
    left = (1 - hardening) * 3 * first
    back, kept = followed(rod, state, [*curvatures, left], hardening)
    error = max(abs(back[-1, 1]) / LIMIT, abs(kept[-1, 1] / left - 1))
    record(
        f"Permanent curvature after a bend, hardening {hardening:g}",
        "(1 - h)(k - k_y)",
        error,
        at_most=1e-9,
    )


def test_the_size_of_steps_does_not_matter():
    rod, state = straight(3)
    first = LIMIT / float(rod.bend_twist_stiffness[0, 0])
    turns = first * np.array([0.0, 3.0, -2.0, 1.5, 4.0])
    coarse, _ = followed(rod, state, turns, 0.3)
    fine = np.concatenate([np.linspace(a, b, 17)[:-1] for a, b in pairwise(turns)])
    slowly, _ = followed(rod, state, [*fine, turns[-1]], 0.3)
    np.testing.assert_allclose(slowly[::16], coarse, atol=1e-12)


def test_hardening_moves_the_limits():
    """Bent beyond the limit, it yields backwards after twice the yield moment."""
    rod, state = straight(3)
    stiffness = float(rod.bend_twist_stiffness[0, 0])
    first = LIMIT / stiffness
    path = np.array([3.0, 1.001, 0.999, 0.0]) * first
    _, sets = followed(rod, state, path, 0.25)
    assert sets[1, 1] == sets[0, 1] and sets[2, 1] < sets[1, 1] > sets[3, 1]


def test_no_direction_is_preferred():
    rod, state = straight(3)
    path = np.array([0.1, 0.4, 0.2, -0.5])
    flat, _ = followed(rod, state, path, 0.1)
    tilted, _ = followed(rod, state, path, 0.1, about=(0.6, -0.8))
    np.testing.assert_allclose(tilted, flat[:, 1:] * [[0.6, -0.8]], atol=1e-12)


@pytest.mark.slow
def test_a_cantilever_keeps_its_set(record):
    """Loaded and unloaded by equilibria: the set of every joint is the closed form."""
    rod, state = straight(4)
    wall, gone = jaxrod.clamp(state), jaxrod.end_load((0.0, 0.0, 0.0))
    law = yields(rod, into=wall)
    couple = jaxrod.end_load(couple=(0.0, 0.8, 0.0))
    bent = jaxrod.equilibrium(jaxrod.make_scene(rod, wall, law, couple), state)
    first = LIMIT / float(rod.bend_twist_stiffness[0, 0])
    curvature = first * (1 + (0.8 - LIMIT) / (0.2 * LIMIT))
    left = jaxrod.equilibrium(jaxrod.make_scene(rod, wall, law, gone), bent.state)
    assert bent.converged and left.converged
    expected = (1 - 0.2) * (curvature - first)
    kept = np.linalg.norm(left.state.memory[1]["set"][:, :-1], axis=0)
    found = np.linalg.norm(jaxrod.strains(rod, left.state)[1], axis=0)
    error = max(np.max(np.abs(part / expected - 1)) for part in (kept, found))
    record(
        "Permanent curvature of a cantilever after a couple",
        "(1 - h)(k - k_y)",
        error,
        at_most=1e-6,
    )


@pytest.mark.slow
def test_energy_lost_is_that_of_yielding(record):
    rod, state = straight(3)
    wall = jaxrod.clamp(state)
    law = yields(rod, into=wall)
    scene = jaxrod.make_scene(rod, wall, law)
    kick = jnp.asarray([[0.0, 0.3, 0.5]]).T * jnp.linspace(0, 1, 4)[None, :] ** 2
    begun = jaxrod.with_memory(scene, replace(state, velocities=kick))
    dt = 0.4 * jaxrod.stable_dt(scene).dt
    states = jaxrod.rollout(scene, begun, dt, 2000, 1)
    totals = jax.jit(jax.vmap(scene.total_energy))(states)
    path = np.linalg.norm(np.diff(states.memory[1]["set"], axis=0), axis=1)
    lengths = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])[None, :]
    loss = LIMIT * np.sum(path * lengths)
    assert loss > 0.3 * totals[0]
    error = abs(totals[0] - totals[-1] - loss) / loss
    record(
        "Energy lost, compared with the work of yielding",
        "m_y dp along the path",
        error,
        at_most=0.01,
    )


def test_sections_must_be_round():
    rod, _ = jaxrod.straight_rod(
        3,
        length=1.0,
        section=jaxrod.rectangle(0.02, 0.01),
        density=1000.0,
        youngs_modulus=1e6,
    )
    with pytest.raises(ValueError, match="plastic_bending needs round sections"):
        jaxrod.make_scene(rod, yields(rod))
