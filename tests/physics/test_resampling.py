"""The same rod with more or fewer elements."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm, deformed


def curved(n, dtype=jnp.float64):
    """A tapering arc of 1 m, clamped, with couples that vary along it."""
    s = (np.arange(n + 1)) / n
    rod, state = jaxrod.rod_along(
        np.stack([np.sin(s), 0 * s, 1 - np.cos(s)]),
        radius=(0.05, 0.02),
        density=1000.0,
        youngs_modulus=1e7,
        normal=(0.0, 1.0, 0.0),
        dtype=dtype,
    )
    middles = (np.arange(n) + 0.5) / n
    couples = jnp.asarray(np.stack([np.sin(2 * middles)] * 3)) / n
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity(),
        jaxrod.actuation.ElementCouples(couples),
    )
    return scene, state


def test_a_uniform_straight_rod_is_the_one_the_factory_makes():
    rod, state = arm(7)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    finer, moved = jaxrod.resample(scene, state, 20)
    expected_rod, expected = arm(20)
    for field in dataclasses.fields(rod):
        got, want = (getattr(r, field.name) for r in (finer.rod, expected_rod))
        if isinstance(got, str):
            assert got == want
        else:
            np.testing.assert_allclose(got, want, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(moved.positions, expected.positions, atol=1e-15)
    np.testing.assert_allclose(moved.orientations, expected.orientations, atol=1e-15)
    np.testing.assert_allclose(
        finer.effects[0].orientation, expected.orientations[:, 0]
    )


@pytest.mark.slow
def test_it_converges_to_the_rod_of_many_elements():
    """From n elements to 96: every number is right to O(1/n^2)."""
    exact, exact_state = curved(96)

    def errors(n):
        scene, state = jaxrod.resample(*curved(n), 96)
        yield scene.rod.bend_twist_stiffness, exact.rod.bend_twist_stiffness
        yield scene.rod.linear_density, exact.rod.linear_density
        yield scene.effects[0].orientation, exact.effects[0].orientation
        yield scene.effects[2].couples, exact.effects[2].couples
        yield state.positions, exact_state.positions
        yield state.orientations, exact_state.orientations

    relative = lambda a, b: float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b)))
    coarse = [relative(*pair) for pair in errors(12)]
    fine = [relative(*pair) for pair in errors(24)]
    assert max(fine) < 0.02
    for one, other in zip(coarse, fine, strict=True):
        assert one < 1e-6 or 3.0 < one / other < 5.5


@pytest.mark.slow
def test_a_moving_rod_keeps_its_momentum_and_energy():
    rod, _ = arm(40)
    state = deformed(rod, 3, largest_angle=0.05, largest_strain=0.01)
    smooth = jnp.sin(jnp.linspace(0.0, 3.0, 41))
    state = dataclasses.replace(
        state, velocities=jnp.stack([smooth, 2 * smooth, 0.5 * smooth])
    )
    state = jaxrod.with_angular_velocities(rod, state, jnp.ones((3, 40)))
    scene, moved = jaxrod.resample(jaxrod.make_scene(rod), state, 80)
    np.testing.assert_allclose(scene.momentum(moved), rod.momentum(state), rtol=2e-3)
    assert float(scene.kinetic_energy(moved)) == pytest.approx(
        float(rod.kinetic_energy(state)), rel=2e-3
    )


def test_the_same_number_changes_nothing_and_too_few_are_refused():
    scene, state = curved(8)
    again = jaxrod.resample(scene, state, 8)
    assert again[0] is scene and again[1] is state
    with pytest.raises(ValueError, match="n_elements must be at least 2"):
        jaxrod.resample(scene, state, 1)


@pytest.mark.parametrize("n", [2, 5])
def test_numbers_for_the_whole_rod_stay_one_number(n):
    """A muscle's force is one number for each fibre, on any grid."""
    rod, state = arm(n)
    muscle = jaxrod.actuation.muscle(rod, (2.0, 3.0), offsets=((0.01, 0.0),) * 2)
    finer, _ = jaxrod.resample(jaxrod.make_scene(rod, muscle), state, 8)
    np.testing.assert_array_equal(finer.effects[0].force, [[2.0], [3.0]])
