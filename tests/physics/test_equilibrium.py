"""Statics: closed forms, buckling, gradients of equilibria, and what is refused."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import BENDING, LENGTH, SHEARING, arm, difference, largest, loads

# The programs run a few times: LLVM need not optimise them.
HURRY = {"xla_backend_optimization_level": 0}


def under_end_load(rod, state, force=(0.0, 0.0, 0.0), couple=(0.0, 0.0, 0.0), **more):
    """The equilibrium of a cantilever in a wall under an end load."""
    load = jaxrod.end_load(force, couple)
    scene = jaxrod.make_scene(rod, load, jaxrod.clamp(state))
    return jaxrod.equilibrium(scene, state, **more)


def bending(rod):
    return float(rod.bend_twist_stiffness[0, 0])


@pytest.mark.slow
def test_a_small_load_bends_a_cantilever_as_timoshenko_says(record):
    force = 1e-3
    exact = force * LENGTH**3 / (3 * BENDING) + force * LENGTH / SHEARING
    found = under_end_load(*arm(20), (force, 0.0, 0.0))
    record(
        "Equilibrium: cantilever tip under a small load, n = 20",
        "FL^3/3EI + FL/(alpha_c GA)",
        abs(float(found.state.tip[0]) / exact - 1),
        at_most=2e-3,
    )
    assert bool(found.converged) and bool(found.stable)


# Load PL^2/EI, deflection and shortening of an inextensible cantilever's tip [L].
ELASTICA = {
    1: (0.301721, 0.056433),
    2: (0.493457, 0.160642),
    5: (0.713792, 0.387628),
    10: (0.810609, 0.554996),
}


@pytest.mark.parametrize("load", ELASTICA)
def test_large_deflections_follow_the_elastica_in_few_iterations(load, record):
    """From the straight rod at once, with no load steps."""
    rod, state = arm(20, radius=0.005)
    found = under_end_load(rod, state, (load * bending(rod), 0.0, 0.0))
    deflection, shortening = ELASTICA[load]
    tip = found.state.tip
    record(
        f"Equilibrium: tip under PL^2/EI = {load}, slender rod, n = 20 [lengths]",
        "elastica",
        np.hypot(tip[0] - deflection, 1 - tip[2] - shortening),
        at_most=2e-3,
    )
    assert bool(found.converged) and bool(found.stable)
    assert int(found.iterations) <= 12


@pytest.mark.parametrize("turns", [1, 2])
def test_an_end_moment_winds_a_rod_into_circles(turns, record):
    rod, state = arm(20, radius=0.005)
    moment = 2 * np.pi * turns * bending(rod)
    found = under_end_load(rod, state, couple=(0.0, moment, 0.0))
    angles = jnp.unwrap(
        jnp.arctan2(found.state.directors[2, 0], found.state.directors[2, 2])
    )
    expected = 2 * np.pi * turns * rod.arc_length_midpoints
    assert bool(found.converged)
    record(
        f"Equilibrium: directors under an end moment {2 * turns} pi EI/L, n = 20 [rad]",
        "M s/EI at every element",
        float(jnp.max(jnp.abs(angles - expected))),
        at_most=1e-9,
    )


def test_the_buckling_load_is_where_the_straight_column_loses_stability(record):
    n = 20
    rod, state = arm(n, radius=0.005)
    euler = np.pi**2 * bending(rod) / (4 * LENGTH**2)
    low, high = 0.9 * euler, 1.1 * euler
    for _ in range(20):
        load = 0.5 * (low + high)
        straight = under_end_load(rod, state, (0.0, 0.0, -load))
        assert bool(straight.converged)
        low, high = (load, high) if bool(straight.stable) else (low, load)
    record(
        "Equilibrium: load at which a cantilever column buckles, n = 20",
        "pi^2 EI/4L^2",
        abs(low / euler - 1),
        at_most=2e-3,
    )


def test_far_beyond_buckling_a_stable_bent_column_is_found():
    """The tip of a column under three times Euler's load lies below its middle."""
    rod, state = arm(20, radius=0.005)
    euler = np.pi**2 * bending(rod) / (4 * LENGTH**2)
    found = under_end_load(rod, state, (1e-3 * euler, 0.0, -3 * euler))
    assert bool(found.converged) and bool(found.stable)
    # Tabulated for P = 2.541 Pc (end slope 120 deg): height 0.123, offset 0.803.
    assert float(found.state.tip[2]) < 0.123
    assert 0.6 < abs(float(found.state.tip[0])) < 0.803


