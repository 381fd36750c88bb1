"""Sums over listed pairs, block by block: those over all entries at once."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry import vectors
from jaxrod.systems.contact import element_pairs
from jaxrod.systems.contact.element_pairs import (
    LEAST,
    Elements,
    NeighbourList,
    gather,
    scatter_add,
    sums_over_list,
)

ENTRIES, SIZES = 3 * LEAST + 100, (40, 30)


def some_elements(size, seed):
    random = np.random.default_rng(seed)
    first, edge = (tuple(jnp.asarray(random.normal(size=(3, size)))) for _ in range(2))
    return Elements(first=first, edge=edge, radii=first[0] ** 2, follows=edge[0])


def some_list(taken):
    """A list whose first entries are taken, and others name elements all the same."""
    random = np.random.default_rng(taken)
    own, other = (jnp.asarray(random.integers(0, n, ENTRIES), jnp.int32) for n in SIZES)
    return NeighbourList(own, other, jnp.arange(ENTRIES) < taken)


def work(own, other, there):
    """Something of both that vanishes for entries that are not taken."""
    way = vectors.subtract(own.first, other.first)
    near = jnp.exp(-vectors.dot(way, way)) * other.radii
    force = vectors.scale(jnp.where(there, near, 0), own.edge)
    return (force, None), vectors.cross(force, way)


def at_once(own, other, listed):
    on_own, on_other = work(
        gather(own, listed.own), gather(other, listed.other), listed.there
    )
    return (
        scatter_add(on_own, listed.own, SIZES[0]),
        scatter_add(on_other, listed.other, SIZES[1]),
    )


def by_blocks(own, other, listed):
    return sums_over_list(work, own, other, listed)


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, two in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-11)


ELEMENTS = some_elements(SIZES[0], 1), some_elements(SIZES[1], 2)


@pytest.mark.slow
@pytest.mark.parametrize("taken", [0, 1, LEAST, 2 * LEAST + 1, ENTRIES - 1, ENTRIES])
def test_each_entry_counts_once_however_many_are_taken(taken):
    listed = some_list(taken)
    found = jax.jit(by_blocks)(*ELEMENTS, listed)
    same(found, at_once(*ELEMENTS, listed))
    assert (float(jnp.max(jnp.abs(found[0][0][0]))) > 0) == (taken > 0)


@pytest.mark.slow
def test_slopes_both_ways_are_those_of_all_at_once():
    listed = some_list(LEAST + 7)

    def number(sums):
        def slope(elements):
            total = jax.tree.leaves(sums(*elements, listed))
            return sum(jnp.sum(jnp.sin(leaf)) for leaf in total)

        return slope

    slopes = [jax.jit(jax.grad(number(how)))(ELEMENTS) for how in (by_blocks, at_once)]
    same(*slopes)
    ways = jax.tree.map(jnp.cos, ELEMENTS)
    ahead = [
        jax.jvp(number(how), (ELEMENTS,), (ways,))[1] for how in (by_blocks, at_once)
    ]
    same(*ahead)


@pytest.mark.slow
def test_in_a_batch_lists_may_be_full_of_different_numbers():
    lists = [some_list(taken) for taken in (3, 2 * LEAST + 9)]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lists)
    found = jax.jit(jax.vmap(by_blocks, (None, None, 0)))(*ELEMENTS, together)
    for k, listed in enumerate(lists):
        same(jax.tree.map(lambda leaf, k=k: leaf[k], found), at_once(*ELEMENTS, listed))


@pytest.mark.slow
def test_a_nest_with_room_to_spare_is_that_with_little(monkeypatch):
    """Runs and their slopes, with lists of one block and of many."""
    monkeypatch.setattr(element_pairs, "LEAST", 32)

    def one(start):
        made, state = jaxrod.straight_rod(
            4,
            length=0.3,
            radius=0.02,
            density=1e3,
            youngs_modulus=1e5,
            start=start,
            direction=(1.0, 0.3, 0.0),
            dtype=jnp.float64,
        )
        return jaxrod.make_scene(made, jaxrod.gravity()), state

    scenes, state = jax.vmap(one)(jnp.linspace(0, 0.2, 8)[:, None] * jnp.ones((1, 3)))

    def ended(pairs):
        lists = jaxrod.systems.neighbour_lists(
            refresh_every=4, skin=1.0, pairs=pairs, candidates=600, cell_slots=0
        )
        touch = {"stiffness": 100.0, "damping": 0.05, "friction": 0.3}
        contact = jaxrod.systems.crossing_contact("rods", **touch, lists=lists)
        system = jaxrod.make_system({"rods": scenes}, contact, state={"rods": state})

        def deep(speed):
            moving = {"rods": replace(state, velocities=state.velocities + speed)}
            after = jaxrod.advance(system, moving, 1e-5, 12)
            return jnp.sum(after["rods"].positions ** 2), after["neighbours"]

        return jax.jit(jax.value_and_grad(deep, has_aux=True))(0.1)

    (value, record), slope = ended(500)
    (other, short), steep = ended(int(record.used))
    assert not record.overflow and not short.overflow
    assert float(record.used) > 40
    assert float(value) == pytest.approx(float(other), rel=1e-13)
    assert float(slope) == pytest.approx(float(steep), rel=1e-10)
    # One entry too few is told.
    assert ended(int(record.used) - 1)[0][1].overflow
