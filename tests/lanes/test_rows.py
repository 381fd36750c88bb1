"""Loops over rows: entries not in use are skipped, and pieces and scans are right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.rows.kernels import cycles_kernel
from jaxrod.lanes.run_spec import LoopBody, RunSpec

LOOPS = pytest.mark.parametrize("way", ["rows", "loops"])
ENTRIES, SIZE = 37, 11


def gathered_and_scattered(table, places, there, total):
    """One step of a sum over the entries of a list, computed from gathers."""
    numbers = jnp.sin(table[places]) * (1 + table[places[::-1]])
    more = jnp.where(there, numbers, 0)
    return [total + jnp.zeros(SIZE, table.dtype).at[places].add(more)]


@pytest.mark.fast_sets(1)
@LOOPS
@pytest.mark.parametrize("used", [0, 1, 16, 36, 37, "scattered"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_sums_over_the_entries_in_use_are_those_of_xla(used, dtype, way):
    rng = np.random.default_rng(0)
    table = jnp.asarray(rng.normal(size=SIZE), dtype)
    places = jnp.asarray(rng.integers(0, SIZE, ENTRIES), jnp.int32)
    there = rng.random(ENTRIES) < 0.2 if used == "scattered" else None
    there = jnp.arange(ENTRIES) < used if there is None else jnp.asarray(there)
    given = (table, places, there, jnp.zeros(SIZE, dtype))
    body = LoopBody(jax.make_jaxpr(gathered_and_scattered)(*given), 3)
    kernel = cycles_kernel(body, (False,) * 3, checkpoints=False)
    assert "_skip:" in kernel.text
    found = []
    for mode in (way, "never"):
        use_lanes(mode)
        run = jax.jit(lambda *a: cycles_p.bind(*a, spec=RunSpec(body, None)))
        found.append(run(jnp.int32(3), *given)[0])
        assert mode == "never" or lane_choices()[-1].taken
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(*found, rtol=tolerance, atol=tolerance)


def windows(places, table, rows):
    """Sums over pieces of arrays that begin at traced places, some of them outside."""
    pieces = jax.vmap(lambda at: jax.lax.dynamic_slice(table, (at,), (3,)))(places)
    corner = lambda at: jax.lax.dynamic_slice(rows, (at, at // 9), (2, 3))
    both = jax.vmap(corner)(places)
    weights = jnp.asarray([1.0, 2.0, 4.0], table.dtype)
    return [
        jnp.sum(pieces * weights[None], axis=1),
        jnp.sum(both * weights[None, None], axis=2),
    ]


@pytest.mark.fast_sets(1)
@LOOPS
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_gathers_of_pieces_are_those_of_xla(dtype, way):
    rng = np.random.default_rng(0)
    table = jnp.asarray(rng.normal(size=SIZE), dtype)
    rows = jnp.asarray(rng.normal(size=(5, 4)), dtype)
    places = jnp.asarray([-3, 0, 1, 2, 4, 8, 9, 30], jnp.int32)
    given = places, table, rows
    slots = [jnp.zeros(8, dtype), jnp.zeros((8, 2), dtype)]
    step = lambda *arrays: windows(*arrays[:3])
    body = LoopBody(jax.make_jaxpr(step)(*given, *slots), 3)
    use_lanes(way)
    run = jax.jit(lambda *a: cycles_p.bind(*a, spec=RunSpec(body, None)))
    found = run(jnp.int32(1), *given, *slots)
    assert lane_choices()[-1].taken, lane_choices()[-1].why
    for made, expected in zip(found, windows(*given), strict=True):
        np.testing.assert_allclose(made, expected, rtol=1e-6)


def falling(above, below, backwards):
    """A loop forwards along pairs of numbers, and one back along what it keeps."""

    def eliminate(carry, row):
        one, two = row
        pivot = one / (1 + one * carry[0])
        carry = [two - pivot * carry[1], carry[1] * pivot + 0.5]
        return carry, (pivot, carry[1] * two)

    def substitute(after, row):
        found = row[0] - row[1] * after
        return found, found

    pairs = jnp.stack([above, below[::-1]], axis=1), jnp.stack([below, above], axis=1)
    first = [jnp.ones(2, above.dtype), 0.5 * jnp.ones(2, above.dtype)]
    last, kept = jax.lax.scan(eliminate, first, pairs, reverse=backwards)
    _, found = jax.lax.scan(substitute, last[0], kept, reverse=not backwards)
    return [found[:, 0] + found[::-1, 1] * last[1][0], below]


@pytest.mark.fast_sets(1)
@LOOPS
@pytest.mark.parametrize("length", [1, 2, 7, 100])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_scan_of_pairs_is_a_loop(length, dtype, way):
    """Longer than loops that are unrolled; the code is as long for any length."""
    rng = np.random.default_rng(length)
    given = [jnp.asarray(rng.uniform(0.5, 1, length), dtype) for _ in range(2)]
    step = lambda above, below: falling(above, below, length % 2 == 1)
    body = LoopBody(jax.make_jaxpr(step)(*given), 0)
    if length > 1:
        text = cycles_kernel(body, (), checkpoints=False).text
        assert text.count("fdiv") == 1
    found = []
    for mode in (way, "never"):
        use_lanes(mode)
        run = jax.jit(lambda *a: cycles_p.bind(*a, spec=RunSpec(body, 3)))
        found.append(run(jnp.int32(3), *given)[0])
        assert mode == "never" or lane_choices()[-1].taken
    tolerance = {"float32": 1e-4, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(*found, rtol=tolerance, atol=tolerance)


@pytest.mark.fast_sets(1)
@LOOPS
@pytest.mark.parametrize("shape", [(1,), (1, 7)])
def test_scans_keep_axes_of_length_one(shape, way):
    """Their results have the shapes of JAX, for a carry and rows of any shape."""
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.normal(size=shape)) for _ in "ab")

    def turn(carry, row):
        carry = 0.5 * carry + row * row
        return carry, carry * row

    def step(a, b, *_):
        made = []
        for length in (1, 2, 3):
            rows = jnp.stack([b * k for k in range(length)])
            made += jax.lax.scan(turn, a, rows, reverse=length == 2)
        made += jax.lax.scan(lambda c, row: (row, c), a, jnp.stack([a, b]))
        return [*made, *jax.lax.scan(turn, b[0], a)]

    expected = step(a, b)
    slots = [jnp.zeros_like(array) for array in expected]
    body = LoopBody(jax.make_jaxpr(step)(a, b, *slots), 2)
    use_lanes(way)
    run = jax.jit(lambda *given: cycles_p.bind(*given, spec=RunSpec(body, None)))
    found = run(jnp.int32(1), a, b, *slots)
    assert lane_choices()[-1].taken, lane_choices()[-1].why
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-13)
