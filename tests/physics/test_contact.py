"""Contact and friction against closed forms: resting, bouncing, sliding, rolling."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import vectors
from jaxrod.motion import motion_of
from jaxrod.scene import external_loads
from physics.rods import (
    AREA,
    DENSITY,
    RADIUS,
    arm,
    deformed,
    difference,
    no_moves,
    perturb,
    random_rod,
)
from physics.shapes import BODIES, rotated, turned

G = 9.81
LINE = DENSITY * AREA  # mass per length [kg/m]
DEPTH = 0.05 * RADIUS  # at which the arm rests on a floor [m]
STIFFNESS = LINE * G / DEPTH
RATE = 200.0  # of damping and of friction's drag [1/s]
FRICTION = 0.3


def floor_contact(slope=0.0, friction=FRICTION, **changes):
    """A plane that touches an arm along z, and rises along -x by an angle [rad]."""
    normal = np.array([np.sin(slope), np.cos(slope), 0.0])
    numbers = {
        "stiffness": STIFFNESS,
        "damping": RATE * LINE,
        "friction": friction,
    }
    body = jaxrod.plane(-RADIUS * normal, normal)
    return jaxrod.contact(body, **numbers | changes)


def on_the_floor(slope=0.0, n=3, mode="consistent", **changes):
    """An arm in equilibrium with a floor, but for what draws it down the slope."""
    rod, state = arm(n)
    sunk = -DEPTH * np.cos(slope) * np.array([np.sin(slope), np.cos(slope), 0.0])
    state = replace(state, positions=state.positions + jnp.asarray(sunk)[:, None])
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, -G, 0.0)),
        floor_contact(slope, **changes),
        mode=mode,
    )
    return scene, state


@jax.jit
def contact_loads(contact, rod, state):
    """Forces on nodes and couples on elements, world frame for both [N, N m]."""
    motion = motion_of(state)
    zero = jax.tree.map(jnp.zeros_like, (motion.velocity, motion.spin))
    loads = external_loads(jaxrod.Scene(rod, (contact,)), motion, *zero)
    frame = jaxrod.rotations.directors(motion.orientation)
    couples = jaxrod.rotations.to_world(frame, loads.couples)
    return vectors.join(loads.forces), vectors.join(couples)


@pytest.mark.parametrize("per_element", [1, 3])
def test_a_weight_rests_at_the_penetration_weight_over_stiffness(per_element):
    rod, state = random_rod(2, 6)
    rod = replace(rod, radii=jnp.full_like(rod.radii, RADIUS))
    straight = replace(state, positions=state.positions.at[1].set(-DEPTH))
    floor = floor_contact(points_per_element=per_element)
    forces, _ = contact_loads(floor, rod, straight)
    lengths = 0.5 * rod.rest_lengths
    lengths = jnp.pad(lengths, (0, 1)) + jnp.pad(lengths, (1, 0))
    assert difference(forces[1], LINE * G * lengths) < 1e-12 * LINE * G
    assert difference(forces[::2], jnp.zeros_like(forces[::2])) == 0


def test_an_arm_that_is_dropped_comes_to_rest_there(record):
    scene, state = on_the_floor()
    above = replace(state, positions=state.positions.at[1].add(0.2 * RADIUS))
    rest = jaxrod.advance(scene, above, jaxrod.stable_dt(scene).dt, 3000)
    depth = -float(jnp.mean(rest.positions[1]))
    record(
        "Penetration of an arm dropped on a plane, at rest",
        "weight / stiffness",
        abs(depth / DEPTH - 1),
        at_most=1e-9,
    )


@pytest.mark.parametrize("name", BODIES)
def test_forces_are_minus_the_gradient_of_the_energy(name):
    rod, _ = random_rod(4, 6, length=0.6)
    state = deformed(rod, 1, speed=0.0)
    contact = jaxrod.contact(
        BODIES[name](), stiffness=1e5, onset=0.5, points_per_element=2
    )

    @jax.jit
    def both(contact, rod, state):
        gradient = jax.grad(lambda moves: contact.energy(rod, perturb(state, moves)))
        loads = contact.loads(rod, motion_of(state))
        return gradient(no_moves(state)), loads

    (by_nodes, by_elements), loads = both(contact, rod, state)
    forces = vectors.join(loads.forces)
    assert loads.couples is None and difference(by_elements, 0 * by_elements) == 0
    assert jnp.max(jnp.abs(forces)) > 1
    assert difference(-by_nodes, forces) < 1e-10 * jnp.max(jnp.abs(forces))


def test_a_dashpot_never_pulls_and_is_no_stiffer_than_stated():
    contact = floor_contact()
    width = jnp.asarray(0.01 * RADIUS)
    depths = jnp.linspace(-1, 3, 161) * width
    speeds = jnp.asarray([0.0, 1e-3, 0.1, 10.0])

    def force(depth, speed):
        return contact._normal_force(depth, speed, width)

    def everywhere(function, speeds):
        return jax.vmap(jax.vmap(function, (0, None)), (None, 0))(depths, speeds)

    push = everywhere(force, jnp.concatenate([speeds, -speeds]))
    assert jnp.all(push >= 0) and jnp.all(push[:, depths < -0.5 * width] == 0)
    stiffness = everywhere(jax.grad(force), speeds)
    assert jnp.all(stiffness >= 0)
    assert jnp.max(stiffness) <= STIFFNESS * (1 + 1e-12)
    drag = -everywhere(jax.grad(force, argnums=1), jnp.concatenate([speeds, -speeds]))
    assert jnp.all(drag >= 0)
    assert jnp.max(drag) == pytest.approx(RATE * LINE)


@jax.jit
def rolled(scene, state, dt, n_steps):
    """Mean velocity along x and spin about z of an arm, later."""
    after = jaxrod.advance(scene, state, dt, n_steps)
    spin = jaxrod.angular_velocities(scene.rod, after)[2]
    return after, jnp.mean(after.velocities[0]), jnp.mean(spin)


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


@pytest.mark.parametrize("steepness", [0.5, 2.0])
def test_an_arm_along_the_slope_sticks_within_the_cone_of_friction(steepness, record):
    """It creeps as stated where the slope is gentle, and slides where it is not."""
    slope, thin = np.arctan(FRICTION * steepness), 0.01
    line = DENSITY * np.pi * thin**2
    down = np.array([0.0, -np.sin(slope), np.cos(slope)])
    normal = np.array([0.0, np.cos(slope), np.sin(slope)])
    depth = 0.05 * thin
    rod, state = jaxrod.straight_rod(
        4,
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
            jaxrod.plane((0.0, 0.0, 0.0), normal),
            stiffness=line * G * np.cos(slope) / depth,
            damping=RATE * line,
            friction=FRICTION,
        ),
    )
    dt = 1.2e-4
    early = jaxrod.advance(scene, state, dt, 1000)
    late = jaxrod.advance(scene, early, dt, 1000)
    first, second = (
        float(jnp.dot(jaxrod.momentum(rod, at), jnp.asarray(down))) / line
        for at in (early, late)
    )
    if steepness < 1:
        creep = G * np.sin(slope) / RATE / np.sqrt(1 - steepness**2)
        record(
            "Creep of a rod that sticks on a slope at half its friction's cone",
            "load / (drag sqrt(1 - (load / limit)^2))",
            abs(second / creep - 1),
            at_most=2e-3,
        )
    else:
        free = G * (np.sin(slope) - FRICTION * np.cos(slope))
        record(
            "Acceleration of a rod that slides down a slope of twice its cone",
            "g (sin(slope) - friction cos(slope))",
            abs((second - first) / (1000 * dt) / free - 1),
            at_most=2e-3,
        )


def bounce(dt, n_steps, **damping):
    """Energies and heights of an arm thrown flat on a plane, and the way it leaves."""
    rod, state = arm(3)
    thrown = state.velocities.at[1].set(-1.0)
    start = replace(state, velocities=thrown, positions=state.positions.at[1].set(1e-3))
    scene = jaxrod.make_scene(rod, floor_contact(friction=0.0, **damping))
    states = jaxrod.rollout(scene, start, dt, n_steps)
    energies = jax.vmap(lambda at: jaxrod.total_energy(scene, at))(states)
    return energies, states.positions[:, 1, 0], states.velocities[-1, 1, 0]


def test_a_bounce_keeps_its_energy_to_second_order(record):
    errors = []
    for n_steps in (400, 800):
        energies, heights, leaving = bounce(0.25 / n_steps, n_steps, damping=0.0)
        errors.append(difference(energies, energies[0]) / float(energies[0]))
    width = 0.01 * RADIUS
    deepest = np.sqrt(LINE / STIFFNESS - width**2 / 12)
    record(
        "Deepest penetration of an arm thrown flat on a plane",
        "sqrt(m v^2 / stiffness), less what the onset takes",
        abs(-float(jnp.min(heights)) / deepest - 1),
        at_most=1e-4,
    )
    record(
        "Energy error in a bounce over that at half the step",
        "4",
        errors[0] / errors[1],
        between=(3.5, 4.5),
    )
    assert leaving == pytest.approx(1.0, abs=1e-4) and errors[1] < 1e-3


def test_a_damped_bounce_loses_energy_all_along():
    energies, _, leaving = bounce(2e-4, 1250, damping=20.0 * LINE)
    assert jnp.all(jnp.diff(energies) <= 1e-6 * energies[0])
    assert 0.1 < leaving < 0.9


def moving_arm(seed=0, speed=0.5):
    """A random rod in the way of every body, moving and turning."""
    rod, _ = random_rod(4, 6, length=0.6)
    return rod, deformed(rod, seed, speed=speed)


def rubbing(body, **changes):
    numbers = {"stiffness": 1e5, "damping": 10.0, "friction": 0.5, "onset": 0.5}
    return jaxrod.contact(body, **numbers | changes)


@pytest.mark.parametrize("name", ["capsule", "box"])
def test_loads_turn_with_rod_and_body(name, record):
    rotation, shift = jnp.asarray([0.3, -1.2, 0.7]), jnp.asarray([1.0, -2.0, 0.5])
    rod, state = moving_arm()
    body = BODIES[name]()
    there = replace(
        state,
        positions=rotated(rotation, state.positions) + shift[:, None],
        orientations=turned_orientations(rotation, state.orientations),
        velocities=rotated(rotation, state.velocities),
        angular_momenta=rotated(rotation, state.angular_momenta),
    )
    here = contact_loads(rubbing(body), rod, state)
    moved = contact_loads(rubbing(turned(body, rotation, shift)), rod, there)
    worst = 0.0
    for a, b in zip(here, moved, strict=True):
        assert jnp.max(jnp.abs(a)) > 1e-3
        worst = max(worst, difference(rotated(rotation, a), b) / jnp.max(jnp.abs(a)))
    record(
        f"Loads of contact and friction with a {name}, rod and body turned",
        "turned loads",
        worst,
        at_most=1e-11,
    )


def turned_orientations(rotation, orientations):
    quaternion = jaxrod.rotations.rotation_exp(tuple(c[None] for c in rotation))
    both = jaxrod.rotations.multiply_quaternions(quaternion, tuple(orientations))
    return jnp.stack(both)


def test_friction_takes_energy_and_neither_force_nor_moment_from_nowhere():
    """About any point: its couples are those of forces at the surface."""
    rod, state = moving_arm()
    body = jaxrod.sphere((0.1, -0.02, 0.05), 0.2)
    contact = rubbing(body, damping=0.0, friction_drag=10.0)
    forces, couples = contact_loads(contact, rod, state)
    normal, _ = contact_loads(
        replace(contact, friction=contact.friction * 1e-9), rod, state
    )
    # On a fixed sphere only friction has a moment about the centre. Its forces act
    # where the sections end, a section's radius from the nodes.
    rub = forces - normal
    _, outward = body.surface(vectors.split(state.positions))
    radii = np.convolve(rod.radii * rod.rest_lengths, [1, 1])
    radii = radii / np.convolve(rod.rest_lengths, [1, 1])
    where = state.positions - radii[None] * vectors.join(outward)
    moment = jnp.sum(jnp.cross(where.T, rub.T), axis=0)
    found = jnp.sum(jnp.cross(state.positions.T, rub.T), axis=0) + jnp.sum(couples, 1)
    assert difference(moment, found) < 1e-6 * jnp.max(jnp.abs(found))
    spins = jaxrod.angular_velocities(rod, state)
    frame = jaxrod.rotations.directors(tuple(state.orientations))
    spins = vectors.join(jaxrod.rotations.to_world(frame, vectors.split(spins)))
    power = jnp.sum(rub * state.velocities) + jnp.sum(couples * spins)
    assert power < -1e-3