@pytest.mark.slow
def test_all_loads_balance_and_dynamics_stays_there():
    rod, state = arm(8, radius=0.03)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity((30.0, 0, 5.0)))
    found = jaxrod.equilibrium(scene, state)
    forces, couples = loads(scene, found.state)
    weight = 30 * float(jnp.sum(rod.element_masses))
    assert float(jnp.max(jnp.abs(forces[:, 1:]))) < 1e-9 * weight
    assert float(jnp.max(jnp.abs(couples))) < 1e-9 * weight
    assert float(found.force_residual) < 1e-9 * weight
    assert float(found.couple_residual) < 1e-9 * weight
    dt = float(jaxrod.stable_dt(scene).dt)
    later = jaxrod.advance(scene, found.state, dt, 100)
    assert difference(later.positions, found.state.positions) < 1e-10


def scene_of_every_load(n=4):
    """An arm held at one end, with loads of every kind, and its rest state."""
    rod, state = arm(n, radius=0.03, youngs_modulus=1e6)
    wave = np.sin(np.arange(3 * n).reshape(3, n))
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((1.0, -2.0, -9.0)),
        jaxrod.end_load((0.3, 0.2, -0.2), (0.1, -0.2, 0.05), follower=True),
        jaxrod.uniform_load((0.2, 0.0, 0.1), (0.05, 0.1, -0.1)),
        jaxrod.actuation.ElementCouples(jnp.asarray(0.1 * wave)),
        jaxrod.clamp(state),
    )
    return scene, state


@pytest.mark.parametrize("size", [1e-5, 1e-4, 1e-3])
def test_a_start_whose_nodes_are_off_leads_to_the_same_equilibrium(size):
    """Nodes off by 1e-5 of the length press its elements beyond what they buckle at."""
    rod, state = arm(20, radius=0.005)
    load = (bending(rod), 0.0, 0.0)
    expected = under_end_load(rod, state, load).state
    random = np.random.default_rng(0)
    for _ in range(5):
        off = size * random.normal(size=state.positions.shape)
        off[:, 0] = 0  # The wall holds this node.
        near = replace(state, positions=state.positions + off)
        found = under_end_load(rod, near, load)
        assert bool(found.converged)
        assert difference(found.state, expected) < 1e-9


@pytest.mark.slow
def test_a_fold_on_the_way_does_not_end_the_search():
    """Far beyond buckling, corrections grow without bound near a singular tangent."""
    scene, state = scene_of_every_load()
    random = np.random.default_rng(0)

    def find(more):
        heavier = jaxrod.make_scene(scene.rod, *scene.effects, jaxrod.gravity(more))
        return jaxrod.equilibrium(heavier, state)

    more = jnp.asarray(0.01 * random.normal(size=(20, 3)))
    found = jax.jit(jax.vmap(find), compiler_options=HURRY)(more)
    assert bool(jnp.all(found.converged))


def mixture(found):
    """A number that depends on every position and orientation."""
    parts = (found.state.positions, found.state.orientations)
    return sum(
        jnp.vdot(part, jnp.cos(1.0 + jnp.arange(part.size)).reshape(part.shape))
        for part in parts
    )


