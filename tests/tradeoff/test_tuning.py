"""The cheapest setting that keeps a tolerance."""

import dataclasses
from functools import partial

import numpy as np
import pytest

import jaxrod
from jaxrod.tradeoff import tuning
from jaxrod.tradeoff.measure import reference, tip_error, tips_of
from jaxrod.tradeoff.workload import swing


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """A small reference: enough for tolerances of some per cent."""

    def coarse(workload, *, enough):
        return reference(workload, 24)

    monkeypatch.setattr(tuning, "reference", coarse)


tune = partial(jaxrod.tune, elements=(4, 5, 7, 10), seconds=0.01)


def quarter_of_a_swing():
    return dataclasses.replace(swing(), controls=np.zeros((25, 0)))


@pytest.mark.slow
def test_what_is_found_keeps_the_tolerance_and_is_the_coarsest():
    lines = []
    workload = quarter_of_a_swing()
    found = tune(workload, max_error=0.002, log=lines.append)
    assert found.met and found.error <= 0.002
    exact = reference(workload, 24)
    again = tip_error(tips_of(workload, found.prepared), exact.tips, exact.length)
    assert again == pytest.approx(found.error, rel=0.01)
    # Fewer elements were tried and do not keep it; the cheapest may have a few more.
    accurate = [one for one in found.tried if one.error <= 0.002]
    assert 4 < min(one.setting.n_elements for one in accurate) <= 7
    timed = [one for one in found.tried if one.wall_s_per_sim_s]
    assert found.wall_s_per_sim_s == min(one.wall_s_per_sim_s[1] for one in timed)
    assert any("planar" in one.setting.reductions for one in timed)
    assert any("error" in line for line in lines)
    assert str(found).startswith("n = ")


@pytest.mark.slow
def test_it_says_so_when_nothing_keeps_the_tolerance():
    found = tune(quarter_of_a_swing(), max_error=0.0008, elements=(4, 8))
    assert not found.met
    assert found.error > 0.0008
    assert found.error == min(one.error for one in found.tried)
    assert "no setting is within 0.0008" in str(found)


@pytest.mark.slow
def test_own_scenes_are_tuned_by_resampling_them():
    rod, state = jaxrod.straight_rod(
        20, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e7
    )
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), jaxrod.gravity((9.81, 0.0, 0.0))
    )
    found = tune(scene, state, max_error=0.03, duration=0.3)
    assert found.met
    assert found.setting.n_elements < 20
    assert found.prepared.scene.rod.n_elements == found.setting.n_elements


def test_bad_input_is_refused():
    rod, state = jaxrod.straight_rod(
        4, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e7
    )
    scene = jaxrod.make_scene(rod)
    with pytest.raises(ValueError, match="max_error must be positive, got 0"):
        jaxrod.tune(scene, state, max_error=0.0)
    with pytest.raises(
        ValueError,
        match=r"elements must be increasing numbers, at least one, got \(8, 8\)",
    ):
        jaxrod.tune(scene, state, elements=(8, 8))
    with pytest.raises(ValueError, match="state must be given"):
        jaxrod.tune(scene)
    with pytest.raises(ValueError, match="too much to judge a max_error of 1e-06"):
        jaxrod.tune(quarter_of_a_swing(), max_error=1e-6)
    with pytest.raises(ValueError, match="batch must be at least 1, got 0"):
        jaxrod.tune(scene, state, batch=0)
    with pytest.raises(
        TypeError, match=r"scene must be a jaxrod\.Scene or a jaxrod\.System"
    ):
        jaxrod.tune(rod, state)
    _, longer = jaxrod.straight_rod(
        5, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e7
    )
    with pytest.raises(ValueError, match="state must have 4 elements"):
        jaxrod.tune(scene, longer)
    broken = dataclasses.replace(state, velocities=state.velocities * np.nan)
    with pytest.raises(ValueError, match="state must be finite"):
        jaxrod.tune(scene, broken)
    aside = jaxrod.make_scene(
        rod, jaxrod.gravity((0.0, 9.81, 0.0)), method=jaxrod.planar("zx")
    )
    with pytest.raises(ValueError, match="zx plane needs forces of effects"):
        jaxrod.tune(aside, state)
