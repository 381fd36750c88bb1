"""Errors against a converged reference, and the settings that are measured."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.tradeoff import Setting, measure, prepare, reference, workload_of
from jaxrod.tradeoff.measure import tip_error, tips_of
from jaxrod.tradeoff.workload import rope, slam, swing, tracking_arm


def short(workload, periods):
    return dataclasses.replace(workload, controls=workload.controls[:periods])


@pytest.fixture(scope="module")
def swinging():
    """A quarter of a swing, with a reference of 24 elements."""
    with jax.enable_x64(True):
        workload = short(swing(), 25)
        return workload, reference(workload, 24)


@pytest.mark.slow
def test_the_error_falls_with_the_square_of_the_number_of_elements(swinging):
    workload, exact = swinging
    errors = [
        measure(workload, Setting(n, dtype="float64"), exact, seconds=0.01).error
        for n in (4, 8)
    ]
    # The reference of 24 elements has a ninth of the error of 8.
    assert 3.0 < errors[0] / errors[1] < 6.0
    assert exact.error < 0.2 * errors[1]


@pytest.mark.slow
def test_the_reference_knows_how_wrong_it_is(swinging):
    workload, exact = swinging
    finer = tips_of(
        workload, prepare(workload, Setting(48, dtype="float64", safety=0.1))
    )
    assert 0.5 < tip_error(exact.tips, finer, exact.length) / exact.error < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "reductions", [("planar",), ("untwisted",), ("compensated",), ("inertia",)]
)
def test_reductions_are_what_they_say(swinging, reductions):
    workload, exact = swinging
    plain = measure(workload, Setting(8), exact, seconds=0.01)
    reduced = measure(workload, Setting(8, reductions=reductions), exact, seconds=0.01)
    assert reduced.setting.reductions == reductions
    assert reduced.error == pytest.approx(plain.error, rel=1.0)
    if reductions == ("inertia",):
        assert reduced.setting.dt > 1.2 * plain.setting.dt
    else:
        assert reduced.setting.dt == plain.setting.dt


@pytest.mark.slow
def test_implicit_steps_are_measured_too(swinging):
    workload, exact = swinging
    setting = Setting(5, workload.period, "float64", integrator="implicit")
    assert measure(workload, setting, exact, seconds=0.01).error < 0.05
    with pytest.raises(ValueError, match="needs a step dt"):
        prepare(workload, dataclasses.replace(setting, dt=None))


@pytest.mark.slow
def test_steps_divide_the_control_period():
    workload = tracking_arm()
    for n in (5, 20):
        prepared = prepare(workload, Setting(n))
        assert prepared.setting.dt * prepared.substeps == pytest.approx(1.4e-3)
        limit = float(jaxrod.stable_dt(prepared.scene, 1.0).dt)
        assert prepared.setting.dt <= 0.9 * limit * (1 + 1e-6)


@pytest.mark.slow
def test_a_run_that_blows_up_has_an_infinite_error(swinging):
    workload, exact = swinging
    assert measure(workload, Setting(10, 0.01), exact, seconds=0.01).error > 10


def test_a_rod_without_a_plane_is_not_planar():
    with pytest.raises(ValueError, match="tracking does not move in a plane"):
        prepare(tracking_arm(), Setting(5, reductions=("planar",)))


@pytest.mark.slow
def test_own_scenes_become_workloads():
    rod, state = jaxrod.straight_rod(
        8, length=2.0, radius=0.05, density=1000.0, youngs_modulus=1e6
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity((0.5, 0, 0)))
    workload = workload_of(scene, state, duration=0.2, periods=4)
    assert workload.duration == pytest.approx(0.2)
    tips = tips_of(workload, prepare(workload, Setting(8, dtype="float64")))
    steps = round(0.2 / prepare(workload, Setting(8, dtype="float64")).setting.dt)
    alone = jaxrod.advance(scene, state, 0.2 / steps, steps)
    ends_and_middle = alone.positions[:, [0, 4, 8]].T
    np.testing.assert_allclose(tips[-1], ends_and_middle, atol=1e-12)
    with pytest.raises(ValueError, match="duration must be positive"):
        workload_of(scene, state, duration=0.0)
    with pytest.raises(ValueError, match="PyElastica's law cannot be tuned"):
        workload_of(dataclasses.replace(scene, method=jaxrod.pyelastica()), state)


@pytest.mark.slow
def test_schedules_go_on_from_period_to_period():
    rod, state = jaxrod.straight_rod(
        4, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e6
    )
    pull = jaxrod.schedules.sine((0.0, 0.0, 2.0), period=0.07)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.uniform_load(pull))
    work = workload_of(scene, state, duration=0.1, periods=5)
    ready = prepare(work, Setting(4, dtype="float64"))
    after = jaxrod.advance(scene, state, ready.setting.dt, 5 * ready.substeps)
    points = after.positions[:, [0, 2, 4]].T
    np.testing.assert_allclose(tips_of(work, ready)[-1], points, atol=1e-12)


@pytest.mark.slow
def test_a_slammed_arm_hits_its_post_and_converges():
    workload = slam()
    coarse, fine, finer = (
        tips_of(workload, prepare(workload, Setting(n, reductions=("planar",))))
        for n in (10, 20, 40)
    )
    free = dataclasses.replace(workload, build=swing().build)
    missed = tips_of(free, prepare(free, Setting(20, reductions=("planar",))))
    assert np.max(np.abs(missed - fine)) > 0.1
    errors = [tip_error(tips, finer, 1.0) for tips in (coarse, fine)]
    assert errors[1] < 0.5 * errors[0] < 0.01


@pytest.mark.slow
def test_the_rope_is_slender_and_the_arm_is_not():
    assert prepare(rope(), Setting(20, reductions=("inertia",))).substeps < 40
    scene = prepare(swing(), Setting(20, reductions=("inertia",))).scene
    plain = prepare(swing(), Setting(20)).scene
    np.testing.assert_array_equal(scene.rod.rotary_inertia, plain.rod.rotary_inertia)
    assert scene.rod.rotary_inertia.dtype == jnp.float32


def test_the_post_is_below_a_point_at_two_thirds_of_the_arm():
    prepared = prepare(slam(), Setting(8))
    (contact,) = (e for e in prepared.scene.effects if hasattr(e, "body"))
    along = jnp.linspace(0, 1, 101)
    distance, _ = contact.body.surface((along, 0 * along, 0 * along))
    nearest = int(jnp.argmin(distance))
    assert abs(float(along[nearest]) - 2 / 3) < 0.02
    assert 0 < float(distance[nearest]) < 0.5  # the arm falls on it
