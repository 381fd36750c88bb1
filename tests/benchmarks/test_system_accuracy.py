"""Records of the accuracy of systems, and their pictures."""

import csv

from benchmarks.system_accuracy import run
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
    run.save(tmp_path / "new", "knot", rows)
    lines = read(tmp_path / "new" / "knot.csv")
    assert tuple(lines[0]) == COLUMNS and len(lines) == len(rows)
    assert float(lines[1]["error"]) == 0.01 and lines[2]["simulator"] == "pyelastica"
    assert (tmp_path / "new" / "knot.png").read_bytes()[:4] == b"\x89PNG"


def test_the_records_hold_scenes_that_both_simulators_ran():
    for name in run.CASES:
        lines = read(run.FOLDER / f"{name}.csv")
        assert {line["simulator"] for line in lines} == {"jaxrod", "pyelastica"}
        assert (run.FOLDER / f"{name}.png").exists()
