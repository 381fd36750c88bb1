"""Contact and friction against closed forms: resting, bouncing, sliding, rolling."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxrod
from jaxrod import vectors
from jaxrod.motion import motion_of
from jaxrod.planar import check_planar
from jaxrod.scene import external_loads
from jaxrod.stepping import _advance_compiled
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


def test_forces_are_minus_the_gradient_of_the_energy():
    rod, _ = random_rod(4, 6, length=0.6)
    state = deformed(rod, 1, speed=0.0)
    contact = jaxrod.contact(
        BODIES["sphere"](), stiffness=1e5, onset=0.5, points_per_element=2
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

    @jax.jit
    def everywhere(depths, speeds):
        """The force and its slopes."""
        derived = jax.value_and_grad(force, argnums=(0, 1))
        return jax.vmap(jax.vmap(derived, (0, None)), (None, 0))(depths, speeds)

    push, (stiffness, drag) = everywhere(depths, jnp.append(speeds, -speeds))
    leaving = stiffness[: len(speeds)]
    assert jnp.all(push >= 0) and jnp.all(push[:, depths < -0.5 * width] == 0)
    assert jnp.all(leaving >= 0)
    assert jnp.max(leaving) <= STIFFNESS * (1 + 1e-12)
    assert jnp.all(drag <= 0)
    assert -jnp.min(drag) == pytest.approx(RATE * LINE)


@jax.jit
def rolled(scene, state, dt, n_steps):
    """Mean velocity along x and spin about z of an arm, later."""
    after = jaxrod.advance(scene, state, dt, n_steps)
    spin = jaxrod.angular_velocities(scene.rod, after)[2]
    return after, jnp.mean(after.velocities[0]), jnp.mean(spin)


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


@pytest.mark.slow
@pytest.mark.parametrize("steepness", [0.5, 2.0])
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
            jaxrod.plane((0.0, 0.0, 0.0), normal),
            stiffness=line * G * np.cos(slope) / depth,
            damping=RATE * line,
            friction=FRICTION,
        ),
    )
    dt = 1.2e-4
    early, _, _ = rolled(scene, state, dt, 1000)
    late, _, _ = rolled(scene, early, dt, 1000)
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


@jax.jit
def bounced(scene, state, dt):
    """Energies and heights of 400 steps, and how fast an arm leaves."""
    states = jaxrod.rollout(scene, state, dt, 400)
    energies = jax.vmap(lambda at: jaxrod.total_energy(scene, at))(states)
    return energies, states.positions[:, 1, 0], states.velocities[-1, 1, 0]


def bounce(dt, damping=0.0):
    """An arm thrown flat on a plane at 1 m/s, and the way it leaves."""
    rod, state = arm(3)
    thrown = state.velocities.at[1].set(-1.0)
    start = replace(state, velocities=thrown, positions=state.positions.at[1].set(1e-3))
    # The damping is a number of the program, zero or not.
    floor = replace(floor_contact(friction=0.0), damping=jnp.asarray(damping))
    return bounced(jaxrod.make_scene(rod, floor), start, dt)


def test_a_bounce_keeps_its_energy_to_second_order(record):
    errors = []
    for dt in (6e-4, 3e-4):
        energies, heights, leaving = bounce(dt)
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
    energies, _, leaving = bounce(2e-4, 20.0 * LINE)
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


def struck(n=4, dtype=jnp.float64):
    """An arm that is held at one end and swings onto a sphere, and its scene."""
    rod, state = arm(n, dtype)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.contact(
            jaxrod.sphere((0.01, -0.152, 0.7), 0.1),
            stiffness=1e5,
            damping=100.0,
            friction=0.4,
        ),
    )
    swing = state.velocities.at[1].set(-2 * state.positions[2])
    return scene, replace(state, velocities=swing.at[0].set(0.3 * state.positions[2]))


def test_gradients_through_contact_are_those_of_finite_differences(record):
    """With respect to every number: body, contact law, rod, and the way it starts."""
    scene, state = struck()
    dt = 0.8 * jaxrod.stable_dt(scene).dt

    @jax.jit
    @jax.value_and_grad
    def landing(numbers):
        scene, state = numbers
        after = jaxrod.advance(scene, state, dt, 50)
        return jnp.sum(after.tip * jnp.asarray([1.0, 2.0, 3.0]))

    start = jax.tree.map(np.asarray, (scene, state))
    slopes = jax.tree.map(np.asarray, landing(start)[1])
    assert abs(slopes[0].effects[1].stiffness * start[0].effects[1].stiffness) > 1e-5
    random = np.random.default_rng(0)
    worst = 0.0
    for _ in range(3):
        towards = jax.tree.map(
            lambda leaf: random.normal(size=leaf.shape) * leaf, start
        )

        def at(share, towards=towards):
            numbers = jax.tree.map(lambda a, b: a + share * b, start, towards)
            return float(landing(numbers)[0])

        found = (at(1e-6) - at(-1e-6)) / 2e-6
        products = jax.tree.map(lambda a, b: np.sum(a * b), slopes, towards)
        worst = max(worst, abs(sum(jax.tree.leaves(products)) / found - 1))
    record(
        "Gradient of 50 steps through contact with friction, by every number",
        "finite differences",
        worst,
        at_most=1e-5,
    )


def test_an_arm_is_shot_through_bodies_and_all_stays_finite_and_is_compiled_once():
    scene, state = struck()
    shot = replace(
        state,
        positions=state.positions.at[1].set(0.2),
        velocities=jnp.zeros_like(state.velocities).at[1].set(-100.0),
    )
    sizes = []
    for radius, stiffness in ((0.1, 2e4), (0.02, 3e4), (1e-4, 1e4)):
        body = jaxrod.sphere((0.0, 0.0, 0.5), radius)
        soft = replace(scene.effects[1], body=body, stiffness=jnp.asarray(stiffness))
        free = replace(scene, effects=(scene.effects[0], soft))
        at = shot
        for _ in range(20):
            at = jaxrod.advance(free, at, 1e-5, 20)
            assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(at))
        assert at.positions[1, 2] < -0.15
        sizes.append(_advance_compiled._cache_size())
    assert len(set(sizes)) == 1


def test_a_batch_of_bodies_is_a_loop_and_several_bodies_are_their_sum():
    rod, state = moving_arm()
    centres = np.random.default_rng(1).normal(scale=0.1, size=(3, 3))
    radii = np.array([0.1, 0.15, 0.2])
    alone = [
        contact_loads(rubbing(jaxrod.sphere(centre, radius)), rod, state)
        for centre, radius in zip(centres, radii, strict=True)
    ]
    spheres = jax.vmap(jaxrod.sphere)(centres, radii)
    batch = jax.vmap(
        lambda body: contact_loads(rubbing(body), rod, state), axis_name="bodies"
    )(spheres)
    for one, each in zip(batch, zip(*alone, strict=True), strict=True):
        assert difference(one, jnp.stack(each)) < 1e-12 * jnp.max(jnp.abs(one))
    listed = [jaxrod.sphere(c, r) for c, r in zip(centres, radii, strict=True)]
    for bodies in (spheres, listed):
        together = contact_loads(rubbing(bodies), rod, state)
        for one, each in zip(together, zip(*alone, strict=True), strict=True):
            assert difference(one, sum(each)) < 1e-12 * jnp.max(jnp.abs(one))


def thrown_in_a_plane(plane):
    """An arm along x thrown onto a sloping floor, in space or in a plane."""
    rod, state = arm(3, direction=(1.0, 0.0, 0.0), normal=(0.0, 1.0, 0.0))
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, -G, 0.0)),
        jaxrod.contact(
            jaxrod.plane((0.0, -0.06, 0.0), (0.2, 1.0, 0.0)),
            stiffness=1e5,
            damping=100.0,
            friction=0.4,
        ),
        plane=plane,
    )
    falls = state.velocities.at[1].set(-2.0).at[0].set(0.5)
    return scene, replace(state, velocities=falls)


def test_in_a_plane_contact_is_what_it_is_in_space():
    scene, state = thrown_in_a_plane(None)
    dt = jaxrod.stable_dt(scene).dt
    free, _, _ = rolled(scene, state, dt, 200)
    flat, _, _ = rolled(*thrown_in_a_plane("xy"), dt, 200)
    assert jnp.max(jnp.abs(free.velocities - state.velocities)) > 0.5
    assert difference(flat.positions, free.positions) < 1e-11
    assert difference(flat.velocities, free.velocities) < 1e-9


def test_a_body_that_pushes_out_of_the_plane_is_refused_in_words():
    scene, state = thrown_in_a_plane("xy")
    tilted = jaxrod.capsule((0.0, -9.0, -1.0), (0.0, -9.0, 2.0), 0.1)
    for end, fits in (((0.0, -9.0, 2.0), True), ((0.0, -8.0, 2.0), False)):
        tilted = replace(tilted, end=jnp.asarray(end))
        contact = jaxrod.contact(tilted, stiffness=1e5)
        aside = replace(scene, effects=(scene.effects[0], contact))
        if fits:
            check_planar(aside, state)
            continue
        with pytest.raises(ValueError, match="surfaces of bodies in that plane"):
            check_planar(aside, state)


def test_loads_have_finite_gradients_at_every_turning_point():
    """At a centre, where contact begins, where it is full, and where nothing slips."""
    dtype = jnp.float32
    rod, state = arm(6, dtype)
    width, touching = 0.01 * RADIUS, 0.1 + RADIUS
    heights = touching + width * np.array([0.5, 0.5 - 1e-3, 0.0, -0.5, -1.0, 0.0])
    heights = jnp.asarray(np.append(heights, 0.0), dtype)
    state = replace(state, positions=jnp.zeros_like(state.positions).at[1].set(heights))
    contact = jax.tree.map(
        lambda leaf: leaf.astype(dtype),
        rubbing(jaxrod.sphere((0.0, 0.0, 0.0), 0.1), onset=0.01),
    )

    @jax.jit
    def slopes(contact, state):
        def total(contact, state):
            return sum(jnp.sum(load) for load in contact_loads(contact, rod, state))

        return jax.grad(total, argnums=(0, 1))(contact, state)

    for speed in (0.0, 1.0, -1.0):
        moving = replace(state, velocities=state.velocities + speed)
        found = jax.tree.leaves(slopes(contact, moving))
        assert all(jnp.all(jnp.isfinite(leaf)) for leaf in found)


def pressed(share):
    """An arm pressed onto a floor, in equilibrium with it.

    The floor's stiffness is a share of what would double the squared frequency.
    """
    rod, state = arm(3, radius=0.02)
    frequency = jaxrod.stable_dt(jaxrod.make_scene(rod), 1.0).angular_frequency
    line = rod.linear_density[0]
    stiffness = share * frequency**2 * line
    depth = 0.1 * 0.02
    scene = jaxrod.make_scene(
        rod,
        jaxrod.uniform_load(jnp.asarray([0.0, -1.0, 0.0]) * stiffness * depth),
        jaxrod.contact(
            jaxrod.plane((0.0, depth - 0.02, 0.0), (0.0, 1.0, 0.0)),
            stiffness=stiffness,
        ),
    )
    return scene, state


@jax.jit
def excursion(scene, state, dt):
    """How far a rod disturbed by 1e-8 gets from its place in 2000 steps [m]."""
    noise = 1e-8 * jax.random.normal(jax.random.key(0), state.positions.shape)
    disturbed = replace(state, positions=state.positions + noise)
    after = jaxrod.advance(scene, disturbed, dt, jnp.asarray(2000))
    return jnp.max(jnp.abs(after.positions - state.positions)[1])


@pytest.mark.parametrize("share", [0.01, 1.0, 100.0])
def test_the_stable_step_knows_of_the_stiffness_of_contact(share, record):
    scene, state = pressed(share)
    bound = float(jaxrod.stable_dt(scene, 1.0).dt)
    measured = float(jaxrod.stable_dt(scene, 1.0, state=state).dt)
    record(
        f"Stable step over the true limit, contact of {share:g} times the rod's "
        "squared frequency",
        "2/omega_max by iteration, touching",
        bound / measured,
        between=(0.9, 1.001),
    )
    assert excursion(scene, state, 0.99 * measured) < 1e-6
    assert not excursion(scene, state, 1.03 * measured) < 1e-4


@jax.jit
def growth(scene, state, dt):
    """The largest factor by which a step changes a small motion."""
    flat, unravel = ravel_pytree(state)
    step = jax.jacfwd(lambda x: ravel_pytree(jaxrod.step(scene, unravel(x), dt))[0])
    return step(flat)


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "drag"), [(0.5, 0.0), (0.0, 0.1), (0.2, 0.05)])
def test_the_stable_step_knows_of_damping_and_friction(damping, drag, record):
    """Rates of damping and drag as shares of the highest frequency of the rod."""
    scene, state = pressed(0.5)
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
        factors = np.linalg.eigvals(np.asarray(growth(scene, state, dt)))
        return np.max(np.abs(factors)) < 1 + 1e-3

    low, high = 0.25 * bound, 4 * bound
    for _ in range(10):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    record(
        f"Stable step over the true limit, contact with damping {damping:g} and "
        f"friction drag {drag:g} of the rod's frequency",
        "eigenvalues of a step, touching",
        bound / low,
        between=(0.5, 1.005),
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stiffness": -1.0}, r"stiffness must be positive, got -1 N/m\^2"),
        ({"damping": -1.0}, "damping must be non-negative"),
        ({"friction": -1.0}, "friction must be non-negative"),
        ({"friction": 0.5}, "friction needs friction_drag > 0"),
        ({"onset": 0.0}, "onset must be positive"),
        ({"points_per_element": 0}, "points_per_element must be at least 1"),
        ({"bodies": []}, "bodies must be at least one"),
    ],
)
def test_bad_numbers_are_refused_in_words(change, words):
    given = {"bodies": jaxrod.plane(), "stiffness": 1.0} | change
    with pytest.raises(ValueError, match=words):
        jaxrod.contact(given.pop("bodies"), **given)


@pytest.mark.parametrize(
    ("bodies", "words"),
    [
        (["floor"], "bodies must be jaxrod bodies, got str"),
        ([jaxrod.plane(), jaxrod.sphere((0, 0, 0), 1)], "got Plane and Sphere"),
    ],
)
def test_what_is_no_body_is_refused_in_words(bodies, words):
    with pytest.raises(TypeError, match=words):
        jaxrod.contact(bodies, stiffness=1.0)
