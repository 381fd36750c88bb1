"""Multiple shooting: windows of a film, and a motion that no single run can follow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import control
from jaxrod.control import shots, windows


def test_windows_hold_the_frames_after_their_starts():
    film = {"x": jnp.arange(10), "y": jnp.arange(20).reshape(10, 2)}
    cut = windows(film, 3)
    np.testing.assert_array_equal(cut["x"], [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert cut["y"].shape == (3, 3, 2)
    cut = windows(film, 2, every=4)
    np.testing.assert_array_equal(cut["x"], [[1, 2], [5, 6]])
    cut = windows(film, 5, with_starts=True)
    np.testing.assert_array_equal(cut["x"], [np.arange(5), np.arange(5, 10)])


def forked(rate, start, frames, dt=0.05):
    """A double well: which one it ends in hangs on nearly nothing at the start."""

    def one(state, _):
        x, v = state
        v = v + dt * (x - x**3 - rate * v)
        return (x + dt * v, v), (x + dt * v, v)

    return jax.lax.scan(one, start, length=frames)[1]


@pytest.mark.slow
def test_a_fork_that_a_single_run_gets_wrong_is_followed_in_windows():
    truth, sd = 0.3, 0.01
    begin = (jnp.asarray(1e-3), jnp.asarray(0.0))
    x, v = forked(truth, begin, 400)
    x = x + sd * np.random.default_rng(0).normal(size=400)
    v = v + sd * np.random.default_rng(1).normal(size=400)
    start = {"rate": 1.0}
    # What is known of the start is on the wrong side of the fork.
    wrong = (jnp.asarray(-1e-3), jnp.asarray(0.0))
    single = control.fit(lambda p: forked(p["rate"], wrong, 400)[0], x, start, noise=sd)
    assert float(single.misfit) > 100
    every = 3
    starts = tuple(leaf[:-every:every] for leaf in (x, v))
    simulate = shots(lambda p, s: forked(p["rate"], s, every)[0], starts)
    seen = windows(x, every)
    assert jax.eval_shape(simulate, start).shape == seen.shape
    fit = control.fit(simulate, seen, start, noise=sd)
    assert float(fit.misfit) < 4  # The starts are as noisy as what follows them.
    assert float(fit.values["rate"]) == pytest.approx(truth, rel=0.1)


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="same length in every leaf"):
        shots(lambda p, s: s, (np.zeros(3), np.zeros(4)))
    with pytest.raises(ValueError, match="at least 6 frames"):
        windows(np.zeros(5), 5)
    with pytest.raises(ValueError, match="every must be at least 1"):
        windows(np.zeros(9), 5, every=0)