@pytest.mark.slow
def test_equilibria_depend_on_every_number_as_differences_say(record):
    scene, state = scene_of_every_load()
    evaluate = jax.jit(
        jax.value_and_grad(lambda s, x: mixture(jaxrod.equilibrium(s, x)), (0, 1)),
        compiler_options=HURRY,
    )
    numbers = (scene, state)
    value, gradient = evaluate(*numbers)
    leaves, structure = jax.tree.flatten(numbers)
    slopes = jax.tree.leaves(gradient)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    random, size, worst, seen = np.random.default_rng(0), 1e-5, 0.0, 0
    noise = 1e-9 * max(1.0, abs(float(value)))
    for index, (leaf, slope) in enumerate(zip(leaves, slopes, strict=True)):
        push = (largest(leaf) or 1.0) * jnp.asarray(random.normal(size=leaf.shape))

        def at(sign, index=index, leaf=leaf, push=push):
            changed = [*leaves]
            changed[index] = leaf + sign * size * push
            return float(evaluate(*structure.unflatten(changed))[0])

        expected = (at(1) - at(-1)) / (2 * size)
        got = float(jnp.vdot(slope, push))
        worst = max(worst, abs(got - expected) / max(abs(expected), noise / 1e-6))
        seen += abs(got) > noise
    assert seen >= 10, "too few numbers have an influence"
    record(
        "Gradient of an equilibrium: all parameters and loads",
        "central differences",
        worst,
        at_most=1e-6,
    )


@pytest.mark.slow  # Half a minute of compiling.
def test_forward_mode_and_second_derivatives_of_an_equilibrium():
    rod, state = arm(3, radius=0.01)
    unit = bending(rod)

    def tip(load):
        force = jnp.stack([load * unit, 0.2 * unit, -unit])
        return under_end_load(rod, state, force).state.tip[0]

    hurry = partial(jax.jit, compiler_options=HURRY)
    slope, curvature = hurry(jax.grad(tip)), hurry(jax.grad(jax.grad(tip)))
    forward = hurry(jax.jacfwd(tip))
    at, step = jnp.asarray(2.0), 1e-4
    assert float(forward(at)) == pytest.approx(float(slope(at)), rel=1e-12)
    expected = float(slope(at + step) - slope(at - step)) / (2 * step)
    assert float(curvature(at)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)]
)
def test_a_batch_of_equilibria_is_found_as_one_by_one(dtype):
    dtype = jnp.dtype(dtype)
    rod, state = arm(4, dtype, radius=0.02)
    unit = bending(rod)
    forces = jnp.asarray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [8.0, 3.0, -4.0]], dtype)
    find = lambda force: under_end_load(rod, state, force * unit)
    together = jax.jit(jax.vmap(find), compiler_options=HURRY)(forces)
    alone = jax.jit(find, compiler_options=HURRY)
    assert bool(jnp.all(together.converged))
    for index, force in enumerate(forces):
        one, member = alone(force), jax.tree.map(lambda a, i=index: a[i], together)
        assert one.state.positions.dtype == dtype
        assert int(one.iterations) == int(member.iterations)
        bar = 100 * float(jnp.finfo(dtype).eps)
        assert difference(one.state, member.state) < bar


@pytest.mark.slow
def test_derivatives_of_a_batch_of_equilibria_are_those_of_each():
    rod, state = arm(4, radius=0.02)
    forces = jnp.asarray([[1.0, 0.0, 0.0], [2.0, 3.0, -4.0]]) * bending(rod)

    def tip(stiffness, force):
        soft = replace(rod, bend_twist_stiffness=stiffness * rod.bend_twist_stiffness)
        return under_end_load(soft, state, force).state.tip

    def tips(stiffness):
        return jax.vmap(lambda force: tip(stiffness, force))(forces)

    hurry = partial(jax.jit, compiler_options=HURRY)
    together, backwards = hurry(jax.jacfwd(tips))(1.0), hurry(jax.jacrev(tips))(1.0)
    step = 1e-4
    for index, force in enumerate(forces):
        change = tip(1 + step, force) - tip(1 - step, force)
        expected = change / (2 * step)
        for found in (together, backwards):
            np.testing.assert_allclose(found[index], expected, rtol=1e-6, atol=1e-9)


