"""A batch that goes one after the other is a loop, under every transformation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.stepping.loops import one_by_one


def halved_or_squared(x, count):
    """A branch by each system's own number, and a count of steps that is none."""
    step = lambda x: jax.lax.cond(
        jnp.sum(x) > 1, lambda x: 0.5 * x, lambda x: x * x + 0.1, x
    )
    return {"x": jax.lax.fori_loop(0, count, lambda _, x: step(x), x), "count": count}


def apart(x, count):
    return one_by_one(halved_or_squared, x, count)


ROWS = jnp.asarray(np.linspace(-1.0, 2.0, 12).reshape(4, 3))


@pytest.mark.parametrize("count_axis", [None, 0])
def test_a_batch_is_a_loop(count_axis):
    counts = 3 if count_axis is None else jnp.asarray([0, 1, 2, 5])
    together = jax.vmap(apart, in_axes=(0, count_axis))(ROWS, counts)
    for k, row in enumerate(ROWS):
        count = counts if count_axis is None else counts[k]
        alone = halved_or_squared(row, count)
        np.testing.assert_array_equal(together["x"][k], alone["x"])
        assert together["count"][k] == count


def test_batches_of_batches_and_rows_along_another_axis():
    blocks = ROWS.reshape(2, 2, 3)
    nested = jax.jit(jax.vmap(jax.vmap(lambda x: apart(x, 3)["x"])))(blocks)
    plain = jax.vmap(lambda x: halved_or_squared(x, 3)["x"])(ROWS)
    np.testing.assert_allclose(nested.reshape(4, 3), plain, rtol=1e-15)
    across = jax.vmap(lambda x: apart(x, 3)["x"], in_axes=1, out_axes=1)(ROWS.T)
    np.testing.assert_allclose(across.T, plain, rtol=1e-15)


def test_branches_stay_branches_under_vmap():
    kept = str(jax.make_jaxpr(jax.vmap(lambda x: apart(x, 3)["x"]))(ROWS))
    lost = str(jax.make_jaxpr(jax.vmap(lambda x: halved_or_squared(x, 3)["x"]))(ROWS))
    # Programs for CPUs have branches; those for other devices choose between results.
    assert ("cond[" in kept) == (jax.default_backend() == "cpu")
    assert "cond[" not in lost


def summed(way):
    def total(x):
        made = way(lambda x: jnp.sin(x) * jnp.where(x > 0, x, 2 * x), x)
        return jnp.sum(made * jnp.arange(3.0))

    return total


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("order", ["batch of slopes", "slope of a batch", "forward"])
def test_derivatives_are_those_of_the_function(order):
    found, expected = (
        {
            "batch of slopes": jax.vmap(jax.grad(total)),
            "slope of a batch": jax.grad(lambda x, t=total: jnp.sum(jax.vmap(t)(x))),
            "forward": lambda x, t=total: jax.jvp(jax.vmap(t), (x,), (x,))[1],
        }[order](ROWS)
        for total in (summed(one_by_one), summed(lambda f, x: f(x)))
    )
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_whole_numbers_have_no_slope():
    slope = jax.grad(lambda x: jnp.sum(one_by_one(lambda x, k: x * k, x, 3)))(ROWS[0])
    np.testing.assert_array_equal(slope, 3.0)


def test_what_the_function_holds_is_batched_and_differentiated_too():
    def held(y, k):
        return one_by_one(lambda x: {"x": x * y, "k": k}, ROWS[0])

    counts = jnp.arange(4)
    made = jax.jit(jax.vmap(held))(ROWS, counts)
    np.testing.assert_array_equal(made["x"], ROWS * ROWS[:1])
    np.testing.assert_array_equal(made["k"], counts)
    slopes = jax.grad(lambda y: jnp.sum(jax.vmap(held)(y, counts)["x"]))(ROWS)
    np.testing.assert_array_equal(slopes, jnp.tile(ROWS[0], (4, 1)))
    alone = jax.grad(lambda y: jnp.sum(held(y, 0)["x"]))(ROWS[1])
    np.testing.assert_array_equal(alone, ROWS[0])
