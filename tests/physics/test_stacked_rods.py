"""What is derived from stacked rods and states is each one's own, with their axes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import deformed, random_rod

# Axes of as many as there are components, elements and nodes: those that a mistaken
# axis would take without a word.
STACKS = [(3,), *(pytest.param(s, marks=pytest.mark.slow) for s in ((4,), (2, 3)))]


def properties(kind):
    """Names of what is derived from a class's fields."""
    named = vars(kind).items()
    return [name for name, value in named if isinstance(value, property)]


def uneven_rods(count, changed):
    """Rods of three elements, each with its own numbers, and deformed states."""
    for seed in range(count):
        rod, _ = random_rod(seed, n_elements=3)
        yield changed(rod), deformed(rod, seed, speed=1.0)


def flat(rod):
    """The rod with sections that are not alike about d1 and d2."""
    second = rod.rotary_inertia[0] * jnp.asarray([0.5, 2.0, 1.0])
    inertia = jnp.stack([rod.rotary_inertia[0], second, rod.rotary_inertia[1]])
    return replace(rod, rotary_inertia=inertia)


def series(rod):
    """The rod with joints that are springs one after the other."""
    return replace(rod, joint_mean="series")


def in_stack(trees, shape):
    """Trees with equal shapes in one, under leading axes."""
    return jax.tree.map(
        lambda *leaves: jnp.stack(leaves).reshape(*shape, *leaves[0].shape), *trees
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("changed", [lambda rod: rod, flat, series])
@pytest.mark.parametrize("shape", STACKS)
def test_each_of_stacked_rods_has_its_own_numbers(shape, changed):
    pairs = list(uneven_rods(int(np.prod(shape)), changed))
    derived = {
        jaxrod.Rod: properties(jaxrod.Rod),
        jaxrod.RodState: ["layout", "rates", "directors", "tip"],
    }
    assert len(derived[jaxrod.Rod]) == 11
    assert properties(jaxrod.RodState) == derived[jaxrod.RodState]
    for alone in zip(*pairs, strict=True):
        together = in_stack(alone, shape)
        for name in derived[type(together)]:
            if name == "rates":  # Two of the fields themselves.
                continue
            own = [getattr(one, name) for one in alone]
            found = getattr(together, name)
            if name == "batch_shape":
                assert (found, set(own)) == (shape, {()})
            elif name == "layout":
                assert found.n_elements == 3
            elif name in ("n_elements", "is_round"):
                assert {found} == set(own)
            else:
                expected = np.reshape(own, (*shape, *np.shape(own[0])))
                assert found.shape == expected.shape, name
                np.testing.assert_allclose(found, expected, rtol=1e-15, err_msg=name)
