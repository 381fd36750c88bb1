"""The spline that shapes couples along a rod, and the limit on how fast they change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import jaxrod
from jaxrod.methods.laws import IN_SPACE
from physics.rods import arm

ROUND = {"radius": 0.05, "density": 1e3, "youngs_modulus": 1e6}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "controls", [2, 3, 6, [0.1, 0.2, 0.7], [0.05, 0.3, 0.35, 0.8, 1.1]]
)
def test_the_spline_is_the_interpolating_not_a_knot_cubic(controls, record):
    length = 1.3
    spline = jaxrod.actuation.control_spline(controls, length, dtype=jnp.float64)
    count = spline.n_controls
    inner = controls
    if isinstance(controls, int):
        inner = length * np.arange(1, count + 1) / (count + 1)
    knots = np.concatenate([[0.0], inner, [length]])
    values = np.random.default_rng(0).uniform(-1, 1, (3, count))
    points = np.linspace(-0.1, 1.1, 200) * length  # Beyond the ends, too.
    got = jax.jit(spline.__call__)(jnp.asarray(values), jnp.asarray(points))
    padded = np.pad(values, ((0, 0), (1, 1)))
    expected = make_interp_spline(knots, padded, k=3, axis=1)(points)
    record(
        f"Control spline, control points {controls}",
        "scipy.interpolate.make_interp_spline",
        np.max(np.abs(got - expected)),
        at_most=1e-12 * np.max(np.abs(expected)),
    )


def test_the_overshoot_of_six_equidistant_points_is_the_documented_one():
    spline = jaxrod.actuation.control_spline(6, dtype=jnp.float64)
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 6), axis=-1).reshape(-1, 6)
    highest = jnp.max(jnp.abs(spline(jnp.asarray(signs), jnp.linspace(0.0, 1.0, 1001))))
    assert float(highest) == pytest.approx(1.67, abs=0.005)


@pytest.mark.slow
def test_the_load_does_not_depend_on_the_number_of_elements(record):
    """Total couple and first moment are the spline's, where elements end at breaks."""
    spline = jaxrod.actuation.control_spline(6, dtype=jnp.float64)
    controls = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (3, 6)))

    def totals(n):
        rod, _ = arm(n)
        couples = jaxrod.actuation.spline_couples(rod, spline, controls, 5.0).couples
        middles = np.asarray(rod.arc_length_midpoints)
        return np.sum(couples, axis=1), couples @ middles

    places = np.linspace(0.0, 1.0, 200_001)
    density = 5.0 * np.asarray(spline(controls, jnp.asarray(places)))
    exact = np.trapezoid(density, places, axis=1)
    moment = np.trapezoid(density * places[None, :], places, axis=1)
    record(
        "Total couple of a spline on 7 elements, whose ends are its breaks",
        "integral of the spline",
        np.max(np.abs(totals(7)[0] - exact)) / np.max(np.abs(exact)),
        at_most=1e-8,
    )
    assert np.max(np.abs(totals(10)[0] - exact)) < 1e-3 * np.max(np.abs(exact))
    coarse, fine = (np.max(np.abs(totals(n)[1] - moment)) for n in (21, 42))
    record(
        "First moment of a spline's couples: ratio of the errors at n = 21 and n = 42",
        "16 (fourth order)",
        coarse / fine,
        between=(14.0, 18.0),
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("controls", [2, 6, [0.1, 0.2, 0.9]])
def test_a_spline_for_another_length_is_refused(controls, dtype):
    rod, _ = jaxrod.straight_rod(n_elements=7, length=1.3, **ROUND, dtype=dtype)
    fits = jaxrod.actuation.control_spline(controls, 1.3, dtype=dtype)
    assert fits.averaged(rod).basis.shape == (7, fits.n_controls)
    for other in (1.0, 1.2, 1.5, 1300.0):
        spline = jaxrod.actuation.control_spline(controls, other, dtype=dtype)
        with pytest.raises(ValueError, match=r"1.3 m long.*give control_spline len"):
            spline.averaged(rod)


def test_averages_for_another_number_of_elements_are_refused():
    rods = [jaxrod.straight_rod(n_elements=n, length=1.0, **ROUND)[0] for n in (7, 8)]
    averages = jaxrod.actuation.control_spline(3).averaged(rods[0])
    with pytest.raises(ValueError, match="for a rod of 7 elements, but this one has 8"):
        jaxrod.actuation.spline_couples(rods[1], averages, jnp.ones((3, 3)), 1.0)


def test_averages_worked_out_once_give_the_same_couples():
    rod, _ = arm(9)
    spline = jaxrod.actuation.control_spline(4, dtype=jnp.float64)
    controls = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (3, 4)))
    couples = jaxrod.actuation.spline_couples(rod, spline, controls, 2.0).couples
    again = jaxrod.actuation.spline_couples(
        rod, spline.averaged(rod), controls, 2.0
    ).couples
    np.testing.assert_array_equal(again, couples)


