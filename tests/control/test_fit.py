"""Identification: closed forms, calibration, and what data cannot say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import control
from jaxrod.control.identification.fit import _spreads

TIMES = np.linspace(0, 2, 40)
TRUTH = {"frequency": 5.0, "rate": 0.7}
START = {"frequency": 4.6, "rate": 2.8}
SD = 0.02


def ring(p):
    """A damped oscillation."""
    return jnp.exp(-p["rate"] * TIMES) * jnp.cos(p["frequency"] * TIMES)


def noise(seed, shape=TIMES.shape):
    return SD * np.random.default_rng(seed).normal(size=shape)


@pytest.mark.slow
def test_parameters_are_found_exactly_without_noise():
    fit = control.fit(ring, ring(TRUTH), START, noise=SD, tolerance=1e-14)
    assert bool(fit.converged)
    for name, value in TRUTH.items():
        assert float(fit.values[name]) == pytest.approx(value, rel=1e-6)
    assert float(fit.misfit) < 1e-9
    assert fit.undetermined == ()


@pytest.mark.slow
def test_a_straight_line_has_its_closed_form():
    design = np.stack([np.ones_like(TIMES), TIMES], axis=1)
    observed = design @ np.array([-1.0, 3.0]) + noise(0)

    def line(p):
        return p["a"] + p["b"] * TIMES

    fit = control.fit(line, observed, {"a": 2.0, "b": 0.0}, logarithmic=False, noise=SD)
    best, squares, *_ = np.linalg.lstsq(design, observed, rcond=None)
    covariance = SD**2 * np.linalg.inv(design.T @ design)
    sds = np.sqrt(np.diag(covariance))
    assert [float(fit.values[k]) for k in "ab"] == pytest.approx(list(best), rel=1e-6)
    found = [float(fit.standard_deviations[k]) for k in "ab"]
    assert found == pytest.approx(list(sds), rel=1e-6)
    expected = covariance[0, 1] / (sds[0] * sds[1])
    assert float(fit.correlation[0, 1]) == pytest.approx(expected, rel=1e-6)
    assert float(fit.misfit) == pytest.approx(squares[0] / SD**2 / 38, rel=1e-6)
    # Without a noise that is known it is that of the residuals.
    alone = control.fit(line, observed, {"a": 2.0, "b": 0.0}, logarithmic=False)
    share = np.sqrt(squares[0] / 38) / SD
    found = [float(alone.standard_deviations[k]) for k in "ab"]
    assert found == pytest.approx(list(share * sds), rel=1e-6)


@pytest.mark.slow
def test_standard_deviations_are_those_of_many_draws():
    clean = ring(TRUTH)
    draws = clean[None] + jnp.asarray(noise(1, (400, len(TIMES))))
    fits = jax.jit(jax.vmap(lambda o: control.fit(ring, o, START, noise=SD)))(draws)
    assert bool(jnp.all(fits.converged))
    for z in fits.z(TRUTH).values():
        # Of 400 draws the mean is known to 0.05 and the deviation to 0.035.
        assert abs(float(jnp.mean(z))) < 0.2
        assert 0.88 < float(jnp.std(z)) < 1.12
    assert "(400,) fits" in repr(fits)
    with pytest.raises(ValueError, match="batch"):
        _ = fits.undetermined


@pytest.mark.slow
def test_what_the_data_do_not_say_is_said_in_words():
    def product(p):
        return p["stiffness"] / p["density"] * TIMES * jnp.exp(-p["rate"] * TIMES)

    truth = {"stiffness": 6.0, "density": 2.0, "rate": 0.7}
    start = {"stiffness": 4.0, "density": 3.0, "rate": 1.0}
    observed = product(truth) + noise(2)
    fit = control.fit(product, observed, start, noise=SD)
    assert not bool(fit.determined)
    (words,) = fit.undetermined
    assert words == (
        "density and stiffness each: changing density by +10 %, stiffness by +10 % "
        "together leaves the data as they are"
    )
    table = str(fit)
    assert "not determined: density" in table
    assert table.count("not known") == 2
    # What they do determine is found, and so is what follows from it.
    ratio = float(fit.values["stiffness"] / fit.values["density"])
    assert ratio == pytest.approx(3, rel=0.02)
    assert abs(float(fit.z(truth)["rate"])) < 4
    ahead = fit.forecast(lambda p: product(p)[-1])
    assert float(ahead.sd) < SD
    # One more observation and everything is determined.
    both = {"film": observed, "weight": jnp.asarray(2.02)}
    sd = {"film": SD, "weight": 0.02}
    fit = control.fit(
        lambda p: {"film": product(p), "weight": p["density"]}, both, start, noise=sd
    )
    assert fit.undetermined == ()
    assert float(fit.standard_deviations["density"]) == pytest.approx(0.02, rel=0.05)
    assert set(fit.residual_sd) == {"film", "weight"}


@pytest.mark.slow
def test_a_parameter_that_does_nothing_is_named_alone():
    observed = ring(TRUTH) + noise(3)
    fit = control.fit(ring, observed, START | {"colour": 1.0}, noise=SD)
    assert fit.undetermined == ("colour: the data say next to nothing about it",)
    assert np.isinf(fit.standard_deviations["colour"])
    assert float(fit.values["rate"]) == pytest.approx(TRUTH["rate"], rel=0.2)


@pytest.mark.slow
def test_observations_that_were_not_made_are_left_out():
    observed = np.asarray(ring(TRUTH) + noise(4))
    hidden = observed.copy()
    hidden[25:] = np.nan
    fit = control.fit(ring, jnp.asarray(hidden), START, noise=SD)
    cut = control.fit(
        lambda p: ring(p)[:25], jnp.asarray(observed[:25]), START, noise=SD
    )
    for name in TRUTH:
        assert float(fit.values[name]) == pytest.approx(float(cut.values[name]))
    assert int(fit.degrees_of_freedom) == int(cut.degrees_of_freedom) == 23


@pytest.mark.slow
def test_bounds_hold_and_are_said():
    fit = control.fit(ring, ring(TRUTH), START, noise=SD, lower={"rate": 1.0})
    assert float(fit.values["rate"]) == pytest.approx(1.0)
    assert "rate is at its bound" in str(fit)
    assert "more than noise" in str(fit)


@pytest.mark.slow
def test_a_step_to_nothing_can_be_taken_back():
    """Far off in one parameter, the first step takes the other to next to nothing."""

    def curve(p):
        return p["a"] * (1 + p["b"] * TIMES)

    truth = {"a": 1.0, "b": 0.4}
    fit = control.fit(curve, curve(truth), {"a": 3.0, "b": 0.2}, noise=SD)
    assert bool(fit.converged)
    assert float(fit.values["b"]) == pytest.approx(0.4, rel=1e-3)


@pytest.mark.slow
def test_what_is_observed_may_be_known_while_a_program_is_traced():
    observed = np.asarray(ring(TRUTH))
    fit = jax.jit(lambda s: control.fit(ring, observed, s, noise=SD))(START)
    assert float(fit.values["rate"]) == pytest.approx(TRUTH["rate"], rel=1e-4)


@pytest.mark.slow
def test_a_start_that_blows_up_is_said():
    fit = control.fit(lambda p: ring(p) / (p["rate"] < 1), ring(TRUTH), START, noise=SD)
    assert not bool(fit.converged)
    assert "NOTHING FOUND" in str(fit)


@pytest.mark.slow
def test_a_search_that_was_cut_short_says_so():
    fit = control.fit(ring, ring(TRUTH), START, noise=SD, iterations=2)
    assert not bool(fit.converged)
    assert "NOT CONVERGED" in str(fit)


@pytest.mark.slow
def test_forecasts_have_the_spread_of_many_fits():
    later = np.linspace(2, 3, 5)

    def longer(p):
        return jnp.exp(-p["rate"] * later) * jnp.cos(p["frequency"] * later)

    draws = ring(TRUTH)[None] + jnp.asarray(noise(5, (400, len(TIMES))))
    fits = jax.jit(jax.vmap(lambda o: control.fit(ring, o, START, noise=SD)))(draws)
    ahead = fits.forecast(longer)
    spread = np.std(np.asarray(ahead.value), axis=0)
    np.testing.assert_allclose(np.mean(np.asarray(ahead.sd), axis=0), spread, rtol=0.15)


@pytest.mark.slow
def test_arrays_are_parameters_too():
    truth = {"heights": np.array([1.0, 2.0, 3.0])}
    fit = control.fit(
        lambda p: jnp.cumsum(p["heights"]), np.cumsum([1.0, 2.0, 3.0]),
        {"heights": np.ones(3)}, noise=0.1, tolerance=1e-14,
    )  # fmt: skip
    np.testing.assert_allclose(fit.values["heights"], truth["heights"], rtol=1e-6)
    assert fit.names == ("heights[0]", "heights[1]", "heights[2]")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"start": {}}, "at least one parameter"),
        ({"start": {"frequency": -1.0, "rate": 1.0}}, "leave it out of logarithmic"),
        ({"start": {"frequency": np.nan, "rate": 1.0}}, "must be finite"),
        ({"logarithmic": ["mass"]}, "logarithmic names mass"),
        ({"upper": {"mass": 3.0}}, "upper names mass"),
        ({"lower": {"rate": 3.0}, "upper": {"rate": 2.0}}, "lower must be below"),
        ({"noise": -1.0}, "noise must be positive"),
        ({"noise": {"film": 1.0}}, "noise must be a number or a tree"),
        ({"observed": np.zeros(3)}, "shapes that simulate returns"),
        ({"observed": {"film": np.zeros(40)}}, "tree structure that simulate returns"),
        ({"observed": np.full(40, np.nan)}, "at least one finite number"),
    ],
)
def test_bad_arguments_are_refused(change, words):
    given = {"observed": np.zeros(40), "start": START, "noise": SD} | change
    observed, start = given.pop("observed"), given.pop("start")
    with pytest.raises(ValueError, match=words):
        control.fit(ring, observed, start, **given)


def test_residuals_of_each_kind_are_in_its_unit_and_none_where_none_was_seen():
    seen = {
        "a": np.array([True]),
        "b": np.array([True, False, True]),
        "c": np.array([False]),
    }
    noise = {"a": 2.0, "b": 0.5, "c": 1.0}
    # In the order of the tree, divided by the noise, and zero where nothing was seen.
    flat = jnp.asarray([3.0, 6.0, 0.0, 8.0, 0.0])
    found = _spreads(flat, seen, noise)
    assert float(found["a"]) == 6.0
    assert float(found["b"]) == pytest.approx(np.sqrt((3.0**2 + 4.0**2) / 2))
    assert float(found["c"]) == 0.0


def test_several_kinds_need_their_noise():
    with pytest.raises(ValueError, match="given for each kind"):
        control.fit(lambda p: (ring(p), p["rate"]), (np.zeros(40), np.zeros(())), START)
