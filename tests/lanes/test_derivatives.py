"""Derivatives of runs by lanes: those of XLA, in every mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import lane_choices
from jaxrod.lanes.llvm.machine_code import vector_bytes
from lanes.scenes import arm, forced, random_batch, shaken
from lanes.test_runs import RODS, apart, both, hanging


def height(scene, state, dt, n):
    """Of the tip, after some steps."""
    return jaxrod.advance(scene, state, dt, n).positions[1, -1]


def contributions(slopes, numbers):
    """Derivatives times the numbers to which they belong, array by array."""
    return [
        slope * number.reshape(-1, *slope.shape[1:])
        for slope, number in zip(
            jax.tree.leaves(slopes), jax.tree.leaves(numbers), strict=True
        )
        if jnp.issubdtype(slope.dtype, jnp.floating) and slope.size
    ]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 10])
def test_gradients_to_states_numbers_and_step_are_those_of_xla(count):
    scene, state, dt = hanging()
    many = shaken(state, RODS, 0)

    def gradients(scene, many, dt):
        one = jax.grad(height, argnums=(0, 1, 2), allow_int=True)
        return jax.vmap(lambda state: one(scene, state, dt, count))(many)

    taken, expected = both(gradients, scene, many, dt)
    if count > 1:
        assert lane_choices()[-1].taken
    # What a number contributes counts: some of a rod have next to no effect in so few
    # steps, and rounding is all of their derivative.
    numbers = (scene, many, dt)
    parts = [contributions(made, numbers) for made in (taken, expected)]
    largest = max(float(jnp.max(jnp.abs(part))) for part in parts[1])
    for one, other in zip(*parts, strict=True):
        assert float(jnp.max(jnp.abs(one - other))) < 1e-11 * largest


@pytest.mark.slow
def test_the_gradient_of_a_mean_over_the_batch():
    scene, state, dt = hanging()
    many = shaken(state, RODS, 0)

    def mean(scene, dt):
        return jnp.mean(jax.vmap(lambda s: height(scene, s, dt, 12))(many))

    taken, expected = both(jax.grad(mean, argnums=(0, 1)), scene, dt)
    assert apart(taken, expected) < 1e-11


@pytest.mark.fast_sets(1)
def test_gradients_agree_with_differences():
    scene, state, dt = hanging(5)
    many = shaken(state, RODS, 0)

    def total(pull):
        effects = (*scene.effects[:2], jaxrod.gravity(pull))
        heavy = jaxrod.make_scene(scene.rod, *effects)
        return jnp.sum(jax.vmap(lambda s: height(heavy, s, dt, 40))(many))

    pull = jnp.array([0.3, -9.81, 0.5])
    found = jax.jit(jax.grad(total))(pull)
    value = jax.jit(total)
    for axis, h in ((1, 1e-4), (2, 1e-4)):
        step = jnp.zeros(3).at[axis].set(h)
        expected = (value(pull + step) - value(pull - step)) / (2 * h)
        assert abs(found[axis] - expected) <= 1e-7 * abs(expected) + 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("traced", [False, True])
def test_forward_mode_is_that_of_xla(traced):
    scene, state, dt = hanging()
    many = shaken(state, RODS, 0)

    def rates(many, dt, n):
        one = lambda dt, s: jaxrod.advance(scene, s, dt, n if traced else 9)
        return jax.vmap(lambda s: jax.jvp(lambda t: one(t, s), (dt,), (1.0,)))(many)

    taken, expected = both(rates, many, dt, jnp.int32(9))
    assert apart(taken, expected) < 1e-11


@pytest.mark.slow
def test_second_derivatives_are_those_of_xla():
    scene, state, dt = hanging(3)
    many = shaken(state, 4, 0)

    def curvature(many, dt):
        one = lambda dt, s: height(scene, s, dt, 5)
        return jax.vmap(lambda s: jax.hessian(one)(dt, s))(many)

    taken, expected = both(curvature, many, dt)
    assert apart(taken, expected) < 1e-9


def test_reverse_mode_needs_a_number_of_steps_that_is_known():
    scene, state, dt = hanging(3)
    many = shaken(state, 4, 0)

    def total(many, n):
        return jnp.sum(jax.vmap(lambda s: height(scene, s, dt, n))(many))

    with pytest.raises(ValueError, match="`int`"):
        jax.jit(jax.grad(total))(many, jnp.int32(3))


def worst_change(one, other, numbers):
    """Gradients apart, each times its number: of the larger change, or of 1 um.

    Of a number that nothing depends on a gradient is rounding and nothing else.
    """
    worst = 0.0
    leaves = map(jax.tree.leaves, (one, other, numbers))
    for a, b, number in zip(*leaves, strict=True):
        if jnp.issubdtype(a.dtype, jnp.floating):
            size = float(jnp.max(jnp.abs(number))) or 1.0
            largest = max(float(jnp.max(jnp.abs(b))) * size, 1e-6)
            worst = max(worst, float(jnp.max(jnp.abs(a - b))) * size / largest)
    return worst


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(30))
def test_gradients_of_random_scenes_are_those_of_xla(seed, record):
    scene, many, dt, name = random_batch(seed, RODS)

    def gradients(scene, many):
        one = jax.grad(lambda *a: height(*a, dt, 30), argnums=(0, 1), allow_int=True)
        return jax.vmap(lambda state: one(scene, state))(many)

    taken, expected = both(gradients, scene, many)
    measured = worst_change(taken, expected, (scene, many))
    record(
        "lanes: gradient of " + name,
        "XLA, 30 steps; change of height by all of a number, over 1 um [m/m]",
        measured,
        at_most=1e-9,
    )


@pytest.mark.slow
def test_optimising_through_lanes_needs_no_memory_that_grows_with_steps():
    rod, state = arm(4)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    many = shaken(state, 4, 0)

    def program(n):
        total = lambda m: jnp.sum(jax.vmap(lambda s: height(scene, s, 1e-4, n))(m))
        lowered = jax.jit(jax.grad(total, allow_int=True)).lower(many)
        return lowered.compile().memory_analysis().temp_size_in_bytes

    few, lots = program(100), program(10_000)
    # Kept are about twice the root of the number of steps.
    assert lots < 20 * few
    np.testing.assert_array_less(few, lots)


@pytest.mark.slow
def test_memory_of_a_gradient_grows_with_the_root_of_the_number_of_steps():
    """Checkpoints are kept, and the steps after one of them.

    Lanes keep those steps for each lane, also where there is a single rod.
    """
    scene, state, dt = hanging()
    own = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    lanes = 1 if forced() == "rows" else vector_bytes() // 8
    sizes = []
    for steps in (400, 40_000):
        end = lambda s, n=steps: jnp.sum(jaxrod.advance(scene, s, dt, n).tip ** 2)
        compiled = jax.jit(jax.grad(end)).lower(state).compile()
        assert all(choice.taken for choice in lane_choices()[-2:])
        sizes.append(compiled.memory_analysis().temp_size_in_bytes)
        assert sizes[-1] < (3 + 2 * lanes) * own * np.sqrt(steps) + 1e5
    assert sizes[1] < 12 * sizes[0]
