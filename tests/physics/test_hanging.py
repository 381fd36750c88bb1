"""Ropes that hang: the catenary, and how a chain swings."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import jn_zeros

import jaxrod

G, LENGTH, RADIUS = 9.81, 1.0, 1e-3
GRAVITY = jaxrod.gravity((0.0, 0.0, -G))


def rope(n, direction=(1.0, 0.0, 0.0), radius=RADIUS):
    return jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=radius,
        density=1000.0,
        youngs_modulus=1e7,
        direction=direction,
        dtype=jnp.float64,
    )


@pytest.mark.slow
def test_a_rope_between_pins_is_a_catenary(record):
    r"""An elastic one without bending stiffness, by Irvine (Cable structures, 1981).

    Of the material coordinate s, with the pull H to the side and V = w (s - L/2):
    x' = H/EA + H/T, z' = V/EA + V/T, T^2 = H^2 + V^2.
    """
    n, span = 40, 0.8
    rod, _ = rope(n)
    weight = float(rod.linear_density[0]) * G
    stretch = float(rod.shear_stretch_stiffness[2, 0])

    def place(pull, s):
        lift, start = weight * (s - LENGTH / 2), -weight * LENGTH / 2
        x = np.arcsinh(lift / pull) - np.arcsinh(start / pull)
        z = np.hypot(1, lift / pull) - np.hypot(1, start / pull)
        return np.stack(
            [
                pull * s / stretch + pull / weight * x,
                s / stretch * (start + weight * s / 2) + pull / weight * z,
            ]
        )

    pull = brentq(
        lambda h: place(h, LENGTH)[0] - span, 0.05 * weight, 5 * weight, xtol=1e-14
    )
    x, z = place(pull, np.linspace(0, LENGTH, n + 1))
    # From a parabola as long: the solution is not told.
    parabola = lambda sag: 4 * sag * x * (x - span) / span**2
    length = lambda sag: np.sum(np.hypot(np.diff(x), np.diff(parabola(sag))))
    sag = brentq(lambda sag: length(sag) - LENGTH, 0.01, 1.0)
    guess = np.stack([x, 0 * x, parabola(sag)])
    _, state = jaxrod.rod_along(
        guess, radius=RADIUS, density=1000.0, youngs_modulus=1e7, dtype=jnp.float64
    )
    scene = jaxrod.make_scene(
        rod, jaxrod.pin_support(state), jaxrod.pin_support(state, "tip"), GRAVITY
    )
    found = jaxrod.equilibrium(scene, state)
    assert found.converged
    nodes = np.asarray(found.state.positions)
    assert np.min(nodes[2]) < -0.25
    assert np.max(np.abs(guess[2] - z)) > 5e-3
    record(
        "rope on two pins, n = 40: nodes [lengths]",
        "elastic catenary",
        np.max(np.hypot(nodes[0] - x, nodes[2] - z)) / LENGTH,
        at_most=1e-3,
    )


@pytest.mark.slow
def test_a_hanging_chain_swings_by_bessel(record):
    """Daniel Bernoulli's chain: half the zeros of J0 times sqrt(g / L)."""
    # So thin that it hardly bends, and so stiff that its weight hardly stretches it.
    rod, state = rope(72, (0.0, 0.0, -1.0), radius=1e-4)
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state), GRAVITY)
    found = jaxrod.equilibrium(scene, state)
    assert found.converged
    frequencies = np.asarray(jaxrod.natural_frequencies(scene, found.state, n_modes=7))
    # It may spin about itself, and swings in two planes.
    spin, swings = frequencies[0], frequencies[1:].reshape(3, 2)
    assert spin < 0.1 * swings[0, 0]
    expected = jn_zeros(0, 3) / 2 * np.sqrt(G / float(-found.state.tip[2]))
    for k in range(3):
        record(
            f"hanging chain, n = 72: frequency {k + 1}",
            "half a zero of J0, times sqrt(g / L)",
            np.max(np.abs(swings[k] / expected[k] - 1)),
            at_most=3e-3,
        )


@pytest.mark.slow
def test_where_a_rod_rests_is_no_matter_of_its_damping(record):
    """Nor of how it was bent when it began; and its support carries its weight once."""
    rod, state = jaxrod.straight_rod(
        8,
        length=0.5,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )
    clamp = jaxrod.clamp(state)
    losses = (
        jaxrod.exponential_damping(3.0),
        jaxrod.internal_damping(1e-2),
        jaxrod.short_wave_damping(50.0),
        jaxrod.fluids.stokes_drag(0.3, 0.6),
        jaxrod.fluids.quadratic_drag(1000.0),
    )
    bare = jaxrod.make_scene(rod, clamp, GRAVITY)
    expected = jaxrod.equilibrium(bare, state)
    assert expected.converged and expected.state.tip[2] < -0.05
    for loss in losses:
        scene = jaxrod.make_scene(rod, clamp, GRAVITY, loss)
        dt = jaxrod.stable_dt(scene, 0.5).dt
        after = jaxrod.advance(scene, expected.state, dt, 20)
        record(
            f"rod at rest after 20 steps with {type(loss).__name__} [lengths]",
            "equilibrium without it",
            np.max(np.abs(after.positions - expected.state.positions)) / 0.5,
            at_most=1e-10,
        )
    support = jaxrod.reactions(bare, expected.state)
    record(
        "force of a clamp on a rod that hangs from it",
        "its weight, once",
        abs(float(support[0].force[2]) / (float(jnp.sum(rod.node_masses)) * G) - 1),
        at_most=1e-10,
    )
    unloaded = jaxrod.equilibrium(jaxrod.make_scene(rod, clamp), expected.state)
    assert unloaded.converged
    record(
        "rod released from a bend: where it comes to rest [lengths]",
        "straight, as it was made",
        np.max(np.abs(unloaded.state.positions - state.positions)) / 0.5,
        at_most=1e-10,
    )
