"""Kernels of warps on a GPU, where there is one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import lane_choices, use_lanes
from lanes.scenes import SEEDS, random_scene
from lanes.test_runs import apart, hanging, shaken

pytestmark = pytest.mark.gpu


def beside_xla(program, *given):
    """Results of a program in warps, and in XLA on the same device."""
    found = []
    for mode in ("always", "never"):
        use_lanes(mode)
        compiled = jax.jit(lambda *arguments: program(*arguments))
        found.append(jax.block_until_ready(compiled(*given)))
        if mode == "always":
            assert lane_choices()[-1].taken, lane_choices()[-1].why
    return found


@pytest.mark.parametrize("rods", [1, 3, 5000])
@pytest.mark.parametrize("n", [7, 40])
def test_batches_of_every_size_move_as_in_xla(n, rods):
    scene, state, dt = hanging(n)
    many = shaken(state, rods, 0)
    warps, xla = beside_xla(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 20)), many)
    assert apart(warps, xla) < 1e-11


@pytest.mark.parametrize("seed", SEEDS)
def test_scenes_of_every_kind_move_as_in_xla(seed):
    scene, state, dt, name = random_scene(seed)
    many = shaken(state, 6, seed)
    warps, xla = beside_xla(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 20)), many)
    assert apart(warps, xla) < 1e-10, name


def test_gradients_are_those_of_xla():
    scene, state, dt = hanging(20)

    def height(speed):
        begun = replace(state, velocities=state.velocities + speed)
        return jaxrod.advance(scene, begun, dt, 200).positions[1, -1]

    warps, xla = beside_xla(jax.vmap(jax.grad(height)), jnp.linspace(-0.5, 0.5, 100))
    np.testing.assert_allclose(warps, xla, rtol=1e-9)


def test_a_rod_too_long_for_shared_memory_moves_as_in_xla():
    scene, state, dt = hanging(800)
    many = shaken(state, 3, 0)
    warps, xla = beside_xla(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 20)), many)
    assert any("the workspace" in c.why for c in lane_choices() if c.rods == 3)
    # Rounding of positions changes speeds by about c eps L / l = 1e-11 m/s in a step.
    assert apart(warps, xla) < 1e-9


def test_a_kernel_gives_the_same_bits_again_and_in_every_place_of_a_batch():
    scene, state, dt = hanging(20)
    many = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (999, *leaf.shape)), state)
    use_lanes("always")
    run = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 500)))
    first, again = run(many), run(many)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        assert np.array_equal(a, b)
        assert np.all(np.asarray(a) == np.asarray(a)[:1])


def test_a_loop_of_kernels_of_another_program_is_the_same():
    """Kernels run on the stream of the program, after what comes before."""
    scene, state, dt = hanging(20)
    many = shaken(state, 64, 0)

    def turn(states, _):
        states = jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 3))(states)
        damped = replace(states, velocities=0.9 * states.velocities)
        return damped, jnp.mean(damped.positions)

    warps, xla = beside_xla(lambda s: jax.lax.scan(turn, s, length=50), many)
    assert apart(warps[0], xla[0]) < 1e-10
    np.testing.assert_allclose(warps[1], xla[1], rtol=1e-10)
