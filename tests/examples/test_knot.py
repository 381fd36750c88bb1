"""The knot of the examples, small: contact of a rod with itself, from lists."""

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from examples.loading import load


@pytest.mark.slow
def test_a_small_knot_runs_and_is_kept():
    with jax.enable_x64(True):
        system, state, dt = load("knot").build(n=100)
        after = jaxrod.advance(system, state, dt, 20)
        lists = after["neighbours"]
        assert lists.missed <= 0 and lists.moved < 1 and lists.used > 5
        # Ends are pulled apart, and the rod does not pass through itself.
        ends = [one["rope"].positions[0, jnp.array([0, -1])] for one in (state, after)]
        assert ends[1][1] - ends[1][0] > ends[0][1] - ends[0][0]
        assert not jaxrod.topology.crossed(state["rope"], after["rope"])
