"""The forces of contact and friction: what they are, and what they never do."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.contacts.contact_law import normal_force
from jaxrod.geometry import vectors
from jaxrod.rods.motion import motion_of
from physics.rods import (
    RADIUS,
    deformed,
    difference,
    no_moves,
    perturb,
    random_rod,
)
from physics.shapes import BODIES, rotated, turned
from physics.touching import (
    DEPTH,
    LINE,
    RATE,
    STIFFNESS,
    G,
    contact_loads,
    floor_contact,
    moving_arm,
    rubbing,
)


@pytest.mark.slow
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


@pytest.mark.slow
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
        return normal_force(depth, speed, width, contact.stiffness, contact.damping)

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


@pytest.mark.fast_sets(1)
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
    quaternion = jaxrod.geometry.rotations.rotation_exp(
        tuple(c[None] for c in rotation)
    )
    both = jaxrod.geometry.rotations.multiply_quaternions(
        quaternion, tuple(orientations)
    )
    return jnp.stack(both)


@pytest.mark.slow
def test_friction_takes_energy_and_neither_force_nor_moment_from_nowhere():
    """About any point: its couples are those of forces at the surface."""
    rod, state = moving_arm()
    body = jaxrod.shapes.sphere((0.1, -0.02, 0.05), 0.2)
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
    frame = jaxrod.geometry.rotations.directors(tuple(state.orientations))
    spins = vectors.join(
        jaxrod.geometry.rotations.to_world(frame, vectors.split(spins))
    )
    power = jnp.sum(rub * state.velocities) + jnp.sum(couples * spins)
    assert power < -1e-3


@pytest.mark.slow
def test_a_batch_of_bodies_is_a_loop_and_several_bodies_are_their_sum():
    rod, state = moving_arm()
    centres = np.random.default_rng(1).normal(scale=0.1, size=(3, 3))
    radii = np.array([0.1, 0.15, 0.2])
    alone = [
        contact_loads(rubbing(jaxrod.shapes.sphere(centre, radius)), rod, state)
        for centre, radius in zip(centres, radii, strict=True)
    ]
    spheres = jax.vmap(jaxrod.shapes.sphere)(centres, radii)
    batch = jax.vmap(
        lambda body: contact_loads(rubbing(body), rod, state), axis_name="bodies"
    )(spheres)
    for one, each in zip(batch, zip(*alone, strict=True), strict=True):
        assert difference(one, jnp.stack(each)) < 1e-12 * jnp.max(jnp.abs(one))
    listed = [jaxrod.shapes.sphere(c, r) for c, r in zip(centres, radii, strict=True)]
    for bodies in (spheres, listed):
        together = contact_loads(rubbing(bodies), rod, state)
        for one, each in zip(together, zip(*alone, strict=True), strict=True):
            assert difference(one, sum(each)) < 1e-12 * jnp.max(jnp.abs(one))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stiffness": -1.0}, r"stiffness must be positive, got -1 N/m\^2"),
        ({"damping": -1.0}, "damping must be non-negative"),
        ({"friction": -1.0}, "friction must be non-negative"),
        ({"friction": 0.5}, "friction needs friction_drag > 0"),
        ({"onset": 0.0}, "onset must be positive"),
        ({"points_per_element": 0}, "points_per_element must be at least 1"),
        ({"bodies": []}, "bodies must contain at least one body"),
    ],
)
def test_bad_numbers_are_refused_in_words(change, words):
    given = {"bodies": jaxrod.shapes.plane(), "stiffness": 1.0} | change
    with pytest.raises(ValueError, match=words):
        jaxrod.contact(given.pop("bodies"), **given)


@pytest.mark.parametrize(
    ("bodies", "words"),
    [
        (["floor"], "bodies must be jaxrod bodies, got str"),
        (
            [jaxrod.shapes.plane(), jaxrod.shapes.sphere((0, 0, 0), 1)],
            "got Plane and Sphere",
        ),
    ],
)
def test_what_is_no_body_is_refused_in_words(bodies, words):
    with pytest.raises(TypeError, match=words):
        jaxrod.contact(bodies, stiffness=1.0)
