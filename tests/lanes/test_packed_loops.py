"""Packed loops: sums over the entries where a mask is true are those of XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.rows import packing
from jaxrod.lanes.rows.kernels import RowPlan, cycles_kernel, next_carry
from jaxrod.lanes.rows.schedule import Schedule
from jaxrod.lanes.run_spec import LoopBody, RunSpec

TOLERANCES = {"float32": 3e-5, "float64": 1e-12}
POINTS = 5


@pytest.fixture(autouse=True)
def packed_wherever_possible(monkeypatch):
    monkeypatch.setattr(packing, "LEAST_WORK", 1)
    monkeypatch.setattr(packing, "LEAST_IN_ALL", 1)
    yield
    use_lanes("auto")


def compared(step, given, n_constants, dtype, *, packs=True, steps=3):
    """Checks that rows and XLA come to the same numbers, twice to the same bits.

    XLA computes one operation after another: with the fusion of `configure_cpu` its
    compiler (0.10.1) aborts on some of these programs.
    """
    body = LoopBody(jax.make_jaxpr(step)(*given), n_constants)
    kernel = cycles_kernel(body, (False,) * n_constants, checkpoints=False)
    assert ("_listed:" in kernel.text) == packs
    use_lanes("rows")
    run = jax.jit(lambda *a: cycles_p.bind(*a, spec=RunSpec(body, None)))
    found = [run(jnp.int32(steps), *given) for _ in range(2)]
    assert lane_choices()[-1].taken
    constants, carry = given[:n_constants], given[n_constants:]
    for _ in range(steps):
        carry = step(*constants, *carry)
    for ours, again, theirs in zip(*found, carry, strict=True):
        assert np.array_equal(ours, again)
        scale = max(1.0, float(np.max(np.abs(theirs))))
        limit = TOLERANCES[dtype] * scale
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=limit)


def law(x, y, z):
    """Some work for each entry."""
    root = jax.lax.rsqrt(1 + x * x + y * y)
    return z * root + jnp.sin(x) * root


def mask_of(how, shape, rng):
    """A mask that is true nowhere, everywhere, once, or here and there."""
    mask = rng.random(shape) < 0.2
    if how in ("none", "all"):
        mask = np.full(shape, how == "all")
    if how == "last":
        mask = np.zeros(shape, bool)
        mask.reshape(-1)[-1] = True
    return mask


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("how", ["none", "all", "last", "some"])
@pytest.mark.parametrize("entries", [65, 200, 64, 9])
def test_sums_of_a_list_at_both_elements(entries, how, dtype):
    """Gathers from rows, and sums at the indices of both elements of each pair."""
    rng = np.random.default_rng(entries)
    size = 21
    own, other = (jnp.asarray(rng.integers(0, size, entries), jnp.int32) for _ in "ab")
    bounds = jnp.asarray(np.where(mask_of(how, entries, rng), 9.0, -9.0), dtype)

    def step(own, other, bounds, x, y, z):
        near = (x[own] * y[other] < bounds) & (z[own] * 0.1 < bounds)
        force = [law(a[own], b[other], c[own]) for a, b, c in ((x, y, z), (y, z, x))]
        force.append(law(z[own], x[other], y[other]))
        both = []
        for index, sign in ((own, 1), (other, -1)):
            nothing = jnp.zeros(size, dtype)
            both.append(
                [nothing.at[index].add(jnp.where(near, sign * one, 0)) for one in force]
            )
        return [jnp.tanh(a + b + c) for a, b, c in zip((x, y, z), *both, strict=True)]

    rows = [jnp.asarray(rng.normal(size=size), dtype) for _ in "xyz"]
    compared(step, (own, other, bounds, *rows), 3, dtype)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("how", ["none", "all", "last", "some"])
@pytest.mark.parametrize("entries", [67, 150, 64, 5])
def test_sums_over_points_and_pairs(entries, how, dtype):
    """A table of points and pairs: summed over the points, and then at indices."""
    rng = np.random.default_rng(entries)
    size = 9
    own = jnp.asarray(rng.integers(0, size, entries), jnp.int32)
    shape = (POINTS, entries)
    bounds = jnp.asarray(np.where(mask_of(how, shape, rng), 9.0, -9.0), dtype)
    fractions = jnp.linspace(0, 1, POINTS, dtype=dtype)[:, None]

    def step(own, bounds, fractions, x, y):
        first, edge = x[own][None], y[own][None]
        point = first + fractions * edge
        near = (point * 0.1 < bounds) & (bounds != 0.5)
        force = jnp.where(near, law(point, bounds, edge), 0)
        total = jnp.sum(force, axis=0)
        turn = jnp.sum(fractions * force, axis=0)
        some = jnp.any(near, axis=0)
        nothing = jnp.zeros(size, dtype)
        by_index = nothing.at[own].add(jnp.where(some, -total, 0))
        every = jnp.sum(force) + jnp.sum(jnp.sum(force, axis=1) ** 2) / entries
        every, total, turn = (a / entries for a in (every, total, turn))
        x = x + by_index + nothing.at[own].add(jnp.where(some, turn, 0))
        return [jnp.tanh(x), jnp.cos(y + every) + jnp.max(total)]

    rows = [jnp.asarray(rng.normal(size=size), dtype) for _ in "xy"]
    compared(step, (own, bounds, fractions, *rows), 3, dtype)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_sum_that_depends_on_another_under_the_same_mask(dtype):
    """They are computed in two loops."""
    rng = np.random.default_rng(0)

    def step(bounds, x):
        near = jnp.sin(x) < bounds
        first = jnp.sum(jnp.where(near, law(x, x, bounds), 0))
        second = jnp.sum(jnp.where(near, law(x, first, x), 0))
        return [jnp.tanh(x + first - second)]

    given = [jnp.asarray(rng.normal(size=100), dtype) for _ in "bx"]
    compared(step, given, 1, dtype)


@pytest.mark.parametrize("how", ["none", "all", "last", "some"])
def test_a_sum_under_different_masks_is_packed_in_parts(how):
    """Reverse passes of contact add up numbers under a mask for each guarded branch."""
    rng = np.random.default_rng(3)
    shape = (9, 16)
    bounds = jnp.asarray(np.where(mask_of(how, shape, rng), 9.0, -9.0), "float64")

    def step(bounds, x, y):
        near, far = x * 0.1 < bounds, jnp.sin(y) < 0.3 * bounds
        one = jnp.where(near, law(x, y, bounds), 0)
        other = jnp.where(far, law(y, bounds, x), 0)
        more = jnp.where(near, law(bounds, x, y), 0)
        every = jnp.sum(one - (other - more))
        along = jnp.sum(-(one + other) * y, axis=1, keepdims=True)
        open_end = jnp.sum(one + other + x, axis=1, keepdims=True)
        return [jnp.tanh(x + along / 9 + every / 99), jnp.cos(y + open_end / 9)]

    given = [jnp.asarray(rng.normal(size=shape), "float64") for _ in "xy"]
    compared(step, (bounds, *given), 1, "float64")
    body = LoopBody(jax.make_jaxpr(step)(bounds, *given), 1)
    plan = RowPlan(body, (False,))
    schedule = Schedule(plan.graph, next_carry(plan), plan.ready, packs=True)
    masks = {one.mask for one in schedule.packing.sums.values()}
    assert len(masks) == 2  # without the parts there are none


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_scatter_into_numbers_keeps_them(dtype):
    rng = np.random.default_rng(0)
    places = jnp.asarray(rng.integers(-2, 14, 90), jnp.int32)

    def step(places, bounds, x):
        given = x[:12]
        near = bounds > 0
        more = jnp.where(near, law(bounds, x, x), 0)
        made = given.at[places].add(more, mode="drop")
        return [jnp.tanh(jnp.concatenate([made, x[12:]]))]

    given = places, *(jnp.asarray(rng.normal(size=90), dtype) for _ in "bx")
    compared(step, given, 2, dtype)


def test_little_work_is_not_packed(monkeypatch):
    monkeypatch.undo()

    def step(bounds, x):
        return [x + jnp.sum(jnp.where(x < bounds, 2 * x, 0))]

    given = [jnp.linspace(0, 1, 200)[::way] for way in (1, -1)]
    compared(step, given, 1, "float32", packs=False, steps=1)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("seed", range(12))
def test_random_masked_sums(seed):
    """Programs of random shapes, masks, sums and gathers."""
    rng = np.random.default_rng(seed)
    dtype = ("float32", "float64")[seed % 2]
    n, size = int(rng.integers(8, 180)), int(rng.integers(3, 40))
    points = int(rng.integers(5, 9))
    table = bool(rng.integers(2))
    own = jnp.asarray(rng.integers(0, size, n), jnp.int32)
    chances = rng.random(3)
    picks = rng.integers(0, 1 << 30, 40).tolist()
    shape = (points, n) if table else (n,)

    def step(own, weights, *rows):
        choose = iter(picks)
        near = jnp.asarray(chances[0], dtype) > weights
        if next(choose) % 2:
            near = near & jnp.broadcast_to(rows[0][own] > -chances[1], shape)
        pool = [jnp.broadcast_to(row[own], shape) for row in rows]
        pool += [weights, jnp.broadcast_to(jnp.asarray(0.5, dtype), shape)]
        for _ in range(8):
            a, b = (pool[next(choose) % len(pool)] for _ in "ab")
            pool.append(
                (
                    lambda a, b: a * b,
                    lambda a, b: jnp.where(a < b, a, b - a),
                    lambda a, b: jnp.tanh(a - b),
                    lambda a, b: a / (1 + b * b),
                )[next(choose) % 4](a, b)
            )
        made = []
        for row in rows:
            number = jnp.where(near, pool[next(choose) % len(pool)] / n, 0)
            number = number * pool[next(choose) % len(pool)]
            if table:
                if next(choose) % 2:
                    row = row + jnp.sum(number) / n
                number = jnp.sum(number, axis=0)
            made.append(jnp.tanh(row + jnp.zeros(size, dtype).at[own].add(number)))
        return made

    weights = jnp.asarray(rng.random(shape), dtype)
    rows = [jnp.asarray(rng.normal(size=size), dtype) for _ in range(4)]
    compared(step, (own, weights, *rows), 2, dtype)
