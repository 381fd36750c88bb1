"""Loops over rows: entries not in use are skipped, and pieces and scans are right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.rows.kernels import cycles_kernel
from jaxrod.lanes.run_spec import LoopBody, RunSpec
from jaxrod.lanes.true_entries import true_entries

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


def shrunk(matrices, limit, x, count):
    """A step with a loop whose length depends on numbers, and a scan in each round."""

    def goes_on(carry):
        y, rounds, _ = carry
        return (jnp.sum(y * y) > limit[0]) & (rounds < 40)

    def once(carry):
        y, rounds, _ = carry

        def turn(c, row):
            matrix, flag = row
            c = jnp.where(flag, 1, -1) * jnp.tanh(jnp.sum(matrix * c[None], axis=1))
            return c, (jnp.sum(c), c[::-1])

        signs = jnp.arange(len(matrices)) % 3 > 0
        z, (sums, last) = jax.lax.scan(turn, y, (matrices, signs), reverse=True)
        return 0.7 * y + 1e-4 * (z + sums[2] * last[1]), rounds + 1, y[0] > 0

    y, rounds, flag = jax.lax.while_loop(goes_on, once, (x, 0, False))
    return [x * 1.2 + jnp.where(flag, y, 2 * y), count + rounds]


def given_to_shrunk(dtype, scale=1.0):
    rng = np.random.default_rng(3)
    matrices = jnp.asarray(rng.normal(size=(70, 6, 6)) / 2, dtype)
    limit = jnp.full(1, 1e-3, dtype)
    x = jnp.asarray(scale * rng.normal(size=6), dtype)
    return matrices, limit, x, jnp.int32(0)


def compared_with_xla(function, given, n_constants, batch=None):
    """Results by rows and by XLA; `batch` is a function applied to the run."""
    body = LoopBody(jax.make_jaxpr(function)(*given), n_constants)
    kernel = cycles_kernel(body, (False,) * n_constants, checkpoints=False)
    found = []
    for mode in ("rows", "never"):
        use_lanes(mode)
        run = lambda *a: cycles_p.bind(jnp.int32(3), *a, spec=RunSpec(body, None))
        found.append(jax.jit(run if batch is None else batch(run))(*given))
        assert mode == "never" or lane_choices()[-1].taken
    return kernel, *found


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_loop_of_unknown_length_is_a_function_of_its_own(dtype):
    given = given_to_shrunk(dtype)
    kernel, rows, xla = compared_with_xla(shrunk, given, 2)
    assert "@loop1_round" in kernel.text and "@loop1_loop1_round" in kernel.text
    assert 3 < int(xla[1]) < 120
    np.testing.assert_allclose(
        rows[0], xla[0], rtol=1e-5 if dtype == "float32" else 1e-12
    )
    assert int(rows[1]) == int(xla[1])


def test_a_loop_may_have_no_round_and_each_scene_its_own_number():
    given = given_to_shrunk("float64")
    many = lambda run: jax.vmap(run, in_axes=(None, None, 0, 0))
    sizes = jnp.asarray([0.0, 1e-3, 1.0, 1e3])
    spread = (*given[:2], sizes[:, None] * given[2][None], jnp.zeros(4, jnp.int32))
    body = LoopBody(jax.make_jaxpr(shrunk)(*given), 2)
    found = []
    for mode in ("rows", "never"):
        use_lanes(mode)
        run = lambda *a: cycles_p.bind(jnp.int32(1), *a, spec=RunSpec(body, None))
        found.append(jax.jit(many(run))(*spread))
    (rows, counts), (xla, same) = found
    assert same[0] == 0 and len(set(same.tolist())) > 2
    assert counts.tolist() == same.tolist()
    np.testing.assert_allclose(rows, xla, rtol=1e-12, atol=1e-15)


def test_a_loop_that_ends_at_a_number_that_is_not_finite_ends():
    matrices, limit, x, count = given_to_shrunk("float64")
    _, rows, xla = compared_with_xla(shrunk, (matrices, limit, x * jnp.nan, count), 2)
    assert np.isnan(rows[0]).all() and np.isnan(xla[0]).all()
    assert int(rows[1]) == int(xla[1]) == 0


def of_constants_alone(matrices, x):
    """A step with a loop that only depends on constants, and one without results."""
    mean = jnp.mean(matrices, axis=0)
    halve = lambda c: 0.5 * (c + mean)
    fixed = jax.lax.while_loop(
        lambda c: jnp.max(jnp.abs(c - mean)) > 1e-3, halve, 0 * mean
    )
    jax.lax.while_loop(lambda c: jnp.any(c > 1), lambda c: 0.5 * c, x)
    return [jnp.sin(x) + jnp.sum(fixed, axis=1)]


def test_a_loop_knows_only_constants_of_which_all_numbers_are_known():
    def grown(scale, x):
        half_known = jnp.stack([jnp.asarray(2.0), 2 * scale])
        more = lambda y: y + 1 + half_known[1] + 0 * half_known[0]
        return [jax.lax.while_loop(lambda y: y < 9, more, x)]

    given = jnp.asarray(2.5), jnp.asarray(0.0)
    _, rows, xla = compared_with_xla(grown, given, 1)
    assert float(rows[0]) == float(xla[0])


def test_a_loop_over_constants_is_computed_once():
    matrices, _, x, _ = given_to_shrunk("float64")
    kernel, rows, xla = compared_with_xla(of_constants_alone, (matrices, x), 1)
    step = kernel.text[kernel.text.index("define internal void @step") :]
    step = step[: step.index("ret void")]
    assert "@loop" not in step
    np.testing.assert_allclose(rows[0], xla[0], rtol=1e-12)


@pytest.mark.parametrize("way", ["always", "loops"])
def test_lanes_leave_a_loop_of_unknown_length_to_xla(way):
    given = given_to_shrunk("float64")
    body = LoopBody(jax.make_jaxpr(shrunk)(*given), 2)
    use_lanes(way)
    run = lambda *a: cycles_p.bind(jnp.int32(1), *a, spec=RunSpec(body, None))
    many = jax.vmap(run, in_axes=(None, None, 0, None))
    jax.jit(many)(*given[:2], jnp.stack([given[2]] * 9), given[3])
    choice = lane_choices()[-1]
    assert not choice.taken and "length depends on numbers" in choice.why


def sorted_rows(keys, numbers, total):
    """A step that sorts keys and what belongs to them."""
    order = jnp.argsort(keys)
    first, more = jax.lax.sort((keys, numbers), num_keys=1)
    return [jnp.roll(first, 1), numbers, total + numbers[order] + 2 * jnp.cumsum(more)]


@pytest.mark.parametrize("n", [1, 3, 7, 1000])
def test_rows_sort_by_whole_numbers_and_keep_the_order_of_equals(n):
    rng = np.random.default_rng(n)
    keys = rng.integers(-4, 4, n) * rng.choice([1, 77777, 2**28], n)
    keys[0] = -(2**31)
    given = (jnp.asarray(keys, jnp.int32), jnp.asarray(rng.normal(size=n)))
    given = (*given, jnp.zeros(n))
    kernel, rows, xla = compared_with_xla(sorted_rows, given, 0)
    assert kernel.text.count("define internal void @ordered") == 1
    np.testing.assert_array_equal(rows[0], xla[0])
    np.testing.assert_allclose(rows[2], xla[2], rtol=1e-12, atol=1e-12)


def test_rows_leave_other_sorts_to_xla():
    for keys in (jnp.zeros(9), jnp.zeros((9, 9), jnp.int32)):
        body = LoopBody(jax.make_jaxpr(lambda x: [jnp.sort(x)])(keys), 0)
        use_lanes("rows")
        run = lambda x, b=body: cycles_p.bind(jnp.int32(1), x, spec=RunSpec(b, None))
        jax.jit(run)(keys)
        assert lane_choices()[-1].why == "lanes have no 'sort'"


@pytest.mark.parametrize(
    "n, size, share",
    [
        *((1, 3, 1.0), (63, 20, 0.3), (64, 64, 1.0), (301, 400, 0.3)),
        *((900, 7, 0.3), (300, 90, 0.0)),
    ],
)
def test_true_entries_are_listed_in_order(n, size, share):
    """One function lists them in rows; XLA has two ways, also in batches."""
    numbers = np.random.default_rng(n).random(n) + 0.001 - share
    expected = np.zeros(size, np.int32)
    found = np.flatnonzero(numbers < 0)[:size]
    expected[: len(found)] = found

    def listed(x, _):
        return [x, true_entries(x < 0, size)]

    given = (jnp.asarray(numbers), jnp.zeros(size, jnp.int32))
    kernel, rows, xla = compared_with_xla(listed, given, 0)
    assert kernel.text.count("define internal void @listed") == 1
    batched = jax.vmap(lambda x: true_entries(x < 0, size))(given[0][None])
    for made in (rows[1], xla[1], batched[0]):
        np.testing.assert_array_equal(made, expected)


@pytest.mark.parametrize("width", [4, 9])
@pytest.mark.parametrize("operation", ["set", "add"])
def test_one_row_at_a_known_index_is_written_whole(width, operation):
    """Indices with an axis of length one; an index outside drops the row."""

    def changed(table, row, *totals):
        for index in ([1], [-1], [7]):
            at = getattr(table.at[jnp.array(index)], operation)(row[None])
            totals = [*totals[1:], totals[0] + at]
        return [row, *totals]

    rng = np.random.default_rng(0)
    table, row = (jnp.asarray(rng.normal(size=shape)) for shape in ((3, width), width))
    given = (table, row, *3 * [jnp.zeros((3, width))])
    _, rows, xla = compared_with_xla(changed, given, 1)
    for a, b in zip(rows, xla, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("step", [1, 2])
def test_rows_load_consecutive_numbers_together(step):
    """A window at a traced place is read by vectors; one with gaps is gathered."""

    def windows(table, places, total):
        cut = lambda at: jax.lax.dynamic_slice(table, (at,), (40,))
        if step == 2:
            cut = lambda at: table[jnp.clip(at, 0, 59) + 2 * jnp.arange(20)]
        return [table, places, total + jax.vmap(cut)(places)]

    table = jnp.asarray(np.random.default_rng(0).normal(size=99))
    places = jnp.asarray([-7, 0, 1, 13, 58, 59, 60, 98], jnp.int32)
    given = (table, places, jnp.zeros((8, 40 // step)))
    kernel, rows, xla = compared_with_xla(windows, given, 0)
    assert ("masked.gather" in kernel.text) == (step == 2)
    np.testing.assert_array_equal(rows[2], xla[2])


def test_a_loop_in_a_branch_that_is_not_chosen_never_runs():
    """XLA runs it: rows compute all branches, and this loop never ends for x <= 0."""

    def halved(x):
        down = lambda y: jax.lax.while_loop(lambda z: z < 1, lambda z: 2 * z, y)
        return [jax.lax.cond(x > 0, down, lambda y: y, x)]

    for x, expected in ((jnp.asarray(0.3), 1.2), (jnp.asarray(-0.3), -0.3)):
        body = LoopBody(jax.make_jaxpr(halved)(x), 0)
        use_lanes("rows")
        run = lambda y, b=body: cycles_p.bind(jnp.int32(1), y, spec=RunSpec(b, None))
        assert float(jax.jit(run)(x)[0]) == expected
        assert "branch with a loop" in lane_choices()[-1].why
