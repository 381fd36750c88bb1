"""Elementary functions of vectors, against the C library's in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.run_spec import LoopBody, RunSpec


def by_lanes(function, numbers):
    """A function of numbers, each in a lane of its own."""
    closed = jax.make_jaxpr(function)(numbers[0])
    spec = RunSpec(LoopBody(closed, 0), None)
    run = jax.jit(jax.vmap(lambda x: cycles_p.bind(jnp.int32(1), x, spec=spec)[0]))
    return np.asarray(run(numbers))


def everywhere(least, most, count=4000):
    """Numbers of both signs and all sizes between two, and zero."""
    sizes = np.geomspace(least, most, count)
    return np.concatenate([[0.0, -0.0], sizes, -sizes])


def units(found, expected, dtype):
    """The largest error in units of the last place."""
    exact = np.asarray(expected, dtype)
    spacing = np.spacing(np.maximum(np.abs(exact), np.finfo(dtype).tiny))
    return np.max(np.abs(found.astype(float) - np.asarray(expected)) / spacing)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    ("name", "reference", "largest", "most"),
    [
        ("sin", np.sin, 1e30, 1.5),
        ("cos", np.cos, 1e30, 1.5),
        ("exp", np.exp, 700.0, 1.5),
        ("tanh", np.tanh, 50.0, 2.5),
    ],
)
def test_a_function_is_right_over_its_whole_range(
    name, reference, largest, most, dtype
):
    largest = min(largest, 85.0) if (name, dtype) == ("exp", "float32") else largest
    numbers = everywhere(1e-30, largest).astype(dtype)
    found = by_lanes(getattr(lax, name), jnp.asarray(numbers))
    exact = reference(numbers.astype(np.longdouble)).astype(float)
    assert units(found, exact, dtype) <= most


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", ["sin", "cos", "exp", "tanh", "log", "sqrt", "rsqrt"])
def test_what_is_not_finite_goes_through_as_in_the_c_library(name, dtype):
    numbers = jnp.asarray([jnp.nan, jnp.inf, -jnp.inf, 0.0, 1e5, -1e5], dtype)
    found = by_lanes(getattr(lax, name), numbers)
    expected = np.asarray(getattr(lax, name)(numbers))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["max", "min"])
def test_an_extreme_is_not_a_number_if_one_of_two_is_not(name):
    function = getattr(lax, name)
    numbers = jnp.asarray([[jnp.nan, 1.0], [1.0, jnp.nan], [1.0, 2.0], [2.0, 1.0]])
    closed = jax.make_jaxpr(lambda x: jnp.full(2, function(x[0], x[1])))(numbers[0])
    spec = RunSpec(LoopBody(closed, 0), None)
    run = jax.jit(jax.vmap(lambda x: cycles_p.bind(jnp.int32(1), x, spec=spec)[0]))
    expected = np.stack([np.full(2, function(*row)) for row in numbers])
    np.testing.assert_array_equal(np.asarray(run(numbers)), expected)


def test_whole_numbers_are_divided_as_xla_defines_it():
    rows = jnp.asarray([[7, 2], [-7, 2], [7, 0], [-(2**31), -1], [5, -3]], jnp.int32)
    for function in (lax.div, lax.rem):
        pair = jax.make_jaxpr(lambda x, f=function: jnp.full(2, f(x[0], x[1])))(rows[0])
        spec = RunSpec(LoopBody(pair, 0), None)
        run = jax.jit(
            jax.vmap(lambda x, p=spec: cycles_p.bind(jnp.int32(1), x, spec=p)[0])
        )
        expected = jax.jit(jax.vmap(lambda x, f=function: f(x[0], x[1])))(rows)
        np.testing.assert_array_equal(np.asarray(run(rows))[:, 0], np.asarray(expected))
