"""The grid of settings, and the simulators that are measured beside it."""

import csv
import dataclasses
import io

import jax
import numpy as np
import pytest

import jaxrod
from benchmarks.tradeoff import grid as grids
from benchmarks.tradeoff.mujoco_cable import measure_mujoco
from benchmarks.tradeoff.pyelastica import measure_pyelastica
from jaxrod.tradeoff import Reference, Setting, prepare, reference
from jaxrod.tradeoff.measure import tips_of
from jaxrod.tradeoff.workload import SCENES, slam, swing, tracking_arm


def short(problem, periods):
    return dataclasses.replace(problem, controls=problem.controls[:periods])


@pytest.fixture(scope="module")
def swinging():
    """A quarter of a swing, with a reference of 24 elements."""
    with jax.enable_x64(True):
        problem = short(swing(), 25)
        return problem, reference(problem, 24)


@pytest.mark.slow
def test_the_grid_has_every_way_of_simulating(swinging):
    problem, _ = swinging
    settings = list(grids.settings_of(problem, (5, 10)))
    assert {s.n_elements for s in settings} == {5, 10}
    assert {s.integrator for s in settings} == {"explicit", "implicit"}
    assert {s.mode for s in settings} == {"consistent", "pyelastica"}
    assert {s.dtype for s in settings} == {"float32", "float64"}
    assert {s.reductions for s in settings} == {
        (),
        ("planar",),
        ("untwisted",),
        ("inertia",),
        ("compensated",),
        ("planar", "inertia"),
    }
    driven = {s.reductions for s in grids.settings_of(tracking_arm())}
    assert driven == {(), ("inertia",), ("compensated",)}


@pytest.mark.slow
def test_the_table_has_every_column_and_pyelastica(swinging, monkeypatch):
    problem, exact = swinging
    some = [
        Setting(5, reductions=("planar",)),
        Setting(5, dtype="float64", mode="pyelastica", safety=0.5),
    ]
    monkeypatch.setattr(grids, "settings_of", lambda problem, elements: some)
    rows = grids.measure_grid(
        short(problem, 5),
        dataclasses.replace(exact, tips=exact.tips[:5]),
        elements=(5,),
        batches=(1, 3),
        pyelastica_elements=(5,),
        mujoco_elements=(),
        seconds=0.005,
    )
    table = list(csv.DictReader(io.StringIO(grids.as_csv(rows))))
    assert tuple(table[0]) == grids.COLUMNS
    assert {row["simulator"] for row in table} == {"jaxrod", "pyelastica"}
    assert {row["batch"] for row in table} == {"1", "3"}
    assert {row["reductions"] for row in table} == {"", "planar"}
    assert all(float(row["wall_s_per_sim_s"]) > 0 for row in table)
    # PyElastica itself and its law in jaxrod are wrong by the same.
    errors = {
        (row["simulator"], row["dt"]): float(row["error"])
        for row in table
        if row["mode"] == "pyelastica"
    }
    ((ours, dt),) = (key for key in errors if key[0] == "jaxrod")
    assert errors["pyelastica", dt] == pytest.approx(errors[ours, dt], rel=1e-6)
    assert len(errors) == 1 + len(grids.PYELASTICA_SAFETIES)


def test_the_front_holds_what_none_beats():
    points = [(1.0, 0.3), (2.0, 0.1), (2.5, 0.2), (0.5, 0.5), (4.0, 0.1)]
    rows = [grids.Row("jaxrod", Setting(5), 1, error, wall) for wall, error in points]
    front = [(row.wall_s_per_sim_s, row.error) for row in grids.pareto(rows)]
    assert front == [(0.5, 0.5), (1.0, 0.3), (2.0, 0.1)]
    assert grids.cheapest(rows, 0.2).wall_s_per_sim_s == 2.0
    assert grids.cheapest(rows, 0.01) is None


@pytest.mark.slow
def test_simulators_without_our_contact_are_left_out_with_a_word(monkeypatch):
    monkeypatch.setattr(grids, "settings_of", lambda problem, elements: [])
    said: list[str] = []
    problem = short(slam(), 2)
    assert grids.measure_grid(problem, _reference_of(problem), log=said.append) == []
    assert [line.split(":")[0] for line in said] == [
        "PyElastica is left out",
        "MuJoCo is left out",
    ]


@pytest.mark.fast_sets(2)
@pytest.mark.parametrize("name", sorted(SCENES.keys() - {"slam"}))
def test_named_problems_are_made_of_effects_pyelastica_has(name):
    problem = short(SCENES[name](), 2)
    tips = tips_of(
        problem, prepare(problem, Setting(6, None, "float64", "pyelastica", safety=0.5))
    )
    exact = dataclasses.replace(_reference_of(problem), tips=tips)
    measured = measure_pyelastica(problem, 6, exact, safety=0.5)
    assert measured.error < 1e-13


@pytest.mark.slow
def test_mujocos_cable_comes_closer_with_more_elements(swinging):
    problem, exact = swinging
    found = [measure_mujoco(problem, n, exact) for n in (5, 10, 20)]
    errors = [one.error for one in found]
    # Its first element is welded to the wall, half an element too stiff: first order.
    assert errors[0] > 1.5 * errors[1] > 2.25 * errors[2]
    assert errors[2] < 0.05
    assert found[2].setting.dt < found[0].setting.dt <= problem.period


@pytest.mark.parametrize(
    ("effect", "sentence"),
    [
        (jaxrod.end_load(force=(1.0, 0.0, 0.0)), "without EndLoad"),
        (jaxrod.exponential_damping(1.0, 2.0), "under uniform damping"),
    ],
)
def test_mujoco_is_left_out_where_its_cable_does_not_fit(swinging, effect, sentence):
    problem, exact = swinging

    def build(n_elements, mode):
        scene, state = problem.build(n_elements, mode)
        effects = (*scene.effects, effect)
        return dataclasses.replace(scene, effects=effects), state

    with pytest.raises(ValueError, match=sentence):
        measure_mujoco(dataclasses.replace(problem, build=build), 5, exact)
    with pytest.raises(ValueError, match="without controls"):
        measure_mujoco(tracking_arm(), 5, exact)


def _reference_of(problem):
    return Reference(np.zeros((2, 3)), 1.0, 0.0, 6, 1e-4)
