"""Sections that are not full circles: their numbers, and how such rods move."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj

import jaxrod
from physics.rods import arm, difference, largest

STEEL = {"density": 1000.0, "youngs_modulus": 1e7, "dtype": jnp.float64}


def strip(n, width=0.1, height=0.02, **changes):
    section = jaxrod.rectangle(width, height)
    return jaxrod.straight_rod(
        n, **{"length": 1.0, "section": section} | STEEL | changes
    )


def test_a_circle_is_the_rod_of_a_radius():
    """The same program, and the same numbers to rounding."""
    by_radius, _ = arm(3)
    by_shape, _ = arm(3, radius=None, section=jaxrod.circle(0.05))
    assert by_shape.is_round
    assert by_radius.rotary_inertia.shape == by_shape.rotary_inertia.shape
    for name in ("linear_density", "bend_twist_stiffness", "shear_stretch_stiffness"):
        np.testing.assert_allclose(
            getattr(by_shape, name), getattr(by_radius, name), rtol=1e-14
        )


def test_the_numbers_of_shapes():
    wide = jaxrod.rectangle(0.2, 0.1)
    np.testing.assert_allclose(wide.second_moments, (0.2e-3 / 12, 0.8e-3 / 12))
    # Saint-Venant's series: 0.1406 of the fourth power of a square's side, 0.229 a b^3.
    square = jaxrod.rectangle(1.0, 1.0)
    assert float(square.torsion_constant) == pytest.approx(0.14058, rel=5e-3)
    assert float(wide.torsion_constant) == pytest.approx(0.2287 * 0.2e-3, rel=5e-3)
    assert float(jaxrod.rectangle(0.1, 0.2).torsion_constant) == wide.torsion_constant
    oval, disc = jaxrod.ellipse(0.3, 0.3), jaxrod.circle(0.3)
    for name in ("area", "second_moments", "torsion_constant", "shear_factors"):
        np.testing.assert_allclose(getattr(oval, name), getattr(disc, name))
    pipe = jaxrod.tube(0.3, 1e-9)
    np.testing.assert_allclose(pipe.shear_factors, 27 / 28, rtol=1e-12)
    np.testing.assert_allclose(jaxrod.tube(1.0, 0.9999).shear_factors, 0.6, rtol=1e-6)


@pytest.mark.slow
def test_a_tube_bends_as_a_rod_of_the_same_stiffness(record):
    """Small load, little shear: one bends as far as the other."""
    sag = []
    pipe = jaxrod.tube(0.02, 0.015)
    thin = (pipe.second_moments[0] * 4 / np.pi) ** 0.25
    for section in (pipe, jaxrod.circle(thin)):
        rod, state = arm(20, radius=None, section=section)
        rod = replace(rod, shear_stretch_stiffness=1e3 * rod.shear_stretch_stiffness)
        push = jaxrod.end_load((1e-3, 0.0, 0.0))
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state), push)
        sag.append(float(jaxrod.equilibrium(scene, state).state.tip[0]))
    record(
        "Sag of a tube, compared with a rod of the same bending stiffness",
        "0",
        abs(sag[0] / sag[1] - 1),
        at_most=1e-5,
    )


@pytest.mark.slow
def test_a_free_asymmetric_element_tumbles(record):
    """Euler's top in Jacobi's elliptic functions: d2 turns over again and again."""
    rod, state = strip(2)
    rod = replace(
        rod,
        bend_twist_stiffness=jnp.zeros((3, 2)),
        shear_stretch_stiffness=jnp.zeros((3, 2)),
    )
    one, two, three = np.asarray(rod.principal_inertias)[:, 0]
    start = np.array([30.0, 0.0, 2.0])
    moments = np.array([one, two, three])
    energy, squared = np.sum(moments * start**2), np.sum((moments * start) ** 2)
    # Between the smallest and the intermediate axis.
    assert squared < energy * two
    rate = np.sqrt((two - one) * (energy * three - squared) / (one * two * three))
    modulus = (three - two) * (squared - energy * one)
    modulus /= (two - one) * (energy * three - squared)
    scene = jaxrod.make_scene(rod)
    spins = jnp.asarray(np.stack([start, start], axis=1))
    moving = jaxrod.with_angular_velocities(rod, state, spins)
    time, errors = 1.0, []
    sn, cn, dn, _ = ellipj(rate * time, modulus)
    sizes = (
        start[0] * dn,
        np.sqrt((squared - energy * one) / (two * (two - one))) * sn,
        start[2] * cn,
    )
    for steps in (1000, 2000):
        after = jaxrod.advance(scene, moving, time / steps, steps)
        found = np.abs(np.asarray(jaxrod.angular_velocities(rod, after))[:, 0])
        errors.append(np.max(np.abs(found - np.abs(sizes))) / 30.0)
        kept = largest(after.angular_momenta - moving.angular_momenta)
        assert kept == 0
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    record(
        "Angular velocity of a free strip after 1 s at dt = 0.5 ms, off by",
        "Jacobi's elliptic functions",
        errors[1],
        at_most=1e-4,
    )


@pytest.mark.slow
def test_a_free_rod_of_square_section_tumbles(record):
    """Pushed at an end by a force that rises and falls; mass 10 kg, impulse 50 N s."""
    side = np.sqrt(0.6)
    rod, state = jaxrod.straight_rod(
        10,
        length=10.0,
        section=jaxrod.rectangle(side, side),
        density=1 / 0.6,
        youngs_modulus=1e4 / 0.6,
        start=(6.0, 0.0, 0.0),
        direction=(-6.0, 0.0, 8.0),
        dtype=jnp.float64,
    )
    times = (0.0, 2.5, 5.0, 10.0)
    force = jaxrod.schedules.table(
        times, tuple((f, 0.0, 0.0) for f in (0.0, 20.0, 0.0, 0.0))
    )
    couple = jaxrod.schedules.table(
        times, tuple((0.0, -4 * f, -2 * f) for f in (0.0, 20.0, 0.0, 0.0))
    )
    scene = jaxrod.make_scene(rod, jaxrod.end_load(force, couple, end="base"))
    dt = 1 / 200
    at_five = jaxrod.advance(scene, state, dt, 1000)
    at_seven = jaxrod.advance(scene, at_five, dt, 400, first=1000)
    masses = np.asarray(rod.node_masses)
    middle = lambda s: np.asarray(s.positions) @ masses / masses.sum()
    speed = np.asarray(rod.momentum(at_five)) / masses.sum()
    assert np.abs(np.asarray(state.positions)[1]).max() == 0
    assert np.abs(np.asarray(at_seven.positions)[1]).max() > 0.5, "it leaves its plane"
    record(
        "Speed of a tumbling free rod after a triangular push, off by [m/s]",
        "5",
        np.max(np.abs(speed - [5, 0, 0])),
        at_most=1e-12,
    )
    record(
        "Places of its middle after 5 s and 7 s, off by [m]",
        "15.5, 25.5",
        max(abs(middle(at_five)[0] - 15.5), abs(middle(at_seven)[0] - 25.5)),
        at_most=1e-4,
    )


def two_materials(n, joint_mean):
    """Tip of a cantilever whose second half is 20 times softer."""
    stiff = np.where(np.arange(n) < n // 2, 2e8, 1e7)
    rod, state = strip(n, 0.02, 0.02, youngs_modulus=stiff, joint_mean=joint_mean)
    rod = replace(rod, shear_stretch_stiffness=jnp.full((3, n), 1e9))
    push = jaxrod.end_load((1e-4, 0.0, 0.0))
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), push)
    tip = float(jaxrod.equilibrium(scene, state).state.tip[0])
    moment = 0.02**4 / 12
    # F/3 over each half of what the lever's cube grows by, over its stiffness.
    exact = 1e-4 / 3 * ((1 - 1 / 8) / (2e8 * moment) + (1 / 8) / (1e7 * moment))
    return tip / exact - 1


@pytest.mark.slow
def test_joints_in_series_between_two_materials(record):
    errors = [two_materials(n, "series") for n in (10, 20)]
    record(
        "Two-material cantilever, joints in series, n doubled: error ratio",
        "4",
        errors[0] / errors[1],
        between=(3.5, 4.5),
    )
    assert abs(two_materials(20, "arithmetic")) > 5 * abs(errors[1])


@pytest.mark.slow
def test_a_strip_in_a_plane_is_that_in_space():
    """About its weak and about its strong axis; methods that need round rods refuse."""
    for normal in ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        rod, state = strip(4, direction=(1.0, 0.0, 0.0), normal=normal)
        ends = []
        for method in (None, jaxrod.planar("xy")):
            scene = jaxrod.make_scene(
                rod,
                jaxrod.clamp(state),
                jaxrod.gravity((0.0, -9.81, 0.0)),
                method=method,
            )
            ends.append(jaxrod.advance(scene, state, 1e-4, 200))
        assert abs(ends[0].tip[1]) > 1e-3
        assert difference(*ends) < 1e-12
    with pytest.raises(ValueError, match="needs round sections"):
        jaxrod.make_scene(rod, method=jaxrod.torsion_free())
    oblique, tilted = strip(4, direction=(1.0, 0.0, 0.0), normal=(0.0, 1.0, 1.0))
    scene = jaxrod.make_scene(oblique, method=jaxrod.planar("xy"))
    with pytest.raises(ValueError, match="bending stiffness in that plane"):
        jaxrod.advance(scene, tilted, 1e-4, 1)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: jaxrod.circle(-1.0), "radius must be positive"),
        (lambda: jaxrod.tube(0.1, 0.2), "inner_radius must be less than outer_radius"),
        (lambda: jaxrod.rectangle(1.0, [[1.0]]), "height must be one number"),
        (lambda: strip(3, radius=0.1), "either a radius or a section"),
        (lambda: strip(3, section=None), "either a radius or a section"),
        (lambda: strip(3, joint_mean="mean"), "joint_mean must be"),
        (lambda: strip(3, section=jaxrod.circle([0.1, 0.2])), "one per element"),
    ],
)
def test_what_is_no_section_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.slow
def test_a_strip_buckles_sideways(record):
    """A cantilever loaded along its width: its lowest frequency goes to zero."""
    width, height, n = 0.1, 0.004, 30
    rod, state = strip(n, width, height, normal=(1.0, 0.0, 0.0))
    bending, _, twisting = np.asarray(rod.bend_twist_stiffness)[:, 0]
    unit = np.sqrt(bending * twisting)
    loads, squares = np.array([3.2, 3.5, 3.8]), []
    for load in loads:
        push = jaxrod.end_load((load * unit, 0.0, 0.0))
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state), push)
        bent = jaxrod.equilibrium(scene, state).state
        squares.append(float(jaxrod.natural_frequencies(scene, bent, 1)[0]) ** 2)
    roots = np.roots(np.polyfit(loads, squares, 2))
    critical = min(roots.real, key=lambda r: abs(r - 4.0))
    record(
        "Lateral buckling of a strip, P L^2 / sqrt(EI GJ), off by",
        "4.013",
        abs(critical / 4.013 - 1),
        at_most=1e-2,
    )


def test_joints_in_series_are_two_springs_each_half_an_element_long():
    """Elements of other lengths and moduli; compliances of halves add up."""
    rod, _ = jaxrod.straight_rod(
        6, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e6
    )
    lengths = jnp.asarray([0.1, 0.3, 0.2, 0.15, 0.15, 0.1])
    stiffness = jnp.asarray(np.random.default_rng(0).uniform(1, 9, (3, 6)))
    rod = replace(
        rod,
        rest_lengths=lengths,
        bend_twist_stiffness=stiffness,
        joint_mean="series",
    )
    halves = 0.5 * np.asarray(lengths) / np.asarray(stiffness)
    compliance = (halves[:, :-1] + halves[:, 1:]) / np.asarray(rod.joint_lengths)
    np.testing.assert_allclose(rod.joint_stiffness, 1 / compliance, rtol=1e-6)