def test_couple_density_may_differ_between_directions():
    rod, _ = arm(10)
    spline = jaxrod.actuation.control_spline(4, dtype=jnp.float64)
    couples = jaxrod.actuation.spline_couples(
        rod, spline, jnp.ones((3, 4)), (1.0, 2.0, 0.0)
    ).couples
    np.testing.assert_allclose(couples[1], 2 * couples[0])
    np.testing.assert_allclose(couples[2], 0)


def schedules(shape, size):
    """Values that change with time, and the same as a function of it."""
    values = size * np.random.default_rng(size).uniform(-1, 1, (3, *shape))
    table = jaxrod.schedules.table([0.0, 1.0, 3.0], values)
    return table, lambda t: np.apply_along_axis(
        lambda knots: np.interp(t, [0.0, 1.0, 3.0], knots), 0, values
    )


@pytest.mark.slow
def test_controls_and_density_may_depend_on_time():
    rod, _ = arm(4, dtype=jnp.float64)
    spline = jaxrod.actuation.control_spline(3, float(rod.length), dtype=jnp.float64)
    averages = spline.averaged(rod)
    controls, controls_at = schedules((3, 3), 1)
    one, one_at = schedules((), 2)
    three, three_at = schedules((3,), 3)
    constant = np.ones((3, 3))
    for given, given_at in (
        ((spline, controls, 0.3), lambda t: (controls_at(t), 0.3)),
        ((averages, controls, one), lambda t: (controls_at(t), one_at(t))),
        ((averages, constant, three), lambda t: (constant, three_at(t))),
    ):
        timed = jaxrod.actuation.spline_couples(rod, *given)
        scene = jaxrod.make_scene(rod, timed)
        bound = np.asarray(scene.at_largest.effects[0].couples)
        for time in (0.0, 0.4, 1.7, 5.0):
            plain = jaxrod.actuation.spline_couples(rod, given[0], *given_at(time))
            found = scene.at(time).effects[0].couples
            np.testing.assert_allclose(found, plain.couples, rtol=0, atol=1e-15)
            assert np.all(np.abs(found) <= bound)


@pytest.mark.slow
def test_the_gradient_by_the_density_of_rising_couples_is_that_of_differences():
    rod, state = arm(4, dtype=jnp.float64)
    averages = jaxrod.actuation.control_spline(
        3, float(rod.length), jnp.float64
    ).averaged(rod)
    ramp = jaxrod.schedules.ramp(np.zeros((3, 3)), schedules((3, 3), 1)[1](0.0), 2e-3)

    def swept(density):
        couples = jaxrod.actuation.spline_couples(rod, averages, ramp, density)
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state), couples)
        return jaxrod.advance(scene, state, 1e-4, 20).tip[1]

    step = 1e-4
    slope = jax.grad(swept)(0.2)
    difference = (swept(0.2 + step) - swept(0.2 - step)) / (2 * step)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)


def test_schedules_of_other_shapes_are_refused_in_words():
    rod, _ = arm(4, dtype=jnp.float64)
    spline = jaxrod.actuation.control_spline(3, float(rod.length), dtype=jnp.float64)
    pair = jaxrod.schedules.ramp((0.0, 0.0), (1.0, 1.0), 1.0)
    with pytest.raises(ValueError, match=r"controls must have values of shape \(3, "):
        jaxrod.actuation.spline_couples(rod, spline, pair, 1.0)
    with pytest.raises(ValueError, match=r"couple_density .* shape \(\) or \(3,\)"):
        jaxrod.actuation.spline_couples(rod, spline, np.ones((3, 3)), pair)


def test_applied_values_follow_commands_no_faster_than_allowed():
    applied = jnp.array([0.0, 0.0, 0.5, -0.5])
    commanded = jnp.array([1.0, 0.05, -1.0, -0.45])
    after = jaxrod.actuation.limit_rate(applied, commanded, 0.1)
    np.testing.assert_allclose(after, [0.1, 0.05, 0.4, -0.45])
    for _ in range(20):
        after = jaxrod.actuation.limit_rate(after, commanded, 0.1)
    np.testing.assert_allclose(after, commanded)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("mode", ["consistent", "pyelastica"])
def test_a_couple_turns_its_element_about_the_material_axis(mode):
    """One element of a free arm, couple about each axis: P grows by c dt."""
    for axis in range(3):
        rod, state = arm(3, direction=(1.0, 2.0, -0.5))
        couples = jnp.zeros((3, 3)).at[axis, 1].set(2.0)
        scene = jaxrod.make_scene(
            rod, jaxrod.actuation.ElementCouples(couples), method=IN_SPACE[mode]
        )
        after = jaxrod.advance(scene, state, 1e-7, 1)
        expected = 2.0 * 1e-7 * state.directors[axis, :, 1]
        np.testing.assert_allclose(after.angular_momenta[:, 1], expected, atol=1e-14)
