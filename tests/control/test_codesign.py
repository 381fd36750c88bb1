"""A body that may taper needs less effort for the same reach."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import control

N, LENGTH, RADIUS = 6, 1.0, 0.05
MOST_TAPER = 0.4
TARGET = (0.25, 0.9, 0.1)


def rod(taper):
    """Radii fall along the arm by this share either way; the volume is one for all."""
    middles = (jnp.arange(N) + 0.5) / N
    shape = 1 + taper * (1 - 2 * middles)
    radii = RADIUS * shape / jnp.sqrt(jnp.mean(shape**2))
    return jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=radii,
        density=1000.0,
        youngs_modulus=1e7,
        direction=(0, 1, 0),
        normal=(1, 0, 0),
    )


def tapered(data, design):
    scene = replace(data.arm.scene, rod=rod(design["taper"])[0])
    return replace(data, arm=replace(data.arm, scene=scene))


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_body_that_may_taper_needs_a_fifth_less_effort_for_the_same_reach(record):
    body, state = rod(0.0)
    scene = jaxrod.make_scene(
        body, jaxrod.clamp(state), jaxrod.exponential_damping(4.0)
    )
    spline = jaxrod.actuation.control_spline(3, LENGTH)
    arm = control.ActuatedArm(scene, state, spline, jnp.asarray(250.0))
    dt = 0.5 * float(jaxrod.stable_dt(replace(scene, rod=rod(MOST_TAPER)[0])).dt)
    problem = control.reach(arm, TARGET, 0.6, dt=dt, control_interval=0.06)
    settings = {"n_knots": 6, "ridge": 1e-4, "iterations": 40}
    fixed = control.levenberg_marquardt(problem, **settings)
    limits = {"lower": -MOST_TAPER, "upper": MOST_TAPER}
    free = control.codesign(problem, tapered, {"taper": 0.0}, **limits, **settings)
    efforts = []
    for found in (fixed, free):
        assert found.readouts["distance [m]"][-1] < 2e-3
        assert found.readouts["tip speed [m/s]"][-1] < 0.1
        efforts.append(float(np.mean(np.asarray(found.knots) ** 2)))
    thinner, even = free.problem.data.scene.rod, fixed.problem.data.scene.rod
    volumes = [
        float(jnp.sum(one.radii**2 * one.rest_lengths)) for one in (thinner, even)
    ]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-5)
    assert float(jaxrod.stable_dt(free.problem.data.scene).dt) >= dt
    assert abs(float(free.design["taper"])) > 0.1
    record(
        "effort of an arm that may taper, of equal volume",
        "share of the even arm's",
        efforts[1] / efforts[0],
        at_most=0.8,
    )
    assert efforts[1] < 0.8 * efforts[0]


def test_a_design_without_numbers_is_refused():
    problem = control.make_problem(
        jnp.zeros(1),
        lambda data, state, force, k: state + force,
        n_intervals=2,
        interval=1.0,
        n_controls=1,
        final=lambda data, state: state,
    )
    with pytest.raises(ValueError, match="design must have at least one number"):
        control.codesign(problem, lambda data, design: data, {})
    with pytest.raises(ValueError, match="ridge must be positive"):
        control.codesign(problem, lambda data, design: data, {"a": 1.0}, ridge=0.0)
