"""Closest points of pieces of smooth axes: stationary, and differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.geometry import vectors
from jaxrod.systems.contact.element_pairs import Elements
from jaxrod.systems.contact.segment_distance import (
    apart,
    nearest_on_curves,
    nearest_places,
    nearest_to_node,
)

PAIRS = 2000


def pieces(key):
    """Two pieces of unit length a few hundredths to a third apart, at all angles."""
    keys = jax.random.split(key, 5)
    angle = 10 ** jax.random.uniform(keys[0], minval=-2.4, maxval=0.2)
    bend = 10 ** jax.random.uniform(keys[1], minval=-3, maxval=-0.7)
    away = jax.random.uniform(keys[2], minval=0.02, maxval=0.35)
    start = jax.random.uniform(keys[3], (2,), minval=-0.6, maxval=0.6)
    bulges = bend * jax.random.normal(keys[4], (2, 2, 3))
    return {
        "way": jnp.array([*start, away]),
        "own": jnp.array([1.0, 0.0, 0.0]),
        "other": jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0]),
        "bulges": bulges,
    }


def elements(edge, bulges):
    """A piece of a smooth axis, without anything that its shape does not need."""
    one = jnp.ones(())
    return Elements(
        first=(0 * one,) * 3,
        edge=tuple(edge),
        radii=one,
        follows=one,
        bulges=(tuple(bulges[0]), tuple(bulges[1])),
    )


def nearest(pair):
    """Closest points, and the derivatives of half the squared distance at them."""
    way, own, other = (tuple(pair[k]) for k in ("way", "own", "other"))
    first = elements(pair["own"], pair["bulges"][0])
    second = elements(pair["other"], pair["bulges"][1])
    start = nearest_places(way, own, other)[:2]
    s, t = nearest_on_curves(way, first, second, start)
    between = apart(way, first, second, (s, t))
    slopes = (
        vectors.dot(between, first.tangent(s)),
        -vectors.dot(between, second.tangent(t)),
    )
    return jnp.stack((s, t)), jnp.stack(slopes)


def test_closest_points_of_curves_are_stationary_in_the_unit_square(record):
    """Slope inside; on the border nothing nearer inwards. Nearly parallel ones too."""
    keys = jax.random.split(jax.random.key(0), PAIRS)
    places, slopes = jax.jit(jax.vmap(lambda key: nearest(pieces(key))))(keys)
    places, slopes = np.asarray(places), np.asarray(slopes)
    left = np.where(places <= 0, np.minimum(slopes, 0), slopes)
    left = np.where(places >= 1, np.maximum(left, 0), left)
    record(
        "closest points of 2,000 pairs of curves, angles from 4 mrad",
        "share that is not stationary to 1e-9",
        np.mean(np.max(np.abs(left), axis=1) > 1e-9),
        at_most=0.002,
    )


def test_the_point_closest_to_a_node_is_stationary_and_moves_with_the_node():
    """The slope is zero inside, and the derivative that of the implicit function."""

    def node_of(pair):
        return pair["way"] + pair["own"]

    def nearest_point(pair):
        way, own, other = (tuple(pair[k]) for k in ("way", "own", "other"))
        first = elements(pair["own"], pair["bulges"][0])
        second = elements(pair["other"], pair["bulges"][1])
        start = nearest_places(way, own, other)[1]
        return nearest_to_node(way, first, second, start), second

    def tried(key):
        pair = pieces(key)
        t, second = nearest_point(pair)
        r = vectors.subtract(tuple(node_of(pair)), second.on_axis(t))
        v = second.tangent(t)
        moved = lambda way: nearest_point({**pair, "way": way})[0]
        stiff = vectors.dot(v, v) - vectors.dot(r, second.bend(t))
        expected = jnp.stack(v) / stiff
        return t, vectors.dot(r, v), jax.grad(moved)(pair["way"]), expected, stiff

    keys = jax.random.split(jax.random.key(2), PAIRS)
    found = jax.jit(jax.vmap(tried))(keys)
    t, slope, derivative, expected, stiff = map(np.asarray, found)
    inside = (t > 0) & (t < 1) & (stiff > 0.6)
    assert np.sum(inside) > 100
    assert np.mean(np.abs(slope[inside]) > 1e-9) < 0.002
    wrong = np.abs(derivative - expected)[inside] > 1e-6
    assert np.mean(np.any(wrong, axis=1)) < 0.002


@pytest.mark.slow
def test_derivatives_of_closest_points_of_curves_are_those_of_differences(record):
    """Along random changes of both pieces, where both differences agree."""

    def compared(key):
        pair = pieces(key)
        leaves, tree = jax.tree.flatten(pair)
        keys = jax.random.split(jax.random.fold_in(key, 1), len(leaves))
        change = [
            jax.random.normal(k, leaf.shape)
            for k, leaf in zip(keys, leaves, strict=True)
        ]
        change = jax.tree.unflatten(tree, change)
        _, found = jax.jvp(lambda pair: nearest(pair)[0], (pair,), (change,))

        def moved(h):
            return nearest(jax.tree.map(lambda x, d: x + h * d, pair, change))[0]

        def difference(h):
            return (moved(h) - moved(-h)) / (2 * h)

        return found, difference(1e-6), difference(3e-7)

    keys = jax.random.split(jax.random.key(1), PAIRS)
    found, coarse, fine = map(np.asarray, jax.jit(jax.vmap(compared))(keys))
    size = np.linalg.norm(fine, axis=1) + 1e-3
    smooth = np.linalg.norm(coarse - fine, axis=1) < 1e-5 * size
    assert np.mean(smooth) > 0.9
    record(
        "closest points of 2,000 pairs of curves, angles from 4 mrad: derivative",
        "share that differs by 1e-4 from central differences",
        np.mean((np.linalg.norm(found - fine, axis=1) > 1e-4 * size)[smooth]),
        at_most=0.002,
    )