def test_what_has_not_converged_says_so():
    rod, state = arm(20, radius=0.005)
    found = under_end_load(rod, state, (5 * bending(rod), 0, 0), max_iterations=3)
    assert not bool(found.converged)


@pytest.mark.parametrize("loaded", [False, True])
def test_a_free_rod_is_refused(loaded):
    rod, state = arm(3)
    scene = jaxrod.make_scene(rod, *([jaxrod.gravity()] if loaded else []))
    with pytest.raises(ValueError, match="scene must hold the rod"):
        jaxrod.equilibrium(scene, state)
    with pytest.raises(ValueError, match="scene must hold the rod"):
        jax.jit(jaxrod.equilibrium)(scene, state)


def test_bad_arguments_are_refused():
    rod, state = arm(3)
    wall = jaxrod.clamp(state)
    scene = jaxrod.make_scene(rod, wall)
    with pytest.raises(ValueError, match="state must have 3 elements"):
        jaxrod.equilibrium(scene, arm(4)[1])
    with pytest.raises(ValueError, match="tolerance must be positive"):
        jaxrod.equilibrium(scene, state, tolerance=0.0)
    with pytest.raises(ValueError, match="max_iterations must be at least 1"):
        jaxrod.equilibrium(scene, state, max_iterations=0)
    other = jaxrod.make_scene(rod, jaxrod.fixed_end(state), method=jaxrod.pyelastica())
    with pytest.raises(ValueError, match=r"consistent law, got PyElastica\(\)"):
        jaxrod.equilibrium(other, state)


@pytest.mark.slow
def test_equilibrium_starts_from_a_moving_state_and_ends_at_rest():
    rod, state = arm(20, radius=0.005)
    moving = replace(state, velocities=state.velocities + 1.0)
    load = (bending(rod), 0.0, 0.0)
    still = under_end_load(rod, state, load)
    found = under_end_load(rod, moving, load)
    assert difference(found.state, still.state) == 0
    assert largest(found.state.velocities) == 0


@pytest.mark.slow
def test_a_tapered_arm_under_strong_tendons_is_found_from_the_straight_one():
    """It is the one of ten steps of the tension; full corrections alone ran away."""
    n, held = 36, 30
    s = (np.arange(n) + 0.5) * 0.36 / n
    radius = np.interp(s, [0, 0.305, 0.36], [15.4e-3, 6.4e-3, 4.8e-3])
    rod, state = jaxrod.straight_rod(
        n,
        length=0.36,
        radius=radius,
        density=1100.0,
        youngs_modulus=4.2e5,
        poisson_ratio=0.45,
        direction=(0.0, 0.0, -1.0),
        dtype=jnp.float64,
    )
    angles = np.deg2rad([30, 150])[:, None]
    eyelets = np.stack([np.cos(angles), np.sin(angles)], 1)
    eyelets = eyelets * (11.4e-3 - 0.0295 * s[:held])

    @jax.jit
    def found(start, tension):
        cables = jaxrod.actuation.tendon(
            rod, eyelets, tension=tension, elements=(0, held - 1)
        )
        held_at = jaxrod.clamp(state), jaxrod.gravity()
        return jaxrod.equilibrium(jaxrod.make_scene(rod, *held_at, cables), start)

    for tension in ((4.6, 0.0), (0.0, 6.2), (7.7, 0.0), (3.1, 6.2)):
        pull = jnp.asarray(tension)
        at_once = found(state, pull)
        assert bool(at_once.converged) and bool(at_once.stable)
        assert int(at_once.iterations) <= 15
        step = state
        for share in np.linspace(0.1, 1.0, 10):
            step = found(step, share * pull).state
        assert difference(at_once.state, step) < 1e-9
