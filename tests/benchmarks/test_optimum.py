"""`optimum`: ceilings by construction, and a page of its records."""

import dataclasses
import json
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.optimum import page as optimum_page
from benchmarks.optimum import run as optimum
from jaxrod.envs import make


@lru_cache
def begun(task):
    env = make(task, variant="clean", n_elements=10)
    params = env.default_params()
    return params, env.reset(jax.random.key(0), params)[1]


def ceiling(task, place):
    params, state = begun(task)
    target = dataclasses.replace(state.target, position=jnp.asarray(place))
    return float(optimum.most(dataclasses.replace(state, target=target), params))


@pytest.mark.slow
def test_the_most_there_is():
    # Within reach: the tip is on the target, with its orientation.
    assert ceiling("tracking", (0.5, 0.5, 0.1)) == pytest.approx(2)
    assert ceiling("reaching", (0.5, 0.5, 0.1)) == pytest.approx(6)
    # The arm of the mazes begins at y = 0.5 m, and reaches 1 m from there.
    assert ceiling("structured", (-0.8, 0.5, 0.15)) == pytest.approx(2)
    # 4 cm, 8 cm and 50 cm too far.
    assert ceiling("tracking", (0, 1.04, 0.0)) == pytest.approx(2 - 0.04**2)
    assert ceiling("tracking", (0, 1.08, 0.0)) == pytest.approx(0.5 - 0.08**2)
    assert ceiling("reaching", (0, 1.08, 0.0)) == pytest.approx(1.5 - 0.08**2)
    assert ceiling("tracking", (0, 1.5, 0.0)) == pytest.approx(-(0.5**2))


@pytest.mark.slow
@pytest.mark.default_precision
def test_no_policy_earns_more_than_the_ceiling_of_its_own_episodes(monkeypatch):
    small = {"variant": "clean", "n_elements": 10, "episode_length": 32}
    monkeypatch.setattr(optimum, "make", lambda task, **_: make(task, **small))
    monkeypatch.setitem(optimum.EPISODES, "reaching", 2)
    held = optimum.HELD | {"horizon": 16, "replan": 8, "hold": 8}
    monkeypatch.setitem(optimum.PLANS, "reaching_held", held)
    record = optimum.measured("reaching_held")
    assert record["task"] == "reaching" and record["plan"] == "held"
    most = np.array(record["ceiling"])
    assert most.shape == (2,) and most.max() <= 6 * 32
    for who in ("mpc", "random"):
        assert np.all(np.array(record[who]) < most)
    assert record["period_ms"] == pytest.approx(8 * 1.4)
    assert 0 < record["plan_ms"] and 0 < record["single_plan_ms"]


def test_the_page_says_what_the_records_do(tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    records = tmp_path / "records"
    records.mkdir()
    monkeypatch.setattr(optimum_page, "ROOT", tmp_path)
    monkeypatch.setattr(optimum_page, "RECORDS", records)
    monkeypatch.setattr(optimum_page, "LEARNERS", records / "learners")
    cells = tmp_path / "benchmarks" / "clean" / "records" / "cells"
    cells.mkdir(parents=True)
    for seed, score in enumerate((600, 700)):
        cell = {
            "case": "Case2",
            "algorithm": "PPO",
            "variant": "clean",
            "evaluation_score": score,
        }
        (cells / f"{seed}.json").write_text(json.dumps(cell))
    record = {
        "task": "reaching",
        "plan": "",
        "case": 2,
        "episodes": 2,
        "settings": dict.fromkeys(optimum_page.NAMES, 4) | {"method": "mppi"},
        "period_ms": 22.4,
        "plan_ms": 5.04,
        "single_plan_ms": 11.26,
        "compile_s": 29.6,
        "ceiling": [1200, 800],
        "mpc": [1080, 520],
        "mpc_flagged": 1,
        "random": [-100, 0],
        "machine": "a machine",
    }
    (records / "reaching.json").write_text(json.dumps(record))
    held = record | {"plan": "held", "mpc": [1020, 680], "plan_ms": 0.7}
    (records / "reaching_held.json").write_text(json.dumps(held))
    optimum_page.write_pages(7)
    page = (tmp_path / "docs" / "optimum.md").read_text()
    assert (
        "| 2 `reaching` | 2 | 1,000 | 800, 1 flagged | 80.0% | 65.0% | -50 "
        "| PPO (clean) 650 (65.0%, 2 seeds) |"
    ) in page
    assert "| 2 `reaching`, held | 2 | 1,000 | 850, 1 flagged | 85.0% | 85.0% |" in page
    assert "| 2 `reaching` | 22.4 | 5.0 | 11.3 | 30 |" in page
    assert "| 2 `reaching`, held | 22.4 | 0.7 | 11.3 | 30 |" in page
    assert "| 2 `reaching` | mppi | 4 |" in page
    assert (records / "optimum.png").stat().st_size > 1000
