"""Windows whose starts are sought too: closed forms, calibration, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from control.calibration import assert_calibrated
from jaxrod import control
from jaxrod.control import MultipleShooting

SD = 0.02
EVERY = 5
TIMES = 0.1 * np.arange(EVERY)
WINDOWS = 8
TRUTH = {"frequency": 3.0, "rate": 0.4}
START = {"frequency": 4.0, "rate": 1.2}


def ring(p, start, known=()):
    """A damped oscillation from a place and a speed, in closed form."""
    decay, turn = jnp.exp(-p["rate"] * TIMES), p["frequency"] * TIMES
    x, v = start["x"], start["v"]
    swing = (v + p["rate"] * x) / p["frequency"]
    return decay * (x * jnp.cos(turn) + swing * jnp.sin(turn))


def true_starts():
    x, v = np.random.default_rng(3).normal(size=(2, WINDOWS))
    return {"x": jnp.asarray(x), "v": jnp.asarray(3 * v)}


def drawn(seed):
    clean = jax.vmap(ring, in_axes=(None, 0))(TRUTH, true_starts())
    return clean + SD * jax.random.normal(jax.random.key(seed), clean.shape)


def guessed(observed):
    return {
        "x": observed[:, 0],
        "v": (observed[:, 1] - observed[:, 0]) / TIMES[1],
    }


def ring3(p, start, known):
    return ring(p, start)


def fitted(observed, begin, known=(), **more):
    windows = MultipleShooting(begin, known=known)
    return control.fit(
        ring3, observed, START, multiple_shooting=windows, noise=SD, **more
    )


@pytest.mark.slow
def test_it_is_what_a_fit_finds_with_all_starts_among_the_parameters():
    observed = drawn(0)
    begin = guessed(observed)

    def everything(p):
        starts = {"x": p["x"], "v": p["v"]}
        return jax.vmap(ring, in_axes=(None, 0))(p, starts)

    together = control.fit(
        everything,
        observed,
        START | begin,
        noise=SD,
        logarithmic=tuple(START),
        tolerance=1e-13,
    )
    fit = fitted(observed, begin, tolerance=1e-13)
    assert bool(fit.converged)
    assert (
        int(fit.degrees_of_freedom)
        == int(together.degrees_of_freedom)
        == WINDOWS * (EVERY - 2) - 2
    )
    assert float(fit.misfit) == pytest.approx(float(together.misfit), rel=1e-6)
    for name in START:
        expected = float(together.values[name])
        assert float(fit.values[name]) == pytest.approx(expected, rel=1e-5)
        expected = float(together.standard_deviations[name])
        found = float(fit.standard_deviations[name])
        assert found == pytest.approx(expected, rel=1e-4), name
    for name, leaf in fit.unknowns.items():
        np.testing.assert_allclose(leaf, together.values[name], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_standard_deviations_hold_what_the_starts_take_from_the_data():
    def fit(seed):
        observed = drawn(seed)
        return fitted(observed, guessed(observed))

    fits = jax.jit(jax.vmap(fit))(jnp.arange(200))
    assert_calibrated(fits, TRUTH)


@pytest.mark.slow
def test_kinds_and_what_was_not_seen():
    clean = jax.vmap(ring, in_axes=(None, 0))(TRUTH, true_starts())
    observed = {"x": clean.at[0, 2].set(jnp.nan), "twice": 2 * clean}

    def both(p, start, known):
        x = ring(p, start)
        return {"x": x, "twice": known * x}

    fit = control.fit(
        both,
        observed,
        START,
        multiple_shooting=MultipleShooting(
            guessed(clean), known=jnp.full(WINDOWS, 2.0)
        ),
        noise={"x": SD, "twice": 0.1},
        tolerance=1e-13,
    )
    for name, value in TRUTH.items():
        assert float(fit.values[name]) == pytest.approx(value, rel=1e-4)
    assert int(fit.degrees_of_freedom) == 2 * WINDOWS * EVERY - 1 - 2 * WINDOWS - 2
    # Rows of kinds are kept apart.
    assert fit.residual_sd["x"].shape == fit.residual_sd["twice"].shape == ()


@pytest.mark.slow
def test_a_start_that_nothing_shows_takes_nothing():
    observed = drawn(1)
    begin = guessed(observed)
    plain = fitted(observed, begin)
    unseen = fitted(observed, begin | {"idle": jnp.ones(WINDOWS)})
    for name in START:
        expected = float(plain.standard_deviations[name])
        found = float(unseen.standard_deviations[name])
        assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_parameters_stay_in_bounds():
    observed = drawn(2)
    upper = {"frequency": 4.5, "rate": 2.0}
    lower = {"frequency": 3.5, "rate": 0.1}
    fit = fitted(observed, guessed(observed), lower=lower, upper=upper)
    assert float(fit.values["frequency"]) == pytest.approx(3.5)
    assert [bool(held) for held in fit.at_bound] == [True, False]


def test_bad_arguments_are_refused():
    observed = drawn(0)
    begin = guessed(observed)
    with pytest.raises(ValueError, match="observed and known must have a leading axis"):
        fitted(observed[1:], begin)
    with pytest.raises(ValueError, match="observed and known must have a leading axis"):
        fitted(observed, begin, known=jnp.zeros(3))
    with pytest.raises(ValueError, match="same length in every leaf"):
        fitted(observed, begin | {"x": jnp.zeros(2)})
    with pytest.raises(ValueError, match="lower names stiffness"):
        fitted(observed, begin, lower={"stiffness": 1})
    with pytest.raises(ValueError, match='mode must be "forward"'):
        fitted(observed, begin, mode="reverse")
