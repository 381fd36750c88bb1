"""`jaxrod tradeoff`: what it writes and prints, and what it refuses."""

import csv

import numpy as np
import pytest

from benchmarks.tradeoff import grid
from jaxrod import tradeoff


@pytest.fixture
def measured(monkeypatch):
    """Measurements as if from a run: jaxrod a hundred times faster, better at 20."""
    setting = tradeoff.Setting(8, 1e-3)
    theirs = tradeoff.Setting(40, 1e-4, "float64", "pyelastica")
    cable = tradeoff.Setting(40, 1e-4, "float64")

    def measure_grid(problem, exact, *, batches, **_):
        rows = [grid.Row("jaxrod", setting, b, 0.008, 1e-3) for b in batches]
        rows += [grid.Row("pyelastica", theirs, b, 0.02, 0.1) for b in batches]
        return rows + [grid.Row("mujoco", cable, b, 0.01, 0.05) for b in batches]

    def tune(workload, *, max_error, batch, log):
        log("looking")
        return tradeoff.Tuned(
            met=True,
            setting=setting,
            error=0.008,
            wall_s_per_sim_s=1e-3,
            max_error=max_error,
            batch=batch,
            reference_error=1e-5,
            tried=(),
            prepared=None,
        )

    reference = tradeoff.Reference(np.zeros((1, 3)), 1.0, 1e-5, 160, 1e-5)
    monkeypatch.setattr(grid, "measure_grid", measure_grid)
    monkeypatch.setattr(tradeoff, "tune", tune)
    monkeypatch.setattr(tradeoff, "reference", lambda workload: reference)


def test_it_writes_table_picture_and_page(measured, run_json, tmp_path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "new" / "folder"
    found = run_json("tradeoff", "swing", "--batches", 1, 64, "--json", "--out", out)
    assert found["scene"] == "swing" and found["tolerance"] == 0.01
    for one, batch in zip(found["tuned"], (1, 64), strict=True):
        assert one["batch"] == batch
        # PyElastica's best run is beside ours though it misses the tolerance.
        assert one["met"] and not one["pyelastica"]["met"]
        assert one["pyelastica"]["ratio"] == pytest.approx(100)
        assert one["mujoco"]["met"] and one["mujoco"]["ratio"] == pytest.approx(50)
    with (out / "tradeoff.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == grid.COLUMNS and len(table) == 6
    assert {row["mode"] for row in table} == {"consistent", "pyelastica", "cable"}
    page = (out / "tradeoff.md").read_text()
    assert "| 64 | n = 8" in page and "> 100 x" in page
    assert "| 64 | MuJoCo's cable | 40 |" in page and "| 50 x" in page
    assert (out / "tradeoff.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["flop"], "SCENE must be one of swing, tracking, rope, slam, got 'flop'"),
        (["swing", "--elements", "1"], "--elements must be at least 2 each"),
        (["swing", "--batches", "0"], "--batches must be at least 1 each"),
        (
            ["swing", "--pyelastica-elements", "1"],
            "--pyelastica-elements must be at least 2 each",
        ),
        (
            ["swing", "--mujoco-elements", "1"],
            "--mujoco-elements must be at least 2 each",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused_at_once(run, words, sentence):
    code, _, err = run("tradeoff", *words)
    assert code == 2
    assert sentence in err
