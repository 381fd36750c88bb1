"""Internal loads are minus the gradient of a stored energy, however bent."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry.rotations import (
    directors_from_orientations,
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
)
from physics.rods import (
    deformed,
    difference,
    largest,
    loads,
    no_moves,
    perturb,
    random_rod,
    turn,
)


def energy_gradient(scene, state):
    return jax.grad(lambda moves: scene.potential_energy(perturb(state, moves)))(
        no_moves(state)
    )


def mismatch(scene, state):
    """Loads plus energy gradient, relative to the latter; forces, couples apart."""
    pairs = zip(
        jax.jit(loads)(scene, state),
        jax.jit(energy_gradient)(scene, state),
        strict=True,
    )
    return max(difference(-load, slope) / largest(slope) for load, slope in pairs)


ANGLES = (0.0, 1e-6, 0.5, 1.5, 3.0)


def test_internal_loads_are_minus_the_gradient_of_the_stored_energy(record):
    rod, _ = random_rod(0, n_elements=9)
    scene = jaxrod.make_scene(rod)
    worst = max(
        mismatch(scene, deformed(rod, seed, angle))
        for seed in range(5)
        for angle in ANGLES
    )
    record(
        "Internal loads, joints bent and twisted up to 3 rad",
        "minus the gradient of the stored energy, by automatic differentiation",
        worst,
        at_most=1e-12,
    )


@pytest.mark.slow
@pytest.mark.parametrize("end", ["base", "tip"])
def test_effects_with_an_energy_load_the_rod_by_minus_its_gradient(end, record):
    rod, rest = random_rod(1, n_elements=6)
    state = deformed(rod, 1, 1.2)
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(rest, end), jaxrod.gravity((1.0, 2.0, -9.0))
    )
    record(
        f"Wall clamp at the {end} and gravity",
        "minus the gradient of their energies",
        mismatch(scene, state),
        at_most=1e-12,
    )


def test_the_factory_s_shape_is_free_of_stress():
    rod, state = random_rod(2, n_elements=7)
    forces, couples = loads(jaxrod.make_scene(rod), state)
    assert largest(forces) <= 1e-12 * largest(rod.shear_stretch_stiffness)
    assert largest(couples) <= 1e-12 * largest(rod.bend_twist_stiffness)
    assert largest(loads(jaxrod.make_scene(rod), deformed(rod, 2))) > 1


def test_energy_does_not_depend_on_where_the_rod_is_or_how_it_is_turned(record):
    rod, _ = random_rod(3, n_elements=9)
    stored_energy = jax.jit(jaxrod.stored_energy)
    worst = 0.0
    for seed in range(5):
        state = deformed(rod, seed, 2.0)
        axis = np.random.default_rng(seed).normal(size=3)
        frame = turn(jnp.array([[1.0], [0.0], [0.0], [0.0]]), axis[:, None])
        moved = moved_rigidly(state, frame[:, 0], axis)
        before = stored_energy(rod, state)
        after = stored_energy(rod, moved)
        worst = max(worst, abs(float(after / before) - 1))
    record(
        "Frame indifference of the stored energy",
        "the same rod moved and turned",
        worst,
        at_most=1e-12,
    )


def moved_rigidly(state, frame, shift):
    """The state turned by a quaternion about the origin and then shifted."""
    matrix = directors_from_orientations(frame[:, None])[:, :, 0].T
    orientation = multiply_quaternions(
        tuple(frame[:, None]), split_quaternion(state.orientations)
    )
    return replace(
        state,
        positions=jnp.einsum("ij,jk->ik", matrix, state.positions) + shift[:, None],
        orientations=join_quaternion(orientation),
    )


def test_internal_loads_sum_to_no_force_and_no_couple(record):
    rod, _ = random_rod(4, n_elements=9)
    worst = 0.0
    for seed in range(5):
        state = deformed(rod, seed, 3.0)
        forces, couples = jax.jit(loads)(jaxrod.make_scene(rod), state)
        world = jnp.einsum("ijk,ik->jk", state.directors, couples)
        moments = jnp.cross(state.positions, forces, axis=0)
        net = jnp.sum(moments, axis=1) + jnp.sum(world, axis=1)
        worst = max(
            worst,
            largest(jnp.sum(forces, axis=1)) / largest(forces),
            largest(net) / max(largest(moments), largest(world)),
        )
    record(
        "Net force and net couple of the internal loads",
        "zero",
        worst,
        at_most=1e-12,
    )


def test_couples_are_linear_in_small_bending():
    """Bending by one curvature everywhere loads the end elements alone: M = EI k."""
    rod, state = jaxrod.straight_rod(
        10, length=1.0, radius=0.05, density=1e3, youngs_modulus=1e7, dtype=jnp.float64
    )
    curvature = 1e-3
    angles = curvature * rod.arc_length_midpoints
    bent = replace(
        state,
        orientations=turn(state.orientations, jnp.zeros((3, 10)).at[0].set(angles)),
    )
    scene = jaxrod.make_scene(replace(rod, shear_stretch_stiffness=jnp.zeros((3, 10))))
    _, couples = loads(scene, bent)
    moment = float(rod.bend_twist_stiffness[0, 0]) * curvature
    expected = np.zeros((3, 10))
    expected[0, 0], expected[0, -1] = moment, -moment
    np.testing.assert_allclose(couples, expected, atol=1e-10 * moment)
