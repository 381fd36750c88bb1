"""Contact that looks at the nearest bodies alone: the same loads for less work."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.contacts.points import contact_points
from jaxrod.geometry import vectors
from jaxrod.rods.motion import motion_of
from physics.rods import deformed, difference, random_rod
from physics.shapes import BODIES, turned
from physics.touching import contact_loads, moving_arm, rubbing


def thick_arm():
    """An arm that moves among bodies, and touches some with all of its length."""
    rod, state = moving_arm()
    return replace(rod, radii=jnp.full_like(rod.radii, 0.06)), state


def scattered(kind, count=5):
    """Bodies of a kind about the arm, turned any way."""
    random = np.random.default_rng(3)
    shifts = random.uniform((-0.3, -0.3, -0.1), (0.3, 0.3, 0.7), (count, 3))
    turns = random.normal(size=(count, 3))
    body = BODIES[kind]()
    pairs = zip(turns, shifts, strict=True)
    return [turned(body, jnp.asarray(a), jnp.asarray(b)) for a, b in pairs]


near_contact = jax.jit(jaxrod.near_contact, static_argnums=3)


@jax.jit
def energy(contact, rod, state):
    return contact.energy(rod, state)


def touched(contact, rod, state):
    """The most bodies that one point of the rod touches."""

    @jax.jit
    def counts(contact, rod, state):
        found = []
        for points in contact_points(rod, contact.points_per_element):
            place = points.of_nodes(motion_of(state).position)
            reach = points.of_elements(rod.radii) * (1 + 0.5 * contact.onset)
            distances = jax.vmap(lambda body, p=place: body.surface(p)[0])(contact.body)
            found.append(jnp.max(jnp.sum(distances < reach[None], axis=0)))
        return found

    return int(max(counts(contact, rod, state)))


# One that computes as all do, and one whose surface is a function of its own.
COMMON = ("sphere", "signed distance")
KINDS = [k if k in COMMON else pytest.param(k, marks=pytest.mark.slow) for k in BODIES]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_loads_are_those_of_all_bodies_while_few_are_touched(kind):
    rod, state = thick_arm()
    everything = rubbing(scattered(kind), points_per_element=2)
    few = touched(everything, rod, state)
    assert 1 <= few < 5
    near = near_contact(everything, rod, state, few)
    for found, wanted in zip(
        contact_loads(near, rod, state),
        contact_loads(everything, rod, state),
        strict=True,
    ):
        assert jnp.max(jnp.abs(wanted)) > 0.01
        assert difference(found, wanted) < 1e-12 * jnp.max(jnp.abs(wanted))


@pytest.mark.slow
def test_what_is_not_among_the_nearest_is_not_felt():
    rod, state = thick_arm()
    sphere = BODIES["sphere"]()
    deeper = replace(sphere, radius=1.5 * sphere.radius)
    both = rubbing([sphere, deeper])
    near = near_contact(both, rod, state, 1)
    for found, wanted in zip(
        contact_loads(near, rod, state),
        contact_loads(rubbing(deeper), rod, state),
        strict=True,
    ):
        assert difference(found, wanted) < 1e-12 * jnp.max(jnp.abs(wanted))


def test_chosen_bodies_stay_until_they_are_chosen_anew():
    rod, state = moving_arm()
    away = jnp.asarray([0.0, 0.0, 3.0])
    sphere = BODIES["sphere"]()
    both = rubbing([sphere, replace(sphere, centre=sphere.centre + away)])
    near = near_contact(both, rod, state, 1)
    moved = replace(state, positions=state.positions + away[:, None])
    forces, _ = contact_loads(near, rod, moved)
    assert jnp.max(jnp.abs(forces)) == 0
    anew = near_contact(near, rod, moved, 1)
    forces, _ = contact_loads(anew, rod, moved)
    wanted, _ = contact_loads(rubbing(sphere), rod, state)
    assert difference(forces, wanted) < 1e-9 * jnp.max(jnp.abs(wanted))


@pytest.mark.slow
def test_energy_is_that_of_all_bodies():
    rod, state = thick_arm()
    everything = rubbing(scattered("sphere"))
    near = near_contact(everything, rod, state, touched(everything, rod, state))
    energies = energy(near, rod, state), energy(everything, rod, state)
    np.testing.assert_allclose(*energies, rtol=1e-12)
    assert energies[0] > 0


@pytest.mark.slow
def test_gradients_are_those_of_all_bodies():
    """Also with respect to the bodies' numbers, which are gathered for the points."""
    rod, state = thick_arm()
    everything = rubbing(scattered("sphere"), friction=0.0)
    few = touched(everything, rod, state)
    assert 1 <= few < 5

    @partial(jax.jit, static_argnums=0)
    @partial(jax.grad, argnums=(1, 2, 3))
    def slope(count, contact, rod, state):
        if count:
            contact = jaxrod.near_contact(contact, rod, state, count)
        forces = contact.loads(rod, motion_of(state)).forces
        return jnp.sum(vectors.join(forces) * jnp.asarray([[1.0], [2.0], [3.0]]))

    found = slope(few, everything, rod, state)
    wanted = slope(0, everything, rod, state)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert difference(a, b) <= 1e-11 * jnp.max(jnp.abs(b))


