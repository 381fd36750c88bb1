"""`first_order`: records of runs, and a page that tells them."""

from __future__ import annotations

import json

import pytest

from benchmarks.first_order import page as first_order_page
from benchmarks.first_order import run as first_order


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_record_has_what_a_run_took_and_earned(monkeypatch):
    monkeypatch.setattr(first_order, "EPISODES", 3)
    monkeypatch.setattr(first_order, "POINTS", 2)
    make = first_order.make
    small = {"variant": "clean", "n_elements": 10, "episode_length": 64}
    monkeypatch.setattr(first_order, "make", lambda task, **_: make(task, **small))
    settings = {
        "num_envs": 2,
        "rollout_steps": 2,
        "lookahead": 8,
        "gradient_steps": 2,
        "batch_size": 4,
    }
    monkeypatch.setitem(first_order.SETTINGS["reaching"], "dagger", settings)
    record = first_order.trained("reaching", "dagger", 3, steps=200)
    # Updates of 2 x 2 x 16 control steps; four passes of 8 for each of 4 decisions.
    assert [row["control_steps"] for row in record["rows"]] == [128, 256]
    assert [row["model_steps"] for row in record["rows"]] == [256, 512]
    assert len(record["returns"]) == 3
    first, last = record["rows"]
    assert 0 < record["compile_s"] < first["wall_s"] < last["wall_s"]
    assert last["processor_s"] > first["processor_s"]


def told(task, algorithm, seed, curve):
    """A record of a run with this curve: control steps and score."""
    return {
        "task": task,
        "algorithm": algorithm,
        "seed": seed,
        "settings": {},
        "compile_processor_s": 2.0,
        "episodes": 8,
        "machine": "here",
        "rows": [
            {
                "control_steps": steps,
                "model_steps": 0.0,
                "wall_s": steps / 10,
                "processor_s": steps / 20,
                "return": score,
                "deviation": 1.0,
                "flagged": 0.0,
            }
            for steps, score in curve
        ],
    }


def test_the_page_says_who_reaches_the_baseline_and_when(tmp_path, monkeypatch):
    records = tmp_path / "first_order"
    records.mkdir()
    (tmp_path / "docs").mkdir()
    monkeypatch.setattr(first_order_page, "ROOT", tmp_path)
    monkeypatch.setattr(first_order_page, "RECORDS", records)
    runs = [
        told("reaching", "ppo", 0, [(500, 10.0), (1000, 30.0)]),
        told("reaching", "ppo", 1, [(500, 90.0), (1000, 50.0)]),
        told("reaching", "dagger", 0, [(100, 39.0), (200, 41.0), (300, 60.0)]),
        told("reaching", "dagger", 1, [(100, 20.0), (200, 30.0), (300, 39.0)]),
    ]
    for number, run in enumerate(runs):
        (records / f"{number}.json").write_text(json.dumps(run))
    first_order_page.write_pages()
    page = (tmp_path / "docs" / "first_order.md").read_text()
    assert "| 2 `reaching` | `ppo` | 2 | 40 (30 to 50) | 1,000 |" in page
    assert "| 2 `reaching` | `dagger` | 2 | 50 (39 to 60) | 300 |" in page
    # One of two gets to PPO's 40 on average: at 200 control steps of 1,000.
    assert "| `dagger` | 40 | 1 of 2 | 200 (200) | 0.20 | 10 (10) | 0.20 |" in page
    assert (records / "first_order.png").stat().st_size > 1000
