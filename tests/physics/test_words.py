"""Rods, states and scenes print as one short line, whatever their leaves are."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

MOST = 200


def made(modulus=1e7):
    return jaxrod.straight_rod(
        20, length=1.0, radius=0.05, density=1000.0, youngs_modulus=modulus
    )


def scene_of(rod, start):
    return jaxrod.make_scene(
        rod, jaxrod.clamp(start), jaxrod.gravity(), jaxrod.exponential_damping(4.0)
    )


def test_a_rod_says_its_sizes_and_material():
    rod, start = made()
    assert repr(rod) == (
        "Rod(20 elements, 1 m, radius 0.05 m, E 10 MPa, 1000 kg/m^3, float64)"
    )
    assert repr(start) == (
        "RodState(20 elements, tip at (0, 0, 1) m, at rest, float64)"
    )
    assert repr(scene_of(rod, start)) == (
        f"Scene({rod!r}, Clamp, Gravity, ExponentialDamping, Consistent)"
    )


@pytest.mark.slow
def test_a_batch_says_its_shape_and_ranges():
    moduli = jnp.linspace(1e6, 2e6, 6).reshape(2, 3)
    rods, starts = jax.vmap(jax.vmap(made))(moduli)
    assert "E 1 to 2 MPa" in repr(rods) and "batch 2x3" in repr(rods)
    assert "batch 2x3" in repr(starts) and "tip" not in repr(starts)
    moving = jaxrod.advance(scene_of(*made()), made()[1], 1e-4, 50)
    assert "up to" in repr(moving)


def seen_in(transformation):
    """What is printed of a rod, its state and a scene inside a transformation."""
    said = []

    def look(modulus):
        rod, start = made(modulus)
        said.extend(map(repr, (rod, start, scene_of(rod, start))))
        return jnp.sum(rod.bend_twist_stiffness)

    transformation(look)
    return said


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "transformation",
    [
        lambda f: jax.jit(f)(1e7),
        lambda f: jax.grad(f)(1e7),
        lambda f: jax.vmap(f)(jnp.array([1e6, 1e7])),
        lambda f: jax.jit(jax.vmap(jax.grad(f)))(jnp.array([1e6, 1e7])),
        lambda f: jax.eval_shape(f, 1e7),
    ],
)
def test_inside_transformations_what_is_known_is_said(transformation):
    for said in seen_in(transformation):
        assert "20 elements" in said
        assert len(said) <= MOST


@pytest.mark.parametrize("leaf", [None, 0.5, object(), "x", np.zeros(0), np.nan])
def test_nothing_that_a_leaf_may_be_raises(leaf):
    everything = (*made(), scene_of(*made()))
    for tree in everything:
        strange = jax.tree.map(lambda _: leaf, tree)
        assert len(repr(strange)) <= MOST
        shapes = jax.eval_shape(lambda tree=tree: tree)
        assert len(repr(shapes)) <= MOST
    assert "float64" in repr(jax.eval_shape(lambda: everything)[0])


def test_deleted_arrays_and_numbers_that_are_none_are_said():
    rod, start = made()
    gone = jnp.array(rod.radii)
    gone.delete()
    assert "20 elements" in repr(dataclasses.replace(rod, radii=gone))
    broken = jax.tree.map(lambda leaf: leaf * np.nan, start)
    assert "nan" in repr(broken)
