"""Records of the accuracy of systems, and their pictures."""

import csv

import numpy as np
import pytest

from benchmarks.system_accuracy import knot, run
from benchmarks.system_accuracy.contact_scenes import (
    apart,
    our_points,
    points_of,
    their_points,
)
from benchmarks.system_accuracy.ropes import LENGTH, graded
from benchmarks.tradeoff.grid import COLUMNS, Row
from jaxrod import tradeoff


def read(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_every_setting_of_a_scene_is_in_the_record_and_the_picture(tmp_path):
    rows = [
        Row("jaxrod", tradeoff.Setting(n, 1e-4, dtype="float64"), 1, 1 / n**2, 0.01 * n)
        for n in (5, 10)
    ]
    theirs = tradeoff.Setting(10, 1e-4, dtype="float64", mode="pyelastica")
    rows.append(Row("pyelastica", theirs, 1, 0.01, 2.0))
    run.save(tmp_path / "new", "joint", rows)
    lines = read(tmp_path / "new" / "joint.csv")
    assert tuple(lines[0]) == COLUMNS and len(lines) == len(rows)
    assert float(lines[1]["error"]) == 0.01 and lines[2]["simulator"] == "pyelastica"
    assert (tmp_path / "new" / "joint.png").read_bytes()[:4] == b"\x89PNG"


def test_the_record_of_a_scene_in_contact_has_its_stiffness(tmp_path):
    settings = [
        tradeoff.Setting(8, 1e-4, dtype="float64", contact=contact)
        for contact in (0.25, 1.0)
    ]
    rows = [Row("jaxrod", setting, 1, 0.01, 2.0) for setting in settings]
    run.save(tmp_path, "knot", rows, 1e-4)
    lines = read(tmp_path / "knot.csv")
    assert tuple(lines[0]) == (*COLUMNS, "contact")
    assert [float(line["contact"]) for line in lines] == [0.25, 1.0]


def test_the_records_hold_scenes_that_both_simulators_ran():
    for name in (*run.CASES, *run.CONTACT):
        lines = read(run.FOLDER / f"{name}.csv")
        assert {line["simulator"] for line in lines} == {"jaxrod", "pyelastica"}
        assert (run.FOLDER / f"{name}.png").exists()


@pytest.mark.parametrize("name", run.CONTACT)
def test_records_of_contact_have_errors_that_fall_with_the_number_of_elements(name):
    least = {}
    for line in read(run.FOLDER / f"{name}.csv"):
        key = line["simulator"], int(line["n_elements"])
        least[key] = min(least.get(key, 1.0), float(line["error"]))
    for simulator in ("jaxrod", "pyelastica"):
        sizes = sorted(n for who, n in least if who == simulator)
        assert least[simulator, sizes[-1]] < 0.5 * least[simulator, sizes[0]]


def test_points_of_a_scene_are_those_that_all_numbers_of_elements_have():
    lines = [np.stack([np.linspace(0, 1, n + 1)] * 3) for n in (4, 8, 12)]
    body = np.full((3, 1), 7.0)
    coarse, fine, finer = (points_of([line, body], 4) for line in lines)
    assert coarse.shape == (3, 6) and np.all(coarse[:, -1] == 7)
    np.testing.assert_allclose(coarse, fine)
    np.testing.assert_allclose(coarse, finer)
    assert apart(fine + np.asarray([[0], [3], [4]]), finer, 10.0) == pytest.approx(0.5)


@pytest.mark.parametrize("n", [32, 64])
def test_the_loose_knot_is_unstretched_and_hardly_touches_itself(n):
    nodes = knot.loose(n)
    lengths = np.linalg.norm(np.diff(nodes), axis=0)
    np.testing.assert_allclose(lengths, knot.LENGTH / n, rtol=2e-3)
    assert np.sum(lengths) == pytest.approx(knot.LENGTH, rel=1e-6)
    s = np.linspace(0, knot.LENGTH, n + 1)
    far = np.abs(s[:, None] - s) > 4 * np.pi * knot.RADIUS
    distance = np.linalg.norm(nodes[:, :, None] - nodes[:, None], axis=0)
    assert np.min(distance[far]) > 1.99 * knot.RADIUS


def test_graded_elements_are_shortest_in_the_middle_and_make_up_the_rope():
    for n in (8, 9):
        lengths = np.diff(graded(n, 4.0))
        assert np.sum(lengths) == pytest.approx(LENGTH)
        np.testing.assert_allclose(lengths, lengths[::-1])
        assert lengths[0] / np.min(lengths) == pytest.approx(4.0)
        assert np.argmin(lengths) in (n // 2, (n - 1) // 2)
    np.testing.assert_allclose(np.diff(graded(5, 1.0)), LENGTH / 5)


# Elements, and the bounds of errors in lengths: of ours with half as many, and of
# PyElastica with half as many and with all.
COARSE = {
    "gripper": (32, 4e-3, 5e-2, 2.5e-2),
    "knot": (128, 1.5e-3, 2e-3, 6e-4),
    "nest": (16, 2.5e-3, 1.5e-2, 1e-2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COARSE)
def test_both_libraries_converge_to_one_end_of_a_scene_in_contact(name):
    n, ours, theirs, theirs_finer = COARSE[name]
    scene = run.CONTACT[name]
    exact = our_points(scene, scene.build(n))[0]
    coarse = scene.build(n // 2)
    assert apart(our_points(scene, coarse)[0], exact, scene.length) < ours
    far = apart(their_points(scene, coarse)[0], exact, scene.length)
    near = apart(their_points(scene, scene.build(n))[0], exact, scene.length)
    assert near < far < theirs and near < theirs_finer


@pytest.mark.slow
def test_contact_decides_where_the_fingers_of_the_gripper_end():
    scene = run.CONTACT["gripper"]
    ends = [our_points(scene, scene.build(8, k))[0] for k in (1.0, 1e-6)]
    assert apart(*ends, scene.length) > 0.05
