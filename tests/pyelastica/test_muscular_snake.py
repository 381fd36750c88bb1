"""The muscular snake in PyElastica's laws beside PyElastica, on the same ground."""

from dataclasses import replace

import elastica
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.muscular_snake import scene
from benchmarks.muscular_snake.our_ground import our_ground

STIRRED = 0.01
"""Speeds at the start [m/s]."""


@pytest.mark.slow
def test_nine_rods_crawl_as_theirs_on_the_same_ground(record):
    """All muscles pull within a quarter of a period."""
    parts = ("rods", "joints", "damping")
    system, state = scene.ours(theirs=parts)
    simulator, rods = scene.theirs(ground=our_ground(0.02, 1000.0))
    rng = np.random.default_rng(0)
    state = {
        name: replace(
            own,
            velocities=jnp.asarray(STIRRED * rng.normal(size=own.velocities.shape)),
        )
        for name, own in state.items()
    }

    def each(field):
        body, *others = (getattr(state[name], field) for name in ("body", *scene.SIZES))
        return [np.asarray(own) for own in (body, *others[0], *others[1])]

    for rod, velocities in zip(rods, each("velocities"), strict=True):
        rod.velocity_collection[...] = velocities
    started = each("positions")
    steps = 50_000
    state = jax.jit(jaxrod.advance)(system, state, scene.STEP, jnp.asarray(steps))
    stepper, time = elastica.PositionVerlet(), np.float64(0.0)
    for _ in range(steps):
        time = stepper.step(simulator, time, np.float64(scene.STEP))
    ours = each("positions")
    moved = max(np.max(np.abs(a - b)) for a, b in zip(ours, started, strict=True))
    assert moved > 1e-3
    apart = [
        np.max(np.abs(own - rod.position_collection))
        for own, rod in zip(ours, rods, strict=True)
    ]
    record(
        "muscular snake in PyElastica's laws, the same ground: nodes of nine rods "
        "after a quarter of a period, 50,000 steps [m]",
        "PyElastica 1.0",
        max(apart),
        at_most=1e-9,
    )
