"""Ends of rods in contact: one law on every grid, for all bodies."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry import vectors
from jaxrod.rods.motion import motion_of
from physics.touching import contact_loads

RADIUS, LENGTH, STIFFNESS = 0.01, 0.3, 1e4
_ROOT = 0.5**0.5
BELOW = {
    "plane": lambda: jaxrod.shapes.plane(),
    "ball": lambda: jaxrod.shapes.sphere((0.0, 0.0, -0.05), 0.05),
    "edge": lambda: jaxrod.shapes.box(
        (0.0, 0.0, -0.2 * _ROOT), (0.1, 0.1, 0.1), _about_x(np.pi / 4)
    ),
    "rim": lambda: jaxrod.shapes.cylinder(
        (0.0, 0.05 * _ROOT, -0.05 * _ROOT), (0.0, -0.05 * _ROOT, -0.15 * _ROOT), 0.05
    ),
    "tip of a post": lambda: jaxrod.shapes.capsule(
        (0.0, 0, -0.2), (0.0, 0, -0.002), 0.002
    ),
}
"""Bodies whose highest point is the origin, or a line through it."""


def _about_x(angle):
    return (np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0)


def standing(n, depth, direction=1.0):
    start = np.array([0.0, 0.0, RADIUS - depth])
    if direction < 0:
        start[2] += LENGTH
    return jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e7,
        start=start,
        direction=(0.0, 0.0, direction),
    )


def law(depth):
    """The force on a face and on the side next to it [N]."""
    return STIFFNESS * (2 * RADIUS * depth + depth**2 / 2)


FINEST = pytest.param(160, 8, marks=pytest.mark.slow)
GRIDS = [(10, 1), (10, 4), (40, 2), (160, 1), FINEST]


@pytest.mark.slow
@pytest.mark.parametrize(("n", "points"), GRIDS)
def test_a_standing_rod_is_pushed_alike_on_every_grid(n, points):
    for name, make in BELOW.items():
        ground = jaxrod.contact(make(), stiffness=STIFFNESS, points_per_element=points)
        for direction in (1.0, -1.0):
            for depth in (1e-4, 1e-3, 2.5e-3):
                forces, _ = contact_loads(ground, *standing(n, depth, direction))
                found = float(jnp.sum(forces[2]))
                assert found == pytest.approx(law(depth), rel=0.02), (name, depth)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("n", "points"), GRIDS)
def test_a_moving_body_is_pushed_as_a_fixed_one(n, points):
    rod, state = standing(n, 1e-3)
    ball, at = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.0, -0.05), 0.05), density=500.0, dtype=jnp.float64
    )
    system = jaxrod.make_system(
        {"rod": jaxrod.make_scene(rod), "ball": ball},
        jaxrod.systems.body_contact(
            "rod", "ball", stiffness=STIFFNESS, points_per_element=points
        ),
    )

    @jax.jit
    def pushed(system):
        def energy(lift):
            there = state.positions + lift * jnp.array([0.0, 0.0, 1.0])[:, None]
            moved = {"rod": dataclasses.replace(state, positions=there), "ball": at}
            return system.potential_energy(moved)

        return -jax.grad(energy)(0.0)

    assert float(pushed(system)) == pytest.approx(law(1e-3), rel=0.02)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("n", "points"), GRIDS)
def test_a_lying_rod_rests_at_the_weight_over_stiffness_and_length(n, points):
    depth = 1e-3
    rod, state = jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e7,
        start=(0.0, 0.0, RADIUS - depth),
        direction=(1.0, 0.0, 0.0),
    )
    ground = jaxrod.contact(
        jaxrod.shapes.plane(), stiffness=STIFFNESS, points_per_element=points
    )
    forces, _ = contact_loads(ground, rod, state)
    assert float(jnp.sum(forces[2])) == pytest.approx(
        STIFFNESS * LENGTH * depth, rel=1e-12
    )
    # Every node has its share, as it has of the weight.
    share = np.asarray(rod.node_masses / jnp.sum(rod.node_masses))
    assert forces[2] == pytest.approx(share * STIFFNESS * LENGTH * depth, rel=1e-9)


@pytest.mark.slow
def test_a_leaning_rod_is_pushed_alike_on_every_grid():
    angle, depth = np.deg2rad(40.0), 1e-3
    rise = np.sin(angle)
    expected = STIFFNESS * (2 * RADIUS * rise**2 * depth + depth**2 / (2 * rise))
    for n, points in ((6, 1), (24, 1), (24, 4)):
        rod, state = jaxrod.straight_rod(
            n,
            length=LENGTH,
            radius=RADIUS,
            density=1000.0,
            youngs_modulus=1e7,
            start=(0.0, 0.0, RADIUS - depth),
            direction=(np.cos(angle), 0.0, rise),
        )
        ground = jaxrod.contact(
            jaxrod.shapes.plane(), stiffness=STIFFNESS, points_per_element=points
        )
        forces, _ = contact_loads(ground, rod, state)
        assert float(jnp.sum(forces[2])) == pytest.approx(expected, rel=0.02)
        assert np.max(np.abs(forces[:2])) < 1e-12


def leaning(n, angle, depth):
    """A rod whose first end has this depth in the plane z = 0."""
    return jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e7,
        start=(0.0, 0.0, RADIUS - depth),
        direction=(np.cos(angle), 0.0, np.sin(angle)),
        dtype=jnp.float64,
    )


def rubbing_ball():
    """A heavy ball so large that it is flat, its highest point at the origin."""
    ball = jaxrod.shapes.sphere((0.0, 0.0, -1e4), 1e4)
    return jaxrod.systems.rigid_body(ball, density=1.0, dtype=jnp.float64)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("kind", ["fixed", "sticking", "moving body"])
def test_friction_of_a_leaning_rod_is_its_coefficient_times_the_normal_force(kind):
    """Most of what presses is the side of the rod next to its end."""
    rod, state = leaning(12, np.deg2rad(10.0), 2e-3)
    state = dataclasses.replace(state, velocities=state.velocities.at[1].set(9.0))
    numbers = {"stiffness": STIFFNESS, "friction": 0.3, "friction_drag": 1e9}
    if kind == "moving body":
        ball, at = rubbing_ball()
        rubs = jaxrod.systems.body_contact("rod", "ball", damping=1e-9, **numbers)
        states = {"rod": state, "ball": at}
        system = jaxrod.make_system({"rod": jaxrod.make_scene(rod), "ball": ball}, rubs)
        push = jaxrod.reactions(system, states).on("ball").force
    else:
        ground = jaxrod.contact(jaxrod.shapes.plane(), damping=1e-9, **numbers)
        if kind == "sticking":
            ground = jaxrod.sticking_contact(ground, rod, state)
        forces, _ = contact_loads(ground, rod, state)
        push = jnp.sum(forces, axis=1)
    assert abs(float(push[2])) > 0.02
    assert abs(float(push[1] / push[2])) == pytest.approx(0.3, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("per", [1, 3])
def test_loads_at_an_end_are_minus_the_gradient_of_the_energy(per):
    """At a sphere, aslant, so that the two normals differ; near ones, too."""
    rod, state = standing(8, 2e-3)
    ball = jaxrod.shapes.sphere((0.01, -0.02, -0.05), 0.06)
    contact = jaxrod.contact([ball, ball], stiffness=1e4, points_per_element=per)

    @jax.jit
    def both(contact, state):
        def energy(positions):
            return contact.energy(rod, dataclasses.replace(state, positions=positions))

        loads = contact.loads(rod, motion_of(state))
        return -jax.grad(energy)(state.positions), vectors.join(loads.forces)

    by_energy, forces = both(contact, state)
    assert jnp.max(jnp.abs(forces)) > 0.1
    assert by_energy == pytest.approx(np.asarray(forces), abs=1e-12)
    near = both(jaxrod.near_contact(contact, rod, state, 1), state)[1]
    assert 2 * near == pytest.approx(np.asarray(forces), abs=1e-12)


@pytest.mark.slow
def test_ends_that_are_tied_have_no_face():
    """Two rods that stand on the end that they share, like a V."""
    depth, n = 1e-3, 4
    numbers = {"length": LENGTH, "radius": RADIUS, "density": 1e3}
    foot = np.array([0.0, 0.0, RADIUS - depth])
    aside, up = np.array([0.6, 0.0, 0.8]), np.array([-0.6, 0.0, 0.8])
    left, at_left = jaxrod.straight_rod(
        n, youngs_modulus=1e7, start=foot, direction=aside, **numbers
    )
    # Two equal rods together, of which the second stands there with its last end.
    pairs = [
        jaxrod.straight_rod(
            n, youngs_modulus=1e7, start=start, direction=-up, **numbers
        )
        for start in (foot + np.array([1.0, 0, 1.0]), foot + LENGTH * up)
    ]
    rights, at_rights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    ground = jaxrod.contact(jaxrod.shapes.plane(), stiffness=STIFFNESS)
    system = jaxrod.make_system(
        {
            "left": jaxrod.make_scene(left, ground),
            "rights": jax.vmap(lambda rod: jaxrod.make_scene(rod, ground))(rights),
        },
        jaxrod.systems.tie(
            ("left", "base"),
            ("rights", 1, "tip"),
            {"left": at_left, "rights": at_rights},
        ),
    )
    one, others = system.members["left"], system.members["rights"]
    assert one.effects[0].free_ends.tolist() == [0.0, 1.0]
    assert others.effects[0].free_ends.tolist() == [[1.0, 1.0], [1.0, 0.0]]
    share = STIFFNESS * depth * LENGTH / (2 * n)
    forces, _ = contact_loads(one.effects[0], one.rod, at_left)
    assert np.asarray(forces[2]) == pytest.approx([share, 0, 0, 0, 0])
    forces, _ = jax.vmap(contact_loads)(others.effects[0], others.rod, at_rights)
    assert np.asarray(forces[1, 2]) == pytest.approx([0, 0, 0, 0, share])
    free, _ = contact_loads(ground, left, at_left)
    expected = STIFFNESS * (2 * RADIUS * 0.8**2 * depth + depth**2 / 1.6)
    assert float(jnp.sum(free[2])) == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 12])
def test_the_bound_of_the_stiffness_holds_for_ends_at_any_angle(n):
    """On a coarse grid and on one whose elements are thinner than the rod is thick."""
    rod, state = standing(n, 0.0)
    rod = dataclasses.replace(rod, radii=jnp.full(n, 0.1))
    ground = jaxrod.contact(jaxrod.shapes.plane(), stiffness=1.0, onset=1e-3)

    @jax.jit
    def largest(angle, depth):
        """Eigenvalue of the energy's Hessian over the bound."""
        along = jnp.stack([jnp.cos(angle), jnp.zeros(()), jnp.sin(angle)])
        places = jnp.linspace(0.0, LENGTH, n + 1)
        foot = jnp.array([0.0, 0.0, 0.1]) - depth * jnp.array([0.0, 0.0, 1.0])

        def energy(positions):
            there = dataclasses.replace(state, positions=positions)
            return ground.energy(rod, there)

        hessian = jax.hessian(energy)(foot[:, None] + along[:, None] * places[None])
        bound = jnp.tile(ground.stability_bound(rod).nodes, 3)
        scaled = hessian.reshape(bound.size, bound.size) / jnp.sqrt(
            bound[:, None] * bound[None, :]
        )
        return jnp.linalg.eigvalsh(scaled)[-1]

    angles = jnp.deg2rad(jnp.linspace(0.0, 90.0, 19))
    found = jax.vmap(jax.vmap(largest, (0, None)), (None, 0))(
        angles, jnp.array([1e-4, 3e-3, 1e-2, 0.025])
    )
    assert 0.2 < jnp.max(found) <= 1 + 1e-9
