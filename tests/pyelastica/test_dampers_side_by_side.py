"""PyElastica's dampers beside their counterparts here, to round-off."""

from dataclasses import replace

import elastica
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from pyelastica import reference, scenes
from pyelastica.test_side_by_side import same_scene

STEPS, N = 200, 8
DAMPERS = {
    "uniform_damping_constant": (
        {"uniform_damping_constant": 3.0},
        jaxrod.exponential_damping(3.0),
    ),
    "damping_constant": ({"damping_constant": 0.3}, jaxrod.linear_damper(0.3)),
    "physical constants": (
        {
            "translational_damping_constant": 0.5,
            "rotational_damping_constant": 2e-4,
        },
        jaxrod.linear_damper(translational=0.5, rotational=2e-4),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMPERS)
def test_linear_dampers_are_those_of_pyelastica(name, record, monkeypatch):
    """On a clamped rod, curved, tapered and uneven, that moves and is stretched."""
    numbers, damper = DAMPERS[name]
    drawn = replace(
        scenes.random_scene(6, n_elements=N),
        clamped=True,
        damping_rate=0.0,
        deprecated_damping=0.0,
    )
    free, state = same_scene(drawn)
    effects = (*free.effects, damper)
    scene = jaxrod.make_scene(free.rod, *effects, method=jaxrod.pyelastica())
    dt = float(jaxrod.stable_dt(scene, 0.5).dt)
    add_loads = reference._add_loads

    def add(simulator, rod, loads):
        add_loads(simulator, rod, loads)
        simulator.dampen(rod).using(
            elastica.AnalyticalLinearDamper, time_step=dt, **numbers
        )

    monkeypatch.setattr(reference, "_add_loads", add)
    theirs = reference.simulate(**(vars(drawn) | {"dt": dt}), steps=STEPS)
    mine = jaxrod.advance(scene, state, dt, STEPS)
    undamped = jaxrod.advance(free, state, dt, STEPS)
    assert np.max(np.abs(mine.positions - undamped.positions)) > 1e-4
    spin = jaxrod.angular_velocities(scene.rod, mine)
    for what, one, two in (
        ("positions [m]", mine.positions, theirs.positions[-1]),
        ("angular velocities, relative", spin, theirs.angular_velocities[-1]),
    ):
        size = 1.0 if what == "positions [m]" else np.max(np.abs(two))
        record(
            f"AnalyticalLinearDamper, {name}, {STEPS} steps: {what}",
            "PyElastica 1.0",
            np.max(np.abs(one - two)) / size,
            at_most=1e-11,
        )


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"translational": 1.0},
        {"damping_constant": 1.0, "translational": 1.0, "rotational": 1.0},
    ],
)
def test_constants_of_one_kind_are_needed(given):
    with pytest.raises(ValueError, match=r"damping_constant .* alone"):
        jaxrod.linear_damper(**given)


@pytest.mark.slow
def test_other_methods_refuse_the_linear_damper():
    rod, state = jaxrod.straight_rod(
        2, length=1.0, radius=0.1, density=1e3, youngs_modulus=1e6, dtype=jnp.float64
    )
    scene = jaxrod.make_scene(rod, jaxrod.linear_damper(1.0))
    with pytest.raises(ValueError, match="exponential_damping"):
        jaxrod.advance(scene, state, 1e-5, 1)
