"""The published contact law, against closed forms, a plain loop, and PyElastica."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import straight_rod
from jaxrod.envs.arm.cylinders import cylinders
from jaxrod.envs.arm.published_contact import PublishedContact, boxes_overlap
from jaxrod.extend import Loads, Motion
from jaxrod.geometry import vectors
from published_oracle import Obstacle
from published_oracle import shortest as shortest_vector

N, M = 7, 5
RADIUS, LENGTH = 0.05, 1.0
K, NU = 8e4, 4.0


@pytest.fixture(scope="module")
def rod():
    with jax.enable_x64(True):
        return straight_rod(
            N, length=0.7, radius=RADIUS, density=1e3, youngs_modulus=1e7
        )[0]


def motion(x, v):
    """Nodes (n + 1, 3) and their velocities as the simulator holds them."""
    return Motion(
        position=vectors.split(jnp.asarray(x.T)),
        orientation=(jnp.ones(N), *[jnp.zeros(N)] * 3),
        velocity=vectors.split(jnp.asarray(v.T)),
        spin=(jnp.zeros(N),) * 3,
    )


@jax.jit
def push(contact, rod, motion, forces):
    before = Loads(forces=vectors.split(forces))
    return forces + jnp.stack(contact.loads_after(rod, motion, before).forces)


def random_case(seed):
    """A crumpled arm among thick cylinders, and forces of all sizes on it."""
    random = np.random.default_rng(seed)
    x = np.cumsum(random.normal(size=(N + 1, 3)) * 0.06, axis=0)
    v = random.normal(size=(N + 1, 3))
    forces = random.normal(size=(N + 1, 3)) * 3e3
    directions = random.normal(size=(M, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normals = np.cross(directions, random.normal(size=(M, 3)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    starts = x.mean(axis=0) + random.normal(size=(M, 3)) * 0.2 - 0.3 * directions
    return x, v, forces, starts, directions, normals


def contact_with(starts, directions, normals, radius=0.1):
    return PublishedContact(
        cylinders(starts, directions, normals, length=LENGTH, radius=radius),
        jnp.asarray(K),
        jnp.asarray(NU),
    )


def test_forces_are_those_of_a_plain_loop(rod):
    touched = 0
    for seed in range(20):
        x, v, forces, starts, directions, normals = random_case(seed)
        contact = contact_with(starts, directions, normals)
        total = push(contact, rod, motion(x, v), jnp.asarray(forces.T))
        expected = forces.copy()
        lengths = np.linalg.norm(np.diff(x, axis=0), axis=1)
        radii = RADIUS * np.sqrt(0.1 / lengths)
        for place in zip(starts, directions, normals, strict=True):
            Obstacle(*place, LENGTH, 0.1).push(x, v, radii, expected)
        touched += np.count_nonzero(expected - forces)
        np.testing.assert_allclose(total.T, expected, rtol=1e-9, atol=1e-6)
    assert touched > 300


def straight_case(gap, speed=0.0, pressing=0.0):
    """An arm along y at `gap` from the surface of a cylinder along z at its +x."""
    x = np.stack([np.zeros(N + 1), np.linspace(-0.35, 0.35, N + 1), np.zeros(N + 1)], 1)
    v = np.zeros((N + 1, 3))
    v[:, 0] = speed
    forces = np.zeros((N + 1, 3))
    forces[:, 0] = pressing
    start = [[RADIUS + 0.1 + gap, 0.0, -0.5]]
    contact = contact_with(start, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    return contact, motion(x, v), jnp.asarray(forces.T)


def test_an_overlap_pushes_both_nodes_with_half_of_stiffness_and_damping(rod):
    contact, moving, forces = straight_case(-0.001, speed=0.3)
    total = np.asarray(push(contact, rod, moving, forces))
    # The middle one of seven elements touches: its nodes are the fourth and fifth.
    expected = np.zeros((3, N + 1))
    expected[0, 3:5] = -0.5 * (K * 0.001 + NU * 0.3)
    np.testing.assert_allclose(total, expected, atol=1e-9)


def test_touching_from_within_ten_micrometres_cancels_what_presses(rod):
    contact, still, forces = straight_case(5e-6, pressing=40.0)
    total = np.asarray(push(contact, rod, still, forces))
    np.testing.assert_allclose(total[0], [40.0] * 3 + [0.0, 0.0] + [40.0] * 3)
    away = np.asarray(push(contact, rod, still, -forces))
    np.testing.assert_allclose(away, -forces)
    contact, still, forces = straight_case(2e-5, pressing=40.0)
    np.testing.assert_allclose(push(contact, rod, still, forces), forces)


def test_what_a_cylinder_has_taken_up_spares_the_next_element(rod):
    """A chain of elements at equal overlap, pressed equally: the loop by hand."""
    _, still, forces = straight_case(-0.001, pressing=10.0)
    place, parallel = [RADIUS + 0.099, -0.5, 0.0], [0.0, 1.0, 0.0]
    along = contact_with([place], [parallel], [[1.0, 0.0, 0.0]])
    total = np.asarray(push(along, rod, still, forces))[0]
    expected, taken = np.full(N + 1, 10.0), 0.0
    for i in range(N):
        force = max(0.0, 0.5 * (expected[i] + expected[i + 1]) - taken) + 0.5 * K * 1e-3
        share = 0.5 if i == 0 else 1.0
        expected[i] -= share * force
        expected[i + 1] -= force
        taken += (1 + share) * force
    np.testing.assert_allclose(total, expected, rtol=1e-9)


@pytest.mark.slow
def test_closest_points_and_boxes_are_pyelasticas(rod):
    from elastica.contact_utils import _find_min_dist, _prune_using_aabbs_rod_cylinder

    pruned = 0
    for seed in range(30):
        x, v, _, starts, directions, normals = random_case(seed)
        starts = starts + np.random.default_rng(seed).normal(size=(M, 3)) * 0.5
        contact = contact_with(starts, directions, normals, radius=0.03)
        normal, _ = contact.encounters(rod, motion(x, v))
        lengths = np.linalg.norm(np.diff(x, axis=0), axis=1)
        radii = RADIUS * np.sqrt(0.1 / lengths)
        overlap = boxes_overlap(
            contact.cylinders, motion(x, v), jnp.asarray(lengths), jnp.asarray(radii)
        )
        for j in range(M):
            frame = np.stack(
                [normals[j], np.cross(directions[j], normals[j]), directions[j]]
            )
            centre = starts[j] + 0.5 * directions[j]
            away = _prune_using_aabbs_rod_cylinder(
                x.T,
                radii,
                lengths,
                centre[:, None],
                frame[:, :, None],
                0.03,
                LENGTH,
            )
            assert bool(overlap[j]) == (away == 0)
            pruned += away
            for i in range(N):
                apart = _find_min_dist(x[i], x[i + 1] - x[i], starts[j], directions[j])
                apart = np.array(apart[0])
                mine = shortest_vector(x[i], x[i + 1] - x[i], starts[j], directions[j])
                np.testing.assert_allclose(mine, apart, atol=1e-9)
                distance = np.linalg.norm(apart)
                if overlap[j] and distance < radii[i] + 0.03:
                    found = np.array([c[j, i] for c in normal])
                    np.testing.assert_allclose(found, apart / distance, atol=1e-9)
    assert 10 < pruned < 140


def test_a_cylinder_with_a_parallel_normal_has_a_box_without_width(rod):
    """Contact begins when the arm's box, padded by 7 cm here, reaches the axis."""
    thickness = RADIUS + 0.7 / N
    for x, reached in ((thickness + 0.001, False), (thickness - 0.001, True)):
        nodes = np.zeros((N + 1, 3))
        nodes[:, 0], nodes[:, 2] = x, np.linspace(-0.35, 0.35, N + 1)
        along = [[0.0, 1.0, 0.0]]
        contact = contact_with([[0.0, -0.5, 0.0]], along, along)
        lengths = jnp.full(N, 0.1)
        moving = motion(nodes, 0 * nodes)
        radii = jnp.full(N, RADIUS)
        assert bool(boxes_overlap(contact.cylinders, moving, lengths, radii)) == reached
        proper = contact_with([[0.0, -0.5, 0.0]], along, [[1.0, 0.0, 0.0]])
        assert bool(boxes_overlap(proper.cylinders, moving, lengths, radii))


@pytest.mark.slow
def test_crossing_axes_are_finite_with_finite_gradients(rod):
    contact, still, forces = straight_case(-RADIUS - 0.1)

    def loss(contact, forces):
        return jnp.sum(push(contact, rod, still, forces) ** 2)

    assert np.all(np.isfinite(push(contact, rod, still, forces)))
    gradient = jax.grad(loss, argnums=(0, 1))(contact, forces + 1.0)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
