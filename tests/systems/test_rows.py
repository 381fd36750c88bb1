"""Entries of rows, against numpy's indexing, in each of the ways they are reached."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.systems.joints.places import Indices, gather, scatter_add, scatter_set

SIZE = 60
INDICES = {
    "one": [7],
    "all": list(range(SIZE)),
    "a stretch": list(range(20, 41)),
    "stretches": [*range(30, 45), *range(3, 9), *range(58, 60)],
    "few": [50, 3, 17],
    "backwards": list(range(30, 10, -1)),
    "many": list(np.random.default_rng(0).permutation(SIZE)[:40]),
}
REPEATED = {
    "stretches over each other": [*range(10, 30), *range(12, 32)],
    "few, one twice": [5, 9, 5],
    "many, some often": list(np.random.default_rng(1).integers(0, SIZE, 200)),
}
ROW = jnp.asarray(np.random.default_rng(2).normal(size=SIZE))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", [*INDICES, *REPEATED])
def test_picked(name: str) -> None:
    """What numpy picks, bit for bit, of one row and of a batch."""
    index = (INDICES | REPEATED)[name]
    found = jax.jit(gather, static_argnums=1)(ROW, Indices(index))
    np.testing.assert_array_equal(found, np.asarray(ROW)[index])
    batch = jnp.stack([ROW, -ROW])
    both = jax.vmap(lambda row: gather(row, Indices(index)))(batch)
    np.testing.assert_array_equal(both, np.asarray(batch)[:, index])


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", INDICES)
def test_replaced(name: str) -> None:
    """What numpy assigns, bit for bit."""
    index = INDICES[name]
    values = jnp.arange(len(index)) + 100.0
    expected = np.array(ROW)
    expected[index] = values
    found = jax.jit(scatter_set, static_argnums=1)(ROW, Indices(index), values)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", [*INDICES, *REPEATED])
def test_summed(name: str) -> None:
    """What numpy adds up, also where entries are named several times."""
    index = (INDICES | REPEATED)[name]
    values = jnp.asarray(np.random.default_rng(3).normal(size=len(index)))
    expected = np.zeros(SIZE)
    np.add.at(expected, index, values)
    found = jax.jit(scatter_add, static_argnums=(1, 2))(values, Indices(index), SIZE)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", [*INDICES, *REPEATED])
def test_transposed(name: str) -> None:
    """Picking and adding up are each other's transpose."""
    index = Indices((INDICES | REPEATED)[name])
    values = jnp.asarray(np.random.default_rng(4).normal(size=len(index)))
    _, back = jax.vjp(lambda row: gather(row, index), ROW)
    np.testing.assert_allclose(
        back(values)[0], scatter_add(values, index, SIZE), atol=1e-14
    )
    _, back = jax.vjp(lambda row: scatter_add(row, index, SIZE), values)
    np.testing.assert_array_equal(back(ROW)[0], gather(ROW, index))
