"""Equilibria of rods that could spin or slide as a whole, and no load would notice."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.rods.elasticity import elastic_law
from jaxrod.rods.motion import motion_of
from jaxrod.statics.degrees_of_freedom import degrees_of_freedom
from jaxrod.statics.loose_modes import middle_shares, singular_mixtures
from jaxrod.statics.residual import Increment, LoadBalance
from physics.pins import Pin, Place, pinned
from physics.rods import arm, difference

N, G = 20, 9.81
STRAIGHT = {"radius": 0.02, "youngs_modulus": 1e6}
# The programs run a few times: LLVM need not optimise them.
hurried = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def beam(dtype=jnp.float64, n=N, direction=(1.0, 0.0, 0.0), **changes):
    """A straight rod, horizontal."""
    return arm(n, dtype, direction=direction, **STRAIGHT | changes)


def equilibrium(numbers, rod, state, on, couple=(0.0, 0.0, 0.0)):
    """Of a rod on pins: which of them are there, and a couple on an end.

    Args:
        numbers: Factors of stiffness and density, and the weight over its own.
    """
    modulus, density, weight = numbers
    rod = replace(
        rod,
        bend_twist_stiffness=modulus * rod.bend_twist_stiffness,
        shear_stretch_stiffness=modulus * rod.shear_stretch_stiffness,
        linear_density=density * rod.linear_density,
    )
    scene = jaxrod.make_scene(
        rod,
        *pinned(state, on=on),
        jaxrod.gravity(-weight * G * jnp.asarray([0.0, 0.0, 1.0])),
        jaxrod.end_load(couple=couple),
    )
    # The best there is: that of rounding, in single precision.
    tolerance = {"float64": 1e-10, "float32": 3e-4}[str(rod.radii.dtype)]
    found = jaxrod.equilibrium(scene, state, tolerance=tolerance)
    weights = jnp.cos(1.0 + jnp.arange(state.positions.size))
    return jnp.vdot(weights, jnp.ravel(found.state.positions)), found


differentiated = hurried(jax.value_and_grad(equilibrium, has_aux=True))


def found(rod, state, weight=1.0, on=(1, 1), couple=(0.0, 0.0, 0.0)):
    numbers, switches, load = (
        jnp.asarray(a, rod.radii.dtype) for a in ((1, 1, weight), on, couple)
    )
    return differentiated(numbers, rod, state, switches, load)[0][1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["float64", pytest.param("float32", marks=pytest.mark.slow)]
)
def test_a_beam_on_two_pins_sags_as_timoshenko_says(kind, record):
    """It is free to spin about its axis, and its weight does not spin it."""
    rod, state = beam(jnp.dtype(kind))
    load = 1e-3 * G * rod.linear_density[0]
    bending, shear = rod.bend_twist_stiffness[0, 0], rod.shear_stretch_stiffness[0, 0]
    exact = 5 * load / (384 * bending) + load / (8 * shear)
    sag = found(rod, state, weight=1e-3)
    assert bool(sag.converged) and bool(sag.stable) and bool(sag.loose)
    record(
        f"Equilibrium: sag of a beam on two pins under a small load, n = {N}, {kind}",
        "5 q L^4/384 EI + q L^2/(8 alpha_c GA)",
        abs(float(-sag.state.positions[2, N // 2] / exact) - 1),
        at_most=3e-3,
    )


@pytest.mark.slow
def test_its_sag_depends_on_every_number_as_differences_say(record):
    rod, state = beam()
    others = (rod, state, jnp.ones(2), jnp.zeros(3))
    at, steps = jnp.ones(3), 1e-5 * jnp.eye(3)
    gradient = np.asarray(differentiated(at, *others)[1])
    value = lambda numbers: float(differentiated(numbers, *others)[0][0])
    expected = [(value(at + step) - value(at - step)) / 2e-5 for step in steps]
    record(
        "Gradient of the sag of a rope on two pins: material, density, load",
        "central differences",
        np.max(np.abs(gradient / expected - 1)),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_what_loads_do_drive_is_not_said_to_converge():
    """An end couple about the axis of a rod on two pins spins it for ever."""
    spun = found(*beam(), couple=(0.01, 0.0, 0.0))
    assert not bool(spun.converged) and not bool(spun.stable) and bool(spun.loose)


@pytest.mark.slow
def test_a_rod_on_one_pin_hangs_down_and_may_spin():
    """Its weight drives it until it hangs; a rod that stands on its pin may fall."""
    hanging = found(*beam(direction=(0.3, 0.0, -1.0)), on=(1, 0))
    assert bool(hanging.converged) and bool(hanging.stable) and bool(hanging.loose)
    assert np.max(np.abs(hanging.state.positions[:2])) < 1e-8
    assert float(hanging.state.tip[2]) < -1
    standing = found(*beam(direction=(0.0, 0.0, 1.0)), on=(1, 0))
    assert bool(standing.converged) and not bool(standing.stable)


@pytest.mark.slow
def test_an_arch_on_pins_is_loose_only_where_nothing_turns_it_back():
    """Hanging from its pins it swings back, standing on them it falls over."""
    angles = np.linspace(0, np.pi, N + 1)
    nodes = np.stack([-np.cos(angles), 0 * angles, -np.sin(angles)])
    rod, state = jaxrod.rod_along(
        nodes, radius=0.05, density=1000.0, youngs_modulus=1e7, dtype=jnp.float64
    )
    hanging = found(rod, state)
    assert bool(hanging.converged) and bool(hanging.stable) and not bool(hanging.loose)
    standing = found(rod, state, weight=-1.0)
    assert bool(standing.converged) and not bool(standing.stable)
    unloaded = found(rod, state, weight=0.0)
    assert bool(unloaded.converged) and bool(unloaded.stable) and bool(unloaded.loose)


@pytest.mark.slow
def test_what_something_resists_is_not_loose(dtype):
    """However slender the rod, in single precision too."""

    @hurried
    def is_loose(rod, state, effects):
        still = motion_of(state)
        none = Increment(*jax.tree.map(jnp.zeros_like, (still.position, still.spin)))
        pace = jnp.zeros((), dtype)
        scene = jaxrod.make_scene(rod, *effects)
        balance = LoadBalance(scene, elastic_law(rod), still, pace, None, at_rest=True)
        return balance.held(balance.tangent(none), none)[1]

    for radius in (0.02, 0.001):
        rod, state = beam(dtype, radius=radius)
        start, finish = pinned(state)
        wall = jaxrod.clamp(state)
        assert not bool(is_loose(rod, state, (wall,)))
        assert not bool(is_loose(rod, state, (wall, finish)))
        assert not bool(is_loose(rod, state, (jaxrod.fixed_end(state),)))
        assert bool(is_loose(rod, state, (start, finish)))


def test_places_held_without_a_word_of_velocities_are_not_free():
    rod, state = beam()
    motion = motion_of(state)
    both, places = (
        degrees_of_freedom(jaxrod.make_scene(rod, *pinned(state, kind)), motion)
        for kind in (Pin, Place)
    )
    assert difference(both, places) == 0
    assert float(jnp.sum(jnp.stack(places[0]))) == 3 * (N + 1) - 6


@pytest.mark.slow
def test_places_held_without_a_word_of_velocities_are_held_all_the_same():
    rod, state = beam()
    both, places = (
        jaxrod.equilibrium(
            jaxrod.make_scene(rod, *pinned(state, kind), jaxrod.gravity()), state
        )
        for kind in (Pin, Place)
    )
    assert bool(places.converged)
    assert difference(both.state, places.state) < 1e-12
    scenes = [
        jaxrod.make_scene(
            rod, *pinned(state, kind), jaxrod.gravity(), method=jaxrod.implicit()
        )
        for kind in (Pin, Place)
    ]
    ends = [jaxrod.advance(scene, state, 0.05, 3).positions for scene in scenes]
    assert difference(*ends) < 1e-9


@pytest.mark.slow
def test_a_rope_on_two_pins_hangs_as_it_does_when_it_has_come_to_rest(record):
    rod, state = beam(n=8)
    scene = jaxrod.make_scene(
        rod, *pinned(state), jaxrod.gravity(), jaxrod.exponential_damping(5.0)
    )
    at_rest = jaxrod.equilibrium(scene, state)
    assert bool(at_rest.converged) and bool(at_rest.stable) and bool(at_rest.loose)
    dt = jaxrod.stable_dt(scene).dt
    late = jaxrod.advance(scene, state, dt, int(8.0 / float(dt)))
    assert float(jnp.max(jnp.abs(late.positions - state.positions))) > 0.05
    record(
        "Equilibrium: a rope on two pins under its weight [m]",
        "explicit steps, when it has come to rest",
        difference(at_rest.state.positions, late.positions),
        at_most=1e-9,
    )


@pytest.mark.slow
def test_a_rod_lies_on_a_smooth_floor_on_which_it_may_slide():
    rod, state = beam()
    floor = jaxrod.shapes.plane((0.0, 0.0, -0.02), (0.0, 0.0, 1.0))
    scene = jaxrod.make_scene(
        rod, jaxrod.contact(floor, stiffness=1e4), jaxrod.gravity((0.0, 0.0, -G))
    )
    touching = replace(state, positions=state.positions.at[2].set(-1e-3))
    lying = jaxrod.equilibrium(scene, touching)
    assert bool(lying.converged) and bool(lying.stable) and bool(lying.loose)
    depth = G * float(rod.linear_density[0]) / 1e4
    np.testing.assert_allclose(lying.state.positions[2], -depth, rtol=1e-9)
    np.testing.assert_allclose(
        lying.state.positions[:2], state.positions[:2], atol=1e-12
    )


@pytest.mark.parametrize("kind", ["full", "two alike", "small", "one alone", "sums"])
def test_orthogonal_mixtures_are_those_of_lapack(kind, dtype):
    vectors = np.random.default_rng(0).normal(size=(7, 60))
    if kind == "two alike":
        vectors[3] = vectors[2]
    if kind == "small":
        vectors *= 10.0 ** -np.arange(7)[:, None]
    if kind == "one alone":
        vectors[:2] = vectors[3:] = 0
    if kind == "sums":
        vectors[4:] = vectors[:3] + vectors[1:4]
    vectors = np.asarray(vectors, dtype)
    sizes, mixtures = hurried(singular_mixtures)(jnp.asarray(vectors))
    expected = np.linalg.svd(vectors.astype(float), compute_uv=False)
    few = 20 * np.finfo(dtype).eps
    sizes, mixtures = np.asarray(sizes, float), np.asarray(mixtures, float)
    assert difference(np.sort(sizes)[::-1], expected) <= few * expected[0]
    assert difference(mixtures @ mixtures.T, np.eye(7)) <= few
    products = mixtures @ vectors.astype(float)
    assert (
        difference(products @ products.T, np.diag(sizes**2)) <= few * expected[0] ** 2
    )


@pytest.mark.parametrize("n", [2, 3, 4, 7])
def test_springs_on_loose_modes_act_on_the_middle_of_the_rod(n):
    """Beside it they would make a symmetric rod unsymmetric."""
    rod, _ = arm(n, jnp.float64)
    shares = np.asarray(middle_shares(rod, jnp.float64))
    first = (n - 1) // 2
    places = np.add([[first] * 3 + [first + 0.5] * 3], [[0], [1]])
    np.testing.assert_array_equal(shares.sum(axis=0), np.ones(6))
    np.testing.assert_array_equal((shares * places).sum(axis=0), np.full(6, n / 2))
