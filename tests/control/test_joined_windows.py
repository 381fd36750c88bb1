"""Windows that are joined: one long run's fit, calibration, a fork, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from control.calibration import assert_calibrated
from jaxrod import control
from jaxrod.control import MultipleShooting

SD = 0.02
EVERY, WINDOWS, FILMS = 5, 8, 3
STEPS, DT = 10, 0.02
TRUTH = {"push": 1.0, "hardening": 1.5, "damping": 0.3}
START = {"push": 1.3, "hardening": 1.2, "damping": 0.5}


def run(p, state, known=()):
    """A mass between two hollows, frame by frame, and where the next frame finds it."""

    def step(state, _):
        x, v = state["x"], state["v"]
        pull = p["push"] * x - p["hardening"] * x**3 - p["damping"] * v
        v = v + DT * pull
        return {"x": x + DT * v, "v": v}, None

    def frame(state, _):
        return jax.lax.scan(step, state, None, STEPS)[0], state["x"]

    end, places = jax.lax.scan(frame, state, None, EVERY)
    return places, end


def begin(p, own, known=()):
    return own


def whole(p, own, windows=WINDOWS):
    """One long run."""

    def window(state, _):
        places, end = run(p, state)
        return end, places

    return jax.lax.scan(window, own, None, windows)[1]


def rolling():
    return {"x": jnp.array([0.4, -1.2, 1.5]), "v": jnp.array([0.5, 0.0, -1.5])}


def drawn(seed, own):
    clean = jax.vmap(whole, in_axes=(None, 0))(TRUTH, own)
    return clean + SD * jax.random.normal(jax.random.key(seed), clean.shape)


def guessed(observed):
    x = observed[..., 0]
    return {"x": x, "v": (observed[..., 1] - x) / (STEPS * DT)}


def firsts(states):
    return jax.tree.map(lambda leaf: leaf[:, 0], states)


def fitted(observed, unknowns, **more):
    windows = MultipleShooting(unknowns, states=guessed(observed), initial_state=begin)
    return control.fit(
        run, observed, START, multiple_shooting=windows, noise=SD, **more
    )


@pytest.mark.slow
def test_it_is_what_a_fit_finds_with_one_long_run():
    observed = drawn(0, rolling())
    together = control.fit(
        lambda p: jax.vmap(whole, in_axes=(None, 0))(p, {"x": p["x"], "v": p["v"]}),
        observed,
        TRUTH | rolling(),
        noise=SD,
        logarithmic=tuple(TRUTH),
        tolerance=1e-13,
    )
    fit = fitted(observed, firsts(guessed(observed)), tolerance=1e-13)
    assert bool(together.converged)
    assert bool(fit.converged)
    assert int(fit.degrees_of_freedom) == int(together.degrees_of_freedom)
    assert float(fit.misfit) == pytest.approx(float(together.misfit), rel=1e-6)
    for name in TRUTH:
        expected = float(together.values[name])
        assert float(fit.values[name]) == pytest.approx(expected, rel=1e-4), name
        expected = float(together.standard_deviations[name])
        found = float(fit.standard_deviations[name])
        assert found == pytest.approx(expected, rel=1e-3), name
    for name, leaf in fit.unknowns.items():
        np.testing.assert_allclose(leaf, together.values[name], rtol=1e-3, atol=1e-4)
    # Windows end where the next ones begin.
    ends = jax.vmap(jax.vmap(lambda state: run(fit.values, state)[1]))(fit.states)
    for name in ends:
        np.testing.assert_allclose(
            ends[name][:, :-1], fit.states[name][:, 1:], atol=1e-4, err_msg=name
        )


@pytest.mark.slow
def test_standard_deviations_are_those_of_many_draws():
    def fit(seed):
        observed = drawn(seed, rolling())
        return fitted(observed, firsts(guessed(observed)))

    fits = jax.jit(jax.vmap(fit))(jnp.arange(200))
    assert_calibrated(fits, TRUTH)


@pytest.mark.slow
def test_it_follows_data_across_a_fork_where_one_long_run_is_lost():
    small = {"x": jnp.array([4e-3, -6e-3, 5e-3]), "v": jnp.array([0.0, 2e-3, -1e-3])}

    def long_run(p, own):
        return whole(p, own, 12)

    def all_runs(p, own):
        return jax.vmap(long_run, in_axes=(None, 0))(p, own)

    clean = all_runs(TRUTH, small)
    observed = clean + SD * jax.random.normal(jax.random.key(1), clean.shape)
    first = firsts(guessed(observed))
    fit = fitted(observed, first)
    assert bool(fit.converged)
    assert float(fit.misfit) == pytest.approx(1, abs=0.3)
    assert all(abs(float(z)) < 3 for z in fit.z(TRUTH).values())
    # One run from what was found falls to the side to which each mass fell.
    assert float(jnp.min(jnp.abs(clean[:, -1, -1]))) > 0.5
    np.testing.assert_allclose(all_runs(fit.values, fit.unknowns), clean, atol=2 * SD)
    lost = control.fit(
        lambda p: all_runs(p, {"x": p["x"], "v": p["v"]}),
        observed,
        START | first,
        noise=SD,
        logarithmic=tuple(START),
        mode="forward",
    )
    assert float(lost.misfit) > 100


@pytest.mark.slow
def test_kinds_and_what_was_not_seen():
    clean = drawn(2, rolling())
    observed = {"x": clean.at[0, 2, 1].set(jnp.nan), "twice": 2 * clean}

    def both(p, state, known):
        places, end = run(p, state)
        return {"x": places, "twice": known * places}, end

    states = guessed(clean)
    plain = fitted(clean, firsts(states))
    fit = control.fit(
        both,
        observed,
        START,
        multiple_shooting=MultipleShooting(
            firsts(states), states, known=jnp.full((FILMS, WINDOWS), 2.0)
        ),
        # Both kinds together weigh as one.
        noise={"x": np.sqrt(2) * SD, "twice": np.sqrt(8) * SD},
    )
    assert (
        int(fit.degrees_of_freedom) == 2 * FILMS * WINDOWS * EVERY - 1 - 2 * FILMS - 3
    )
    assert fit.residual_sd["twice"] == pytest.approx(
        2 * float(fit.residual_sd["x"]), rel=0.05
    )
    for name in TRUTH:
        expected = float(plain.values[name])
        assert float(fit.values[name]) == pytest.approx(expected, rel=0.02), name


@pytest.mark.slow
def test_parameters_stay_in_bounds():
    observed = drawn(3, rolling())
    lower = {"push": 1.1}
    fit = fitted(observed, firsts(guessed(observed)), lower=lower)
    assert float(fit.values["push"]) == pytest.approx(1.1)
    assert dict(zip(fit.names, fit.at_bound, strict=True))["push"]


@pytest.mark.slow
@pytest.mark.parametrize("sd", [SD, None])
def test_windows_that_do_not_meet_are_not_called_converged(sd):
    """In units of the noise, be it given or found."""
    observed = drawn(4, rolling())
    fit = fitted(observed, firsts(guessed(observed)))
    assert bool(fit.converged)
    apart = fit.states | {"x": fit.states["x"] + 0.01}
    left = control.fit(
        run,
        observed,
        fit.values,
        multiple_shooting=MultipleShooting(fit.unknowns, apart),
        noise=sd,
        iterations=0,
    )
    # All but the gaps is at the minimum.
    assert float(left.remaining) < 0.1
    assert not bool(left.converged)


def test_bad_arguments_are_refused():
    observed = drawn(0, rolling())
    states = guessed(observed)
    starts = firsts(states)

    def fit(run=run, begin=begin, observed=observed, states=states, **more):
        windows = MultipleShooting(
            more.pop("unknowns", starts), states, more.pop("known", ()), begin
        )
        control.fit(run, observed, START, multiple_shooting=windows, noise=SD, **more)

    with pytest.raises(ValueError, match="leading axes of trajectories and windows"):
        fit(observed=observed[:, 1:])
    with pytest.raises(ValueError, match="leading axes of trajectories and windows"):
        fit(known=jnp.zeros(FILMS))
    with pytest.raises(ValueError, match="for 3 trajectories"):
        short = jax.tree.map(lambda leaf: leaf[1:], (observed, states))
        fit(observed=short[0], states=short[1])
    with pytest.raises(ValueError, match="states must be of floats"):
        fit(states=jax.tree.map(lambda leaf: leaf.astype(int), states))
    missing = jax.tree.map(lambda leaf: leaf.at[0, 2].set(jnp.nan), states)
    with pytest.raises(ValueError, match="states must be finite"):
        fit(states=missing)
    whole_numbers = starts | {"v": jnp.zeros(FILMS, int)}
    with pytest.raises(ValueError, match="unknowns must be of floats, got int"):
        fit(unknowns=whole_numbers)
    with pytest.raises(ValueError, match="initial_state must make a state"):
        fit(begin=lambda p, own, known: own["x"])
    with pytest.raises(ValueError, match="simulate must end in a state"):
        fit(run=lambda p, state, known: (run(p, state)[0], state["x"]))
    with pytest.raises(ValueError, match="lower names stiffness"):
        fit(lower={"stiffness": 1})
