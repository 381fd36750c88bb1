"""Muscles whose force depends on how fast they shorten."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.actuation.muscles import DRAWN_OUT, HYPERBOLA, force_at_speed
from jaxrod.rods.motion import motion_of

N, LENGTH, RADIUS, FORCE, FASTEST = 2, 0.4, 0.02, 3.0, 2.5
ASIDE = 0.5 * RADIUS


def rod_and_muscle(**numbers):
    """A straight rod along z, and a muscle of constant force."""
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e4,
        normal=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )
    numbers = {"fastest": FASTEST, "curve": jaxrod.actuation.constant_force()} | numbers
    return rod, state, jaxrod.actuation.muscle(rod, FORCE, **numbers)


@jax.jit
def loads_of(muscle, rod, motion):
    loads = muscle.loads(rod, motion)
    return jnp.stack(loads.forces), jnp.stack(loads.couples)


def hill(speed):
    """Share of the force at a speed over the largest, as the docstring has it."""
    if speed > 0:
        return max(0.0, (1 - speed) / (1 + speed / HYPERBOLA))
    slow = (DRAWN_OUT - 1) * HYPERBOLA / (1 + HYPERBOLA)
    return 1 + (DRAWN_OUT - 1) * -speed / (slow - speed)


def test_the_curve_meets_itself_with_its_slope():
    slope = jax.vmap(jax.grad(force_at_speed))(jnp.asarray([-1e-9, 0.0, 1e-9]))
    np.testing.assert_allclose(slope, -(1 + 1 / HYPERBOLA), rtol=1e-7)
    values = force_at_speed(jnp.asarray([-1e9, 0.0, 1.0, 7.0]))
    np.testing.assert_allclose(values, [DRAWN_OUT, 1.0, 0.0, 0.0], atol=1e-8)


@pytest.mark.parametrize("across", [False, True])
def test_a_rod_that_shortens_evenly_is_pulled_by_the_share_of_its_speed(across, record):
    """Across the rod a fibre lengthens half as fast as the rod shortens."""
    rod, state, muscle = rod_and_muscle(across=across)
    s = np.linspace(0, LENGTH, N + 1)
    worst = 0.0
    for speed in (-2.0, -0.3, 0.0, 0.4, 0.9, 1.3):
        moving = state.velocities.at[2].set(-speed * FASTEST * s)
        forces, _ = loads_of(muscle, rod, motion_of(replace(state, velocities=moving)))
        if across:
            expected = -FORCE * hill(-speed / 2)
        else:
            expected = FORCE * hill(speed)
        ends = np.array([expected, -expected])
        worst = max(worst, np.max(np.abs(forces[2, [0, -1]] - ends)) / FORCE)
        assert abs(forces[2, 1]) < 1e-12
    record(
        f"Tension of a muscle {'across' if across else 'along'} a rod that shortens",
        "Hill's hyperbola",
        worst,
        at_most=1e-12,
    )


def test_a_rod_that_bends_is_bent_by_the_share_at_its_joint():
    """By one side's muscle, which shortens as both elements turn towards it."""
    rod, state, muscle = rod_and_muscle(offsets=(ASIDE, 0.0))
    turning = 0.3 * FASTEST * (LENGTH / N) / ASIDE
    spins = np.zeros((3, N))
    # About d2 (across the plane of d3 and d1), apart by what shortens the fibre.
    spins[1] = -0.5 * turning, 0.5 * turning
    still, both = (
        motion_of(jaxrod.with_angular_velocities(rod, state, way * spins))
        for way in (0.0, 1.0)
    )
    _, at_rest = loads_of(muscle, rod, still)
    assert abs(at_rest[1, 1]) > 0.1 * FORCE * ASIDE
    # Ends do not shorten: of the couple only the joint's part is another.
    _, slower = loads_of(muscle, rod, both)
    _, faster = loads_of(
        muscle, rod, motion_of(jaxrod.with_angular_velocities(rod, state, -spins))
    )
    shares = sorted(float(x[1, 1] / at_rest[1, 1]) for x in (slower, faster))
    np.testing.assert_allclose(shares, [hill(0.3), hill(-0.3)], rtol=1e-12)


def test_rigid_motion_does_not_matter_and_motion_takes_energy():
    rod, state, muscle = rod_and_muscle(offsets=(ASIDE, 0.0))
    isometric = replace(muscle, fastest=None)
    turning = np.array([1.0, -2.0, 0.7])
    round_it = np.cross(turning, np.asarray(state.positions).T).T + 3.0
    # The frames are d1, d2, d3: rows of directors.
    local = np.einsum("ijk,j->ik", np.asarray(state.directors), turning)
    moving = replace(state, velocities=jnp.asarray(round_it))
    rigid = motion_of(jaxrod.with_angular_velocities(rod, moving, local))
    for one, other in zip(
        loads_of(muscle, rod, rigid), loads_of(isometric, rod, rigid), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)
    random = np.random.default_rng(0)
    lost = []
    for _ in range(20):
        moving = replace(state, velocities=jnp.asarray(random.normal(size=(3, N + 1))))
        spins = 5 * random.normal(size=(3, N))
        motion = motion_of(jaxrod.with_angular_velocities(rod, moving, spins))
        powers = [
            np.sum(forces * moving.velocities) + np.sum(couples * spins)
            for forces, couples in (
                loads_of(each, rod, motion) for each in (muscle, isometric)
            )
        ]
        lost.append(powers[0] - powers[1])
    assert max(lost) < 0 and min(lost) < -0.1


@pytest.mark.slow
def test_steps_know_how_steeply_force_falls_with_speed():
    """As a dashpot it alone limits the step here."""
    rod, state, muscle = rod_and_muscle(fastest=1e-3)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), muscle)
    free = jaxrod.make_scene(rod, jaxrod.clamp(state), replace(muscle, fastest=None))
    dt = float(jaxrod.stable_dt(scene, 1.0).dt)
    assert dt < 0.1 * float(jaxrod.stable_dt(free, 1.0).dt)

    # Where nothing shortens the curve is steepest.
    rest = jaxrod.equilibrium(free, state).state
    kicked = replace(rest, velocities=rest.velocities.at[2, 1:].set(1e-8))

    def jump(dt):
        """By how much velocities change in a step, after many, over the fastest."""
        before = jaxrod.advance(scene, kicked, dt, jnp.asarray(400))
        after = jaxrod.advance(scene, before, dt, jnp.asarray(1))
        change = jnp.max(jnp.abs(after.velocities - before.velocities))
        return float(change) / (1e-3 * LENGTH)

    # What swings up is held by the curve, which is flat at large speeds.
    with pytest.warns(jaxrod.UnstableStepWarning):
        assert jump(4 * dt) > 0.01
    assert jump(0.8 * dt) < 1e-4


def test_the_largest_speed_is_positive():
    with pytest.raises(ValueError, match="fastest must be positive"):
        rod_and_muscle(fastest=0.0)
