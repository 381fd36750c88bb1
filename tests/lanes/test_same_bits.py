"""Kernels give the same bits wherever their scene is, and however it is run."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.run_spec import LoopBody, RunSpec
from lanes.scenes import shaken
from lanes.test_runs import hanging

WAYS = pytest.mark.parametrize("way", ["always", "loops", "rows"])
SCENES, SIZE = 11, 13


def step(places, own, x, y):
    """Neighbours, a sum, gathers and additions at indices."""
    slope = jnp.tanh(x[1:] - x[:-1])
    force = jnp.pad(slope, (0, 1)) - jnp.pad(slope, (1, 0))
    y = 0.5 * y + own * force + 0.01 * jnp.sum(y * x)
    total = jnp.sin(x[places]) * (1 + y[places[::-1]])
    listed = jnp.where(total > 0.3, total, 0)
    return [x + 0.1 * y, y.at[places].add(0.1 * listed)]


def batch(dtype):
    """Constants of every scene, and a carry."""
    rng = np.random.default_rng(0)
    own, x, y = (jnp.asarray(rng.normal(size=(SCENES, SIZE)), dtype) for _ in "oxy")
    return own, x, y


def compiled(way, dtype):
    """A run of a batch of a way: from the count of steps and the batch's arrays."""
    # Lanes that are written out look nothing up at indices that are not known.
    rng = np.random.default_rng(1)
    places = np.asarray(rng.integers(0, SIZE, 9), np.int32)
    known = lambda own, x, y: step(places, own, x, y)
    body = LoopBody(jax.make_jaxpr(known)(*(a[0] for a in batch(dtype))), 1)
    use_lanes(way)
    run = lambda n, *given: cycles_p.bind(n, *given, spec=RunSpec(body, None))
    return jax.jit(jax.vmap(run, in_axes=(None, 0, 0, 0)))


def same(one, other):
    """Whether two lists of arrays have the same bits."""
    return all(
        np.asarray(a).tobytes() == np.asarray(b).tobytes()
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.fast_sets(1)
@WAYS
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_bits_do_not_depend_on_places_neighbours_pauses_or_alignment(dtype, way):
    run, given = compiled(way, dtype), batch(dtype)
    own = given[0]
    whole = run(jnp.int32(9), *given)
    assert lane_choices()[-1].taken
    order = np.random.default_rng(2).permutation(SCENES)
    moved = run(jnp.int32(9), *(a[order] for a in given))
    assert same([a[order] for a in whole], moved)
    few = run(jnp.int32(9), *(a[4:7] for a in given))
    assert same([a[4:7] for a in whole], few)
    paused = run(jnp.int32(4), own, *run(jnp.int32(5), *given))
    assert same(whole, paused)
    for offset in (16, 32, 48):
        assert same(whole, run(jnp.int32(9), *(beside(a, offset) for a in given)))


def beside(array, offset):
    """The same array from memory that begins so many bytes after a multiple of 64.

    JAX may copy it to a multiple of 64. The scenes of a batch begin at any multiple of
    their numbers' size in either case, as 13 numbers are no multiple of a vector.
    """
    array = np.asarray(array)
    room = np.zeros(array.nbytes + 128, np.uint8)
    begin = -room.ctypes.data % 64 + offset
    there = room[begin : begin + array.nbytes].view(array.dtype).reshape(array.shape)
    there[...] = array
    return jnp.from_dlpack(there)


def bits_of_runs():
    """Prints the bits of rods and of a gradient, of every way."""
    jax.config.update("jax_enable_x64", True)
    scene, state, dt = hanging()
    for way in ("always", "loops", "rows"):
        use_lanes(way)
        run = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 20)))
        after = run(shaken(state, 300, 0))
        assert lane_choices()[-1].taken
        loss = lambda s: jnp.sum(jaxrod.advance(scene, s, dt, 20).positions ** 2)
        slope = jax.jit(jax.vmap(jax.grad(loss)))(shaken(state, 17, 0))
        for array in jax.tree.leaves((after, slope)):
            print(way, np.asarray(array).tobytes().hex())


@pytest.mark.slow
def test_one_and_two_threads_give_the_same_bits():
    found = []
    for threads in (1, 2):
        program = (
            f"import jaxrod; jaxrod.configure_cpu({threads})\n"
            "from lanes.test_same_bits import bits_of_runs; bits_of_runs()"
        )
        done = subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        found.append(done.stdout)
    assert found[0] == found[1]
    assert found[0].count("always") > 4


def test_implicit_steps_are_the_same_in_parts_and_in_a_batch():
    numbers = dict(length=1.0, radius=0.02, density=1e3, youngs_modulus=1e6)
    rod, state = jaxrod.straight_rod(SIZE, **numbers)
    gravity = jaxrod.gravity((0.0, -9.81, 0.0))
    method = jaxrod.implicit()
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), gravity, method=method)
    use_lanes("auto")
    run = jax.jit(lambda start, n: jaxrod.advance(scene, start, 1e-2, n))
    whole, first = run(state, 10), run(state, 4)
    assert lane_choices()[-1].taken
    assert same(jax.tree.leaves(run(first, 6)), jax.tree.leaves(whole))
    many = jax.tree.map(lambda a, b: jnp.stack([a, b, a]), state, first)
    ends = jax.tree.leaves(jax.vmap(run, in_axes=(0, None))(many, 10))
    for place in (0, 2):
        assert same([end[place] for end in ends], jax.tree.leaves(whole))
