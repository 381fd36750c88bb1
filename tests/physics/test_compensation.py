"""Compensated positions: float32 whose rounding does not add up."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.methods.laws import IN_SPACE
from physics.rods import AREA, YOUNG, arm


def swing(dtype, remember, damping, plane):
    """Tip [m] and axial force [N] of the arm swinging 2 s under its weight."""
    rod, state = arm(20, dtype, direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    effects = [jaxrod.clamp(state), jaxrod.gravity((0.0, -9.81, 0.0))]
    if damping:
        effects.append(jaxrod.exponential_damping(damping))
    scene = jaxrod.make_scene(rod, *effects, method=plane and jaxrod.planar(plane))
    if remember:
        state = jaxrod.compensated(state)
    states = jaxrod.rollout(scene, state, 2e-4, 10_000, 50)
    exact = np.asarray(states.positions, np.float64)
    if remember:
        exact -= np.asarray(states.remainders, np.float64)
    d3 = np.asarray(jax.vmap(lambda s: s.directors)(states), np.float64)[:, 2]
    stretch = np.sum(np.diff(exact, axis=2) * d3, axis=1) * 20
    return np.asarray(states.tip, np.float64), YOUNG * AREA * (stretch - 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damping", "plane"),
    [
        pytest.param(0.0, None, marks=pytest.mark.slow),
        pytest.param(5.0, None, marks=pytest.mark.slow),
        (0.0, "xy"),
    ],
)
def test_float32_agrees_with_float64(damping, plane, record):
    tip, force = swing(jnp.float64, False, damping, None)
    _, plain_force = swing(jnp.float32, False, damping, plane)
    kept_tip, kept_force = swing(jnp.float32, True, damping, plane)
    rms = lambda x: float(np.sqrt(np.mean(x**2)))
    noise = rms(kept_force - force)
    assert noise < 0.3 * rms(plain_force - force)
    what = f"compensated float32, damping {damping:g} 1/s, {plane or 'in space'}"
    record(
        f"Tip of the arm swinging 2 s, {what} [m]",
        "float64",
        float(np.max(np.abs(kept_tip - tip))),
        at_most=1e-6,
    )
    record(
        f"Noise of the axial force, {what} [N rms]",
        f"float64; {rms(plain_force - force):.2g} without compensation",
        noise,
        at_most=0.2,
    )


@pytest.mark.slow
def test_displacements_below_rounding_add_up():
    """Without compensation a node at 1 m moving at 1e-5 m/s never moves."""
    rod, state = arm(3, jnp.float32, youngs_modulus=10.0)
    state = replace(state, velocities=jnp.full((3, 4), 1e-5, jnp.float32))
    scene = jaxrod.make_scene(rod)
    still = jaxrod.advance(scene, state, 1e-4, 1000)
    assert still.tip[2] == state.tip[2]
    moved = jaxrod.advance(scene, jaxrod.compensated(state), 1e-4, 1000)
    exact = np.float64(moved.tip[2]) - np.float64(moved.remainders[2, -1])
    assert exact - np.float64(state.tip[2]) == pytest.approx(1e-6, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["consistent", "pyelastica"])
def test_in_float64_it_changes_nothing_but_round_off(mode):
    rod, state = arm(6)
    wall = jaxrod.clamp(state) if mode == "consistent" else jaxrod.fixed_end(state)
    scene = jaxrod.make_scene(rod, wall, jaxrod.gravity(), method=IN_SPACE[mode])
    state = replace(state, velocities=state.velocities.at[0].set(0.5))
    plain = jaxrod.advance(scene, state, 2e-4, 500)
    kept = jaxrod.advance(scene, jaxrod.compensated(state), 2e-4, 500)
    np.testing.assert_allclose(kept.positions, plain.positions, atol=1e-13)
    assert plain.remainders is None
    assert float(jnp.max(jnp.abs(kept.remainders))) < 1e-15


def test_spinning_up_keeps_the_remainders():
    rod, state = arm(3)
    kept = jaxrod.compensated(state)
    spun = jaxrod.with_angular_velocities(rod, kept, jnp.ones((3, 3)))
    assert spun.remainders is kept.remainders