@pytest.mark.slow
def test_vmap_over_rods_chooses_for_each_of_them():
    rod, state = thick_arm()
    everything = rubbing(scattered("capsule"))

    @jax.jit
    def forces(shift):
        moved = replace(state, positions=state.positions + shift)
        near = jaxrod.near_contact(everything, rod, moved, 2)
        return contact_loads(near, rod, moved)[0]

    shifts = jnp.linspace(-0.2, 0.2, 5)
    many = jax.jit(jax.vmap(forces))(shifts)
    single = jnp.stack([forces(shift) for shift in shifts])
    assert difference(many, single) < 1e-12 * jnp.max(jnp.abs(single))
    assert len({float(jnp.max(jnp.abs(one))) for one in single}) > 2


@pytest.mark.slow
def test_the_stable_step_counts_the_bodies_that_are_looked_at():
    rod, state = thick_arm()
    everything = rubbing(scattered("sphere"), stiffness=1e9)
    near = near_contact(everything, rod, state, 3)
    three = rubbing(scattered("sphere")[:3], stiffness=1e9)

    def stable(contact):
        return jaxrod.stable_dt(jaxrod.make_scene(rod, contact)).dt

    assert stable(near) == stable(three) > stable(everything)


def test_a_rod_resampled_looks_at_all_bodies_again():
    rod, state = thick_arm()
    everything = rubbing(scattered("sphere"))
    near = near_contact(everything, rod, state, 3)
    again = near.resampled(rod, rod)
    assert jax.tree.structure(again) == jax.tree.structure(everything)
    # As many as there are is all of them.
    full = jaxrod.near_contact(near, rod, state, 5)
    assert jax.tree.structure(full) == jax.tree.structure(everything)


@pytest.mark.parametrize(
    ("count", "message"),
    [
        (0, "count must be at least 1, got 0"),
        (6, "count must be at most the 5 bodies, got 6"),
        (2.0, r"count must be an integer, got 2\.0"),
    ],
)
def test_impossible_counts_are_named(count, message):
    rod, state = thick_arm()
    with pytest.raises(ValueError, match=message):
        jaxrod.near_contact(rubbing(scattered("sphere")), rod, state, count)


def test_bodies_chosen_for_another_rod_are_refused():
    rod, state = thick_arm()
    near = near_contact(rubbing(scattered("sphere")), rod, state, 3)
    other, _ = random_rod(4, 5, length=0.6)
    scene = jaxrod.make_scene(other, near)
    with pytest.raises(ValueError, match=r"for 7 points of a rod, got 6: choose them"):
        jaxrod.step(scene, deformed(other, 0), 1e-5)
