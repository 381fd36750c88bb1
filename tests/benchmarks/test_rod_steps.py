"""`jaxrod benchmark`: the contract of its JSON, and that wrong programs are caught."""

import dataclasses
import json

import jax
import pytest

from benchmarks.rod_steps import arms, measuring

CONTRACT = {"batch", "dtype", "mode", "rod_steps_per_s", "times_pyelastica"}


@pytest.fixture
def pyelastica(monkeypatch):
    """PyElastica at 100, 200, 300 ... steps per second."""
    rates = iter(range(100, 10_000, 100))
    monkeypatch.setattr(
        measuring, "pyelastica_steps_per_s", lambda n, seconds: float(next(rates))
    )


@pytest.fixture
def no_pyelastica(monkeypatch):
    def missing(n, seconds):
        raise ModuleNotFoundError("No module named 'elastica'", name="elastica")

    monkeypatch.setattr(measuring, "pyelastica_steps_per_s", missing)


@pytest.fixture
def instant(monkeypatch):
    """Every row is measured at 4000 rod-steps/s without measuring anything."""

    def measure(batch, dtype, mode, *, seconds, devices):
        return measuring.Row(batch, dtype, mode, 4000.0, 3000.0, 5000.0, 1, 0.5)

    monkeypatch.setattr(measuring, "measure", measure)


def test_json_keeps_the_contract_for_every_combination(
    pyelastica, instant, run_json, tmp_path
):
    found = run_json("benchmark", "--json", "--out", tmp_path / "new")
    # Before, between and after four groups: 100 to 500, median 300.
    assert found["pyelastica_measurements"] == [100.0, 200.0, 300.0, 400.0, 500.0]
    assert found["pyelastica_steps_per_s"] == 300.0
    assert all(set(row) >= CONTRACT for row in found["rows"])
    assert {row["times_pyelastica"] for row in found["rows"]} == {4000 / 300}
    assert {(row["mode"], row["dtype"], row["batch"]) for row in found["rows"]} == {
        (mode, dtype, batch)
        for mode in ("consistent", "pyelastica")
        for dtype in ("float32", "float64")
        for batch in (1, 64, 256, 1024, 4096)
    }
    assert found["machine"]["versions"]["jax"] == jax.__version__
    written = json.loads((tmp_path / "new" / "rod_steps.json").read_text())
    assert written["rows"] == found["rows"]
    assert "| float64 |" in (tmp_path / "new" / "rod_steps.md").read_text()


def test_without_pyelastica_it_says_so_and_compares_with_nothing(
    no_pyelastica, instant, run, run_json
):
    words = ["benchmark", "--batches", "1", "--dtypes", "float32"]
    found = run_json(*words, "--json")
    assert found["pyelastica_steps_per_s"] is None
    assert {row["times_pyelastica"] for row in found["rows"]} == {None}
    code, out, _ = run(*words)
    assert code == 0
    assert "PyElastica is not installed" in out
    assert "4,000" in out


@pytest.mark.parametrize("load", [0.0, 99.0])
def test_a_busy_machine_is_mentioned(load, pyelastica, instant, run, monkeypatch):
    monkeypatch.setattr("os.getloadavg", lambda: (load, load, load))
    _, out, _ = run("benchmark")
    assert ("The machine was busy" in out) == (load > 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("batch", "dtype", "mode"),
    [
        (1, "float32", "consistent"),
        pytest.param(3, "float64", "pyelastica", marks=pytest.mark.slow),
    ],
)
def test_a_row_is_measured_in_the_precision_it_names(batch, dtype, mode):
    row = measuring.measure(batch, dtype, mode, seconds=0.02)
    assert (row.batch, row.dtype, row.mode) == (batch, dtype, mode)
    assert 0 < row.slowest <= row.rod_steps_per_s <= row.fastest
    assert row.compile_s > 0


@pytest.mark.slow
def test_a_faster_program_that_is_wrong_is_caught(monkeypatch, no_pyelastica, run):
    right = arms.advance_arms

    def skips_a_step(scene, couples, states, dt, n_steps):
        return right(scene, couples, states, dt, n_steps - 1)

    monkeypatch.setattr(arms, "advance_arms", skips_a_step)
    code, out, err = run(
        "benchmark", "--batches", 2, "--dtypes", "float64", "--seconds", 0.02
    )
    assert (code, out) == (1, "")
    assert "this program computes wrong numbers" in err


@pytest.mark.parametrize("wrong", [1e-3, float("nan")])
def test_arms_that_drift_apart_are_caught(wrong):
    _, _, states = arms.arms(3, "consistent")
    measuring._check_equal(states)
    positions = states.positions.at[-1].add(wrong)
    with pytest.raises(FloatingPointError, match="positions of an arm differ"):
        measuring._check_equal(dataclasses.replace(states, positions=positions))


def test_a_batch_is_spread_evenly():
    for batch in (1, 6, 64, 100, 4096):
        for n_devices in (1, 2, 3, 8, 96):
            used = arms.even_share(batch, n_devices)
            assert 1 <= used <= n_devices
            assert batch % used == 0
    assert arms.even_share(1, 8) == 1
    assert arms.even_share(4096, 2) == 2


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--batches", "0"], "batches must be at least 1, got 0"),
        (["--dtypes", "float16"], "dtypes must be among float32, float64"),
        (["--modes", "fast"], "modes must be among consistent, pyelastica"),
        (["--seconds", "0"], "seconds must be positive and finite, got 0.0 s"),
    ],
)
def test_what_cannot_be_measured_is_one_sentence(words, sentence, run):
    code, out, err = run("benchmark", *words)
    assert (code, out) == (2, "")
    assert sentence in err
    assert err.count("\n") == 1
