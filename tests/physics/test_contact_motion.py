"""What becomes of arms that touch: resting, bouncing, sliding, rolling, sticking."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import DENSITY, RADIUS, arm, difference
from physics.touching import (
    DEPTH,
    FRICTION,
    LINE,
    RATE,
    STIFFNESS,
    G,
    contact_loads,
    floor_contact,
    on_the_floor,
    rolled,
)


@pytest.mark.slow
def test_an_arm_that_is_dropped_comes_to_rest_there(record):
    scene, state = on_the_floor()
    above = replace(state, positions=state.positions.at[1].add(0.2 * RADIUS))
    rest, _, _ = rolled(scene, above, jaxrod.stable_dt(scene).dt, 3000)
    depth = -float(jnp.mean(rest.positions[1]))
    record(
        "Penetration of an arm dropped on a plane, at rest",
        "weight / stiffness",
        abs(depth / DEPTH - 1),
        at_most=1e-9,
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("mode", ["consistent", "pyelastica"])
def test_an_arm_rolls_down_a_slope_at_two_thirds_of_free_sliding(mode, record):
    slope = 0.3
    scene, state = on_the_floor(slope, mode=mode)
    dt = 2.5e-4
    early, first, _ = rolled(scene, state, dt, 400)
    _, second, spin = rolled(scene, early, dt, 400)
    acceleration = float(second - first) / (400 * dt) / np.cos(slope)
    record(
        f"Acceleration of an arm rolling down a slope, {mode} mode",
        "(2/3) g sin(slope)",
        abs(acceleration / (2 / 3 * G * np.sin(slope)) - 1),
        at_most=1e-6,
    )
    # Rolling to the right turns clockwise.
    assert spin == pytest.approx(-float(second) / np.cos(slope) / RADIUS, rel=0.03)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("mode", ["consistent", "pyelastica"])
def test_an_arm_that_slides_is_braked_by_friction_until_it_rolls(mode, record):
    scene, state = on_the_floor(mode=mode)
    moving = replace(state, velocities=state.velocities.at[0].set(1.0))
    dt = 2.5e-4
    early, first, _ = rolled(scene, moving, dt, 80)
    late, second, _ = rolled(scene, early, dt, 80)
    braking = float(first - second) / (80 * dt)
    record(
        f"Deceleration of an arm sliding on a plane, {mode} mode",
        "friction g",
        abs(braking / (FRICTION * G) - 1),
        at_most=1e-3,
    )
    _, final, spin = rolled(scene, late, dt, 2000)
    record(
        f"Speed at which it rolls on, {mode} mode",
        "2/3 of the first, by angular momentum",
        abs(float(final) * 3 / 2 - 1),
        at_most=1e-6,
    )
    assert spin == pytest.approx(-float(final) / RADIUS, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("steepness", [0.5, 0.9, 2.0])
def test_an_arm_along_the_slope_sticks_within_the_cone_of_friction(steepness, record):
    """It creeps as stated where the slope is gentle, and slides where it is not."""
    slope, thin = np.arctan(FRICTION * steepness), 0.01
    line = DENSITY * np.pi * thin**2
    down = np.array([0.0, -np.sin(slope), np.cos(slope)])
    normal = np.array([0.0, np.cos(slope), np.sin(slope)])
    depth = 0.05 * thin
    rod, state = jaxrod.straight_rod(
        3,
        length=1.0,
        radius=thin,
        density=DENSITY,
        youngs_modulus=1e7,
        start=(thin - depth) * normal,
        direction=down,
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, -G, 0.0)),
        jaxrod.contact(
            jaxrod.shapes.plane((0.0, 0.0, 0.0), normal),
            stiffness=line * G * np.cos(slope) / depth,
            damping=RATE * line,
            friction=FRICTION,
        ),
    )
    dt, steps = 1.2e-4, 4000 if steepness == 0.9 else 1000
    early, _, _ = rolled(scene, state, dt, steps)
    late, _, _ = rolled(scene, early, dt, steps)
    first, second = (
        float(jnp.dot(rod.momentum(at), jnp.asarray(down))) / line
        for at in (early, late)
    )
    if steepness < 1:
        creep = G * np.sin(slope) / RATE / np.sqrt(1 - steepness**2)
        record(
            f"Creep of a rod that sticks on a slope at {steepness:g} of the friction "
            "cone",
            "load / (drag sqrt(1 - (load / limit)^2))",
            abs(second / creep - 1),
            at_most=2e-3,
        )
    else:
        free = G * (np.sin(slope) - FRICTION * np.cos(slope))
        record(
            "Acceleration of a rod that slides down a slope of twice the friction cone",
            "g (sin(slope) - friction cos(slope))",
            abs((second - first) / (1000 * dt) / free - 1),
            at_most=2e-3,
        )


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_friction_balances_a_load_at_the_speed_of_creep_that_is_stated(share):
    """The load being a share of the largest there is."""
    scene, state = on_the_floor()
    rod, touch = scene.rod, scene.effects[1]
    lengths = rod.node_masses / rod.linear_density[0]
    load = share * FRICTION * contact_loads(touch, rod, state)[0][1] / lengths
    creep = load / touch.friction_drag / np.sqrt(1 - share**2)
    creeping = replace(state, velocities=state.velocities.at[2].set(creep))
    friction = contact_loads(touch, rod, creeping)[0][2] / lengths
    np.testing.assert_allclose(friction, -load, rtol=1e-9)


@jax.jit
def bounced(scene, state, dt):
    """Energies and heights of 400 steps, and how fast an arm leaves."""
    states = jaxrod.rollout(scene, state, dt, 400)
    energies = jax.vmap(lambda at: scene.total_energy(at))(states)
    return energies, states.positions[:, 1, 0], states.velocities[-1, 1, 0]


def bounce(dt, damping=0.0):
    """An arm thrown flat on a plane at 1 m/s, and the way it leaves."""
    rod, state = arm(3)
    thrown = state.velocities.at[1].set(-1.0)
    start = replace(state, velocities=thrown, positions=state.positions.at[1].set(1e-3))
    # The damping is a number of the program, zero or not.
    floor = replace(floor_contact(friction=0.0), damping=jnp.asarray(damping))
    return bounced(jaxrod.make_scene(rod, floor), start, dt)


@pytest.mark.slow
def test_a_bounce_keeps_its_energy_to_second_order(record):
    errors = []
    for dt in (6e-4, 3e-4):
        energies, heights, leaving = bounce(dt)
        errors.append(difference(energies, energies[0]) / float(energies[0]))
    width = 0.01 * RADIUS
    deepest = np.sqrt(LINE / STIFFNESS - width**2 / 12)
    record(
        "Deepest penetration of an arm thrown flat on a plane",
        "sqrt(m v^2 / stiffness), minus the effect of the onset",
        abs(-float(jnp.min(heights)) / deepest - 1),
        at_most=1e-4,
    )
    record(
        "Energy error in a bounce, divided by the error at half the step",
        "4",
        errors[0] / errors[1],
        between=(3.5, 4.5),
    )
    assert leaving == pytest.approx(1.0, abs=1e-4) and errors[1] < 1e-3


def test_a_damped_bounce_loses_energy_all_along():
    energies, _, leaving = bounce(2e-4, 20.0 * LINE)
    assert jnp.all(jnp.diff(energies) <= 1e-6 * energies[0])
    assert 0.1 < leaving < 0.9


def thrown_in_a_plane(plane):
    """An arm along x thrown onto a sloping floor, in space or in a plane."""
    rod, state = arm(3, direction=(1.0, 0.0, 0.0), normal=(0.0, 1.0, 0.0))
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, -G, 0.0)),
        jaxrod.contact(
            jaxrod.shapes.plane((0.0, -0.06, 0.0), (0.2, 1.0, 0.0)),
            stiffness=1e5,
            damping=100.0,
            friction=0.4,
        ),
        method=plane and jaxrod.planar(plane),
    )
    falls = state.velocities.at[1].set(-2.0).at[0].set(0.5)
    return scene, replace(state, velocities=falls)


@pytest.mark.slow
def test_in_a_plane_contact_is_what_it_is_in_space():
    scene, state = thrown_in_a_plane(None)
    dt = jaxrod.stable_dt(scene).dt
    free, _, _ = rolled(scene, state, dt, 200)
    flat, _, _ = rolled(*thrown_in_a_plane("xy"), dt, 200)
    assert jnp.max(jnp.abs(free.velocities - state.velocities)) > 0.5
    assert difference(flat.positions, free.positions) < 1e-11
    assert difference(flat.velocities, free.velocities) < 1e-9


@pytest.mark.slow
def test_a_body_that_pushes_out_of_the_plane_is_refused_in_words():
    scene, state = thrown_in_a_plane("xy")
    tilted = jaxrod.shapes.capsule((0.0, -9.0, -1.0), (0.0, -9.0, 2.0), 0.1)
    for end, fits in (((0.0, -9.0, 2.0), True), ((0.0, -8.0, 2.0), False)):
        tilted = replace(tilted, end=jnp.asarray(end))
        contact = jaxrod.contact(tilted, stiffness=1e5)
        aside = replace(scene, effects=(scene.effects[0], contact))
        if fits:
            aside.method.check_state(aside, state)
            continue
        with pytest.raises(ValueError, match="surfaces of bodies in that plane"):
            aside.method.check_state(aside, state)
