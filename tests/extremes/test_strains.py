"""Strains far beyond what rods are made for: bounded, or flagged, never silent."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm, no_moves, turn
from physics.small_motions import unbalance

SHEAR_CORRECTION = 27 / 28
THRESHOLD = 1 / (1 - SHEAR_CORRECTION / 3)  # For G = E/3.


def stretched(state, stretch):
    return replace(state, positions=stretch * state.positions)


def softest(scene, state):
    """The smallest stiffness of a rod whose two end nodes are held."""
    stiffness = np.asarray(unbalance(scene, state)[1])
    nodes, elements = (np.ones(moves.shape, bool) for moves in no_moves(state))
    nodes[:, [0, -1]] = False
    free = np.concatenate([nodes.ravel(), elements.ravel()])
    # Twist about the axis costs nothing and is no instability.
    elements[2] = False
    free = np.concatenate([nodes.ravel(), elements.ravel()])
    matrix = stiffness[np.ix_(free, free)]
    return np.linalg.eigvalsh((matrix + matrix.T) / 2)[0]


@pytest.mark.slow
def test_the_stretch_at_which_directors_tip_over(record):
    rod, state = arm(4, radius=0.002)
    scene = jaxrod.make_scene(rod)
    low, high = 1.2, 1.8
    assert softest(scene, stretched(state, low)) > 0
    assert softest(scene, stretched(state, high)) < 0
    while high - low > 1e-5:
        middle = (low + high) / 2
        stable = softest(scene, stretched(state, middle)) > 0
        low, high = (middle, high) if stable else (low, middle)
    record(
        "Stretch at which a straight rod becomes unstable, relative error",
        f"1/(1 - alpha_c G/E) = {THRESHOLD:.3f}",
        abs(low / THRESHOLD - 1),
        at_most=0.01,
    )


@pytest.mark.parametrize(("share", "tips"), [(0.98, False), (1.02, True)])
def test_below_that_stretch_a_held_rod_stays_straight_and_above_it_does_not(
    share, tips
):
    rod, state = arm(5, radius=0.01)
    taut = stretched(state, share * THRESHOLD)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(taut), jaxrod.clamp(taut, end="tip"))
    noise = 1e-8 * jax.random.normal(jax.random.key(0), (3, 5))
    disturbed = replace(taut, orientations=turn(taut.orientations, noise))
    dt = jaxrod.stable_dt(scene).dt
    after = jaxrod.advance(scene, disturbed, dt, 40_000)
    tilt = jnp.max(jnp.abs(after.directors[2, :2]))
    assert jnp.all(jnp.isfinite(after.positions))
    assert (tilt > 0.1) == tips
    assert tips or tilt < 1e-5


@jax.jit
def energies_of(scene, state, dt):
    """Total energy now, and 100 times more, 50 steps apart [J]."""

    def block(s, _):
        after = jaxrod.advance(scene, s, dt, jnp.asarray(50))
        return after, scene.total_energy(after)

    _, later = jax.lax.scan(block, state, length=100)
    return scene.total_energy(state), later


@pytest.mark.slow
def test_a_rod_let_go_at_a_twentieth_of_its_length(record):
    """The stored energy is finite at any compression: it comes back and no more."""
    rod, state = arm(5, dtype=jnp.float32)
    scene = jaxrod.make_scene(rod)
    short = stretched(state, 0.05)
    dt = jaxrod.stable_dt(scene, 0.5).dt
    assert jaxrod.health(scene, short, dt).stretch
    before, energies = energies_of(scene, short, dt)
    record(
        "Energy of a rod released at 0.05 of its length, largest change, float32",
        "stored at the start",
        np.max(np.abs(energies / before - 1)),
        at_most=0.1,
    )


def test_pyelasticas_law_compressed_to_a_twentieth_at_a_step_as_much_shorter():
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod, method=jaxrod.pyelastica())
    short = stretched(state, 0.05)
    dt = 0.2 * 0.05 * jaxrod.stable_dt(scene).dt
    after = jaxrod.advance(scene, short, dt, 50)
    assert jnp.all(jnp.isfinite(after.positions))


@jax.jit
def examined(scene, state, dt):
    """A state's health, whether it stays finite, and its energy's gradient."""
    after = jaxrod.advance(scene, state, dt, jnp.asarray(300))
    finite = jaxrod.health(scene, after, dt).finite
    gradient = jax.grad(lambda s: scene.total_energy(s))(state)
    finite &= jnp.all(jnp.isfinite(gradient.orientations))
    return jaxrod.health(scene, state, dt), finite


@pytest.mark.fast_sets(3)
@pytest.mark.parametrize("angle", [2.4, 2.6, np.pi - 1e-3, np.pi, 3.6, 6.0])
def test_joints_turned_to_pi_and_beyond(angle):
    """Past pi a rotation is the shorter one the other way; before, it is flagged."""
    dtype = jnp.float32
    rod, state = arm(4, dtype=dtype)
    scene = jaxrod.make_scene(rod)
    rotations = (
        jnp.zeros((3, 4), dtype)
        .at[:, 2:]
        .set(jnp.asarray([[0.6], [0.0], [0.8]], dtype) * angle)
    )
    wound = replace(state, orientations=turn(state.orientations, rotations))
    dt = jaxrod.stable_dt(scene, 0.5).dt
    shorter = min(angle, 2 * np.pi - angle)
    report, finite = examined(scene, wound, dt)
    assert finite
    np.testing.assert_allclose(report.largest_joint_angle, shorter, rtol=1e-5)
    assert report.joint_angle == (shorter > 2.5)


@pytest.mark.slow
def test_a_joint_wound_up_past_pi_is_flagged_and_frozen_before():
    """A couple that no joint holds winds the tip about the axis without end."""
    rod, state = arm(4, dtype=jnp.float32, radius=0.02)
    couple = jnp.zeros((3, 4), jnp.float32).at[2, 3].set(400.0)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.actuation.ElementCouples(couple),
        jaxrod.exponential_damping(100.0),
    )
    dt = jaxrod.stable_dt(scene, 0.5).dt

    def control_step(carry, _):
        rod_state, frozen = carry
        after = jaxrod.advance(scene, rod_state, dt, 5)
        frozen = frozen | jaxrod.health(scene, after, dt).flagged
        return (jaxrod.freeze(frozen, rod_state, after), frozen), None

    start = state, jnp.zeros((), bool)
    (end, frozen), _ = jax.lax.scan(control_step, start, length=1000)
    assert frozen
    angle = jaxrod.health(scene, end, dt).largest_joint_angle
    assert 1.5 < angle <= 2.5
