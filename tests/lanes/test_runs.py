"""Runs by lanes: the same as XLA's, for every scene, batch and count of steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.llvm.machine_code import compiled_kernels
from lanes.scenes import arm, forced, random_batch, shaken

RODS = 5
ROUNDING = 1e-11
"""Of sums in another order, grown over some tens of steps."""


def both(function, *arguments):
    """What a function returns by lanes and by XLA."""
    results = []
    for mode in (forced(), "never"):
        use_lanes(mode)
        # Another function, so that nothing that was compiled before is used.
        results.append(jax.jit(lambda *a: function(*a))(*arguments))
    return results


def apart(one, other):
    """The largest difference of floats in two trees, each by its largest entry."""
    worst = 0.0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(a.dtype, jnp.floating):
            size = float(jnp.max(jnp.abs(b))) or 1.0
            worst = max(worst, float(jnp.max(jnp.abs(a - b))) / size)
        else:
            np.testing.assert_array_equal(a, b)
    return worst


def hanging(n=6, dtype="float64"):
    """A damped arm under gravity: `(scene, state, dt)`."""
    rod, state = arm(n, dtype)
    effects = (jaxrod.clamp(state), jaxrod.exponential_damping(2.0))
    scene = jaxrod.make_scene(rod, *effects, jaxrod.gravity((0.0, -9.81, 0.0)))
    return scene, state, 0.5 * jaxrod.stable_dt(scene).dt


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(80))
def test_a_random_scene_moves_the_same_by_lanes(seed, record):
    scene, many, dt, name = random_batch(seed, RODS)
    taken, expected = both(
        jax.vmap(lambda state: jaxrod.advance(scene, state, dt, 100)), many
    )
    assert any(choice.taken for choice in lane_choices()), name
    record("lanes: " + name, "XLA, 100 steps", apart(taken, expected), at_most=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("rods", [1, 9])
def test_a_batch_of_any_size_is_the_same(rods):
    scene, state, dt = hanging()
    many = shaken(state, rods, 0)
    taken, expected = both(
        jax.vmap(lambda state: jaxrod.advance(scene, state, dt, 20)), many
    )
    assert lane_choices()[-1].taken
    assert apart(taken, expected) < ROUNDING


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 2])
def test_any_number_of_steps_is_the_same_traced_or_not(count):
    scene, state, dt = hanging()
    many = shaken(state, RODS, 1)

    def run(states, n):
        return jax.vmap(lambda state: jaxrod.advance(scene, state, dt, n))(states)

    taken, expected = both(lambda states: run(states, count), many)
    traced, _ = both(run, many, jnp.int32(count))
    assert apart(taken, expected) < ROUNDING
    assert apart(traced, expected) < ROUNDING


@pytest.mark.slow
def test_numbers_of_steps_that_differ_from_rod_to_rod():
    scene, state, dt = hanging()
    many = shaken(state, RODS, 1)
    run = jax.vmap(lambda state, n: jaxrod.advance(scene, state, dt, n))
    taken, expected = both(run, many, jnp.arange(RODS))
    assert apart(taken, expected) < ROUNDING


@pytest.mark.slow
def test_parameters_of_each_rod_and_rows_of_rows():
    rod, state = arm(5)

    def run(stiffness, pull, state):
        effects = (
            jaxrod.clamp(state),
            jaxrod.gravity(jnp.array([0.0, -1.0, 0.0]) * pull),
        )
        scene = jaxrod.make_scene(rod, *effects)
        scene = jax.tree.map(lambda leaf: leaf * stiffness, scene)
        return jaxrod.advance(scene, state, 1e-4, 10).positions

    over_pulls = jax.vmap(run, in_axes=(None, 0, None))
    grid = jax.vmap(over_pulls, in_axes=(0, None, None), out_axes=1)
    arguments = (1 + 0.01 * jnp.arange(3.0), jnp.arange(4.0), state)
    taken, expected = both(grid, *arguments)
    assert taken.shape == (4, 3, 3, 6)
    assert apart(taken, expected) < ROUNDING


@pytest.mark.slow
def test_records_on_the_way_are_the_same():
    scene, state, dt = hanging()
    many = shaken(state, RODS, 2)
    run = jax.vmap(lambda state: jaxrod.rollout(scene, state, dt, 12, 3))
    taken, expected = both(run, many)
    assert apart(taken, expected) < ROUNDING


@pytest.mark.slow
def test_a_system_of_rods_and_bodies_is_the_same():
    rod, state = arm(4)
    other, apart_state = jaxrod.straight_rod(
        4, length=0.5, radius=0.04, density=1000.0, youngs_modulus=1e6,
        start=(1.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0), dtype="float64",
    )  # fmt: skip
    states = {"arm": state, "other": apart_state}
    system = jaxrod.make_system(
        {"arm": jaxrod.make_scene(rod), "other": jaxrod.make_scene(other)},
        jaxrod.systems.ball_joint(
            ("arm", "tip"), ("other", "base"), states, stiffness=1e4
        ),
    )
    pulled = jax.tree.map(lambda x: jnp.broadcast_to(x, (RODS, *x.shape)), states)
    pulled["arm"] = shaken(state, RODS, 3)
    dt = 0.5 * jaxrod.stable_dt(system).dt
    run = jax.vmap(lambda states: jaxrod.advance(system, states, dt, 30))
    taken, expected = both(run, pulled)
    assert lane_choices()[-1].taken
    assert apart(taken, expected) < ROUNDING


@pytest.mark.fast_sets(1)
def test_nothing_is_compiled_again_for_other_numbers_counts_or_batches():
    scene, state, dt = hanging()
    run = jax.jit(
        lambda scene, states, dt, n: jax.vmap(
            lambda state: jaxrod.advance(scene, state, dt, n)
        )(states)
    )
    run(scene, shaken(state, 4, 0), dt, jnp.int32(3))
    before = compiled_kernels()
    heavier = jax.tree.map(lambda leaf: 1.01 * leaf, scene)
    run(heavier, shaken(state, 4, 1), 0.9 * dt, jnp.int32(7))
    run(heavier, shaken(state, 33, 1), 0.9 * dt, jnp.int32(2))
    assert compiled_kernels() == before


@pytest.mark.slow
def test_single_precision_is_as_near_to_double_as_xlas():
    errors = {"always": [], "never": []}
    for seed in range(8):
        scene, state, dt = hanging()
        many = shaken(state, RODS, seed)
        use_lanes("never")
        reference = _advanced(scene, many, dt)
        halved = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, "float32"), (scene, many, dt)
        )
        for mode, found in zip(
            ("always", "never"), both(_advanced, *halved), strict=True
        ):
            errors[mode].append(
                float(jnp.max(jnp.abs(found.positions - reference.positions)))
            )
    assert np.median(errors["always"]) <= 1.5 * np.median(errors["never"])


def _advanced(scene, many, dt):
    return jax.vmap(lambda state: jaxrod.advance(scene, state, dt, 200))(many)
