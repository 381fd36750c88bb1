"""From gel to steel, from beads to threads, from two elements to a thousand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.effects.loads import ExponentialDamping
from physics.rods import arm

TOLERANCE = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}


@jax.jit
def swing(modulus, dtype_like):
    """A clamped rod under loads that scale with its modulus, in its own time unit."""
    dtype = dtype_like.dtype
    rod, state = arm(8, dtype=dtype, youngs_modulus=1.0)
    stiffer = {
        name: modulus * getattr(rod, name)
        for name in ("shear_stretch_stiffness", "bend_twist_stiffness")
    }
    rod = jaxrod.Rod(**vars(rod) | stiffer)
    rate = jnp.sqrt(modulus)  # Frequencies grow as the root of the modulus.
    load = jaxrod.EndLoad(
        modulus * jnp.asarray([4e-6, 2e-6, 0], dtype),
        modulus * jnp.asarray([0, 2e-6, 4e-6], dtype),
    )
    damping = ExponentialDamping(0.003 * rate, 0.01 * rate)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), load, damping)
    return jaxrod.rollout(scene, state, 1.5 / rate, 800, 80).positions


@pytest.mark.fast_sets(1)
def test_the_same_motion_from_a_hundred_pascal_to_a_hundred_gigapascal(dtype, record):
    zero = jnp.zeros((), dtype)
    reference = swing(jnp.asarray(1e7, dtype), zero)
    assert 0.1 < float(jnp.max(jnp.abs(reference[-1, 0]))) < 1
    worst = 0.0
    for exponent in (2, 4, 9, 11):
        twin = swing(jnp.asarray(10.0**exponent, dtype), zero)
        worst = max(worst, float(jnp.max(jnp.abs(twin - reference))))
    record(
        f"Swing of rods of 1e2 to 1e11 Pa in their own time unit, {dtype} [m]",
        "the rod of 1e7 Pa",
        worst,
        at_most=TOLERANCE[dtype],
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("size", [1e-6, 1e3])
def test_the_same_motion_for_a_micrometre_and_a_kilometre(size, dtype):
    """No absolute tolerance is hidden anywhere: lengths and times scale together."""

    def bend(length):
        rod, state = arm(6, dtype=dtype, length=length, radius=0.05 * length)
        force = 3.0 * length**2
        scene = jaxrod.make_scene(
            rod, jaxrod.clamp(state), jaxrod.end_load((force, 0.5 * force, 0.0))
        )
        dt = 2e-4 * length
        return jaxrod.advance(scene, state, dt, 500).positions / length

    np.testing.assert_allclose(bend(size), bend(1.0), atol=10 * TOLERANCE[dtype])


@jax.jit
def shaken(scene, state, dt, n_steps):
    """How far noise of 1e-6 of the length carries, and the energy's change."""
    noise = jax.random.normal(jax.random.key(0), state.positions.shape, dt.dtype)
    positions = state.positions + 1e-6 * scene.rod.length * noise
    start = jaxrod.RodState(**vars(state) | {"positions": positions})
    end = jaxrod.advance(scene, start, dt, n_steps)
    moved = jnp.max(jnp.abs(end.positions - state.positions)) / scene.rod.length
    return moved, jaxrod.health(scene, end, dt).flagged


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("slenderness", [3, 30, 1000])
@pytest.mark.parametrize("n", [2, 20, pytest.param(100, marks=pytest.mark.slow)])
def test_noise_stays_noise_whatever_the_slenderness(slenderness, n, dtype):
    rod, state = arm(n, dtype=dtype, radius=1 / slenderness)
    scene = jaxrod.make_scene(rod)
    dt = jaxrod.stable_dt(scene).dt
    moved, flagged = shaken(scene, state, dt, jnp.asarray(2000))
    # Node noise is also a little momentum-free stretch: it rings, and no more.
    assert moved < 3e-5
    assert not flagged


@pytest.mark.slow
def test_a_thousand_elements(dtype):
    rod, state = arm(1000, dtype=dtype, radius=1e-3)
    scene = jaxrod.make_scene(rod)
    dt = jaxrod.stable_dt(scene).dt
    moved, flagged = shaken(scene, state, dt, jnp.asarray(20_000))
    assert moved < 1e-3
    assert not flagged
