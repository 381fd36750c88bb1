"""Lanes in loops: one loop for a step, whose code does not grow with its rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.looped.kernels import cycles_in_lanes
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.run_spec import LoopBody, RunSpec

SIZE = 23


@pytest.fixture(autouse=True)
def loops(always):
    """Takes lanes in loops."""
    use_lanes("loops")


def bound(step, n_constants, *given, n=3):
    """Carries of a batch after `n` steps, in loops and by XLA, and the kernel.

    XLA computes one operation after another: with the fusion of `configure_cpu` its
    compiler (0.10.1) aborts on some of these programs.
    """
    one = [array[0] for array in given]
    body = LoopBody(jax.make_jaxpr(step)(*one), n_constants)
    run = lambda *a: cycles_p.bind(jnp.int32(n), *a, spec=RunSpec(body, None))
    found = jax.jit(jax.vmap(run))(*given)
    assert lane_choices()[-1].taken
    constants, expected = given[:n_constants], given[n_constants:]
    for _ in range(n):
        expected = jax.vmap(step)(*constants, *expected)
    rows = (True,) * n_constants
    return found, expected, cycles_in_lanes(body, rows, 8, checkpoints=False)


def batch(rods, *shapes, dtype="float64"):
    """Random arrays with a leading axis of rods."""
    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.normal(size=(rods, *shape)), dtype) for shape in shapes]


def neighbours(x, y):
    """A step in which each row needs entries beside its own of the row before."""
    slope = jnp.tanh(x[1:] - x[:-1])
    padded = jnp.pad(slope, 1)
    force = padded[1:] - padded[:-1]
    bent = jnp.sin(force[2:] + force[:-2])
    y = 0.5 * y + jnp.concatenate([y[:1], bent, y[-1:]])
    return [x + 0.1 * y + 0.1 * jnp.pad(y[:-1], (1, 0)), y]


def distant(x, y):
    """A step that needs mirrored, far and single entries, and sums, of other rows."""
    a = jnp.tanh(x) + y
    b = a[::-1] * a[3] + jnp.concatenate([a[9:], a[:9]])
    c = jnp.cos(b) * jnp.sum(b) + jnp.pad(b[:-7], (7, 0))
    return [0.3 * c + jnp.max(c), jnp.tanh(c[np.arange(SIZE) * 5 % SIZE])]


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("rods", [1, 5, 19])
@pytest.mark.parametrize("step", [neighbours, distant])
def test_a_step_of_rows_that_need_each_other_is_that_of_xla(step, rods):
    found, expected, _ = bound(step, 0, *batch(rods, (SIZE,), (SIZE,)))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_the_code_is_as_long_for_any_length_of_rows():
    kernels = []
    for n in (30, 500):
        rows = [array[0] for array in batch(1, (n,), (n,))]
        body = LoopBody(jax.make_jaxpr(neighbours)(*rows), 0)
        kernels.append(cycles_in_lanes(body, (), 8, checkpoints=False))
    assert kernels[0].operations == kernels[1].operations
    assert abs(len(kernels[0].text) - len(kernels[1].text)) < 300


def test_rows_that_need_neighbours_alone_share_a_loop():
    _, _, kernel = bound(neighbours, 0, *batch(2, (SIZE,), (SIZE,)))
    step = kernel.text.split("@step(")[1].split("\n}")[0]
    assert step.count("phi i64") == 1
    _, _, kernel = bound(distant, 0, *batch(2, (SIZE,), (SIZE,)))
    step = kernel.text.split("@step(")[1].split("\n}")[0]
    assert step.count("phi i64") > 1


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_numbers_do_not_depend_on_the_place_in_a_batch_or_on_pauses(dtype):
    given = batch(19, (SIZE,), (SIZE,), dtype=dtype)
    body = LoopBody(jax.make_jaxpr(neighbours)(*[array[0] for array in given]), 0)
    run = jax.jit(
        jax.vmap(
            lambda n, *a: cycles_p.bind(n, *a, spec=RunSpec(body, None)),
            in_axes=(None, 0, 0),
        )
    )
    whole = run(jnp.int32(9), *given)
    order = np.random.default_rng(1).permutation(19)
    moved = run(jnp.int32(9), *[array[order] for array in given])
    paused = run(jnp.int32(4), *run(jnp.int32(5), *given))
    for a, b, c in zip(whole, moved, paused, strict=True):
        np.testing.assert_array_equal(a[order], b)
        np.testing.assert_array_equal(a, c)


def listed(places, there, table, total):
    """Sums over entries of a list with indices of each scene, some not in use."""
    numbers = jnp.sin(table[places]) * table[places[::-1]]
    more = jnp.where(there, numbers, 0)
    return [table + 0.1 * total, total.at[places].add(more)]


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_scenes_have_lists_of_their_own(share):
    rng = np.random.default_rng(2)
    places = jnp.asarray(rng.integers(0, SIZE, (11, 37)), jnp.int32)
    there = jnp.asarray(rng.random((11, 37)) < share)
    given = places, there, *batch(11, (SIZE,), (SIZE,))
    found, expected, kernel = bound(listed, 2, *given)
    assert "_some:" in kernel.text
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def touching(x, y):
    """Sums over all pairs of points of pulls that are zero for most pairs."""
    ahead = x[:, None] - x[None, :]
    near = 0.01 - ahead**2
    other = jnp.abs(x[:, None] + x[None, :] - 1) < 0.02
    pull = jnp.where(near > 0, near * jnp.sin(ahead), 0) * y[None]
    push = -ahead * jnp.where(other, jnp.cos(ahead), 0)
    return [x + jnp.sum(pull - push, 0) + 0.1 * jnp.sum(pull, 1), y]


@pytest.mark.parametrize("touches", [0, 1, 5, 11])
def test_pairs_that_touch_in_no_scene_are_skipped(touches):
    rng = np.random.default_rng(3)
    x = np.linspace(1, 9, SIZE) + rng.uniform(-0.05, 0.05, (11, SIZE))
    x[:touches, ::3] = rng.uniform(0.4, 0.6, (touches, 8))
    given = jnp.asarray(x), *batch(11, (SIZE,))
    found, expected, kernel = bound(touching, 0, *given, n=2)
    step = kernel.text.split("@step(")[1].split("\n}")[0]
    assert step.count("_some:") == 1
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
