"""`best_learners`: learners one after the other, and what they earn."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.best_learners import run as best_learners
from benchmarks.best_learners.page import section
from benchmarks.same_episodes.page import same_episodes


@pytest.mark.slow
@pytest.mark.default_precision
def test_the_second_learner_goes_on_from_the_first(monkeypatch):
    make = best_learners.make
    small = {"variant": "clean", "n_elements": 10, "episode_length": 64}
    monkeypatch.setattr(best_learners, "make", lambda task, **_: make(task, **small))
    monkeypatch.setitem(best_learners.EPISODES, "reaching", 3)
    sizes = {"num_envs": 2, "rollout_steps": 2, "hidden_sizes": (4,)}
    sizes |= {"minibatches": 1, "epochs": 1, "action_repeat": 16}
    # Steps too small to change anything.
    still = {"learning_rate": 1e-12, "final_learning_rate": 1e-12}
    recipe = (("ppo", 100, sizes), ("ppo", 64, sizes | still))
    monkeypatch.setitem(best_learners.RECIPES, "reaching", recipe)
    programs = {}
    record = best_learners.trained("reaching", 100, programs)
    first, second = record["stages"]
    # Updates of 2 x 2 x 16 control steps.
    assert (first["control_steps"], second["control_steps"]) == (128, 64)
    # But for the moments of four more decisions it is the same policy.
    assert second["score"] == pytest.approx(first["score"], rel=0.01)
    for stage in (first, second):
        assert 0 < stage["compile_processor_s"] < stage["processor_s"]
    assert len(record["returns"]) == len(record["ceiling"]) == 3
    assert np.all(np.array(record["returns"]) < record["ceiling"])
    # Compiled once, and counted again.
    known = dict(programs)
    again = best_learners.trained("reaching", 100, programs)
    assert programs == known
    assert again["returns"] == record["returns"]
    assert again["stages"][1]["compile_processor_s"] > known[1][1]


def test_the_section_says_what_the_records_do(tmp_path):
    def told(seed, returns):
        stage = {
            "algorithm": "dagger",
            "settings": {"effort": 2},
            "control_steps": 5000,
            "compile_processor_s": 3.0,
            "processor_s": 20.0,
            "score": 33.0,
        }
        record = {
            "task": "reaching",
            "seed": seed,
            "stages": [stage, stage | {"algorithm": "ppo", "settings": {}}],
            "episodes_seed": 2,
            "returns": returns,
            "ceiling": [100, 200, -40],
            "flagged": seed,
            "machine": "here",
        }
        (tmp_path / f"{seed}.json").write_text(json.dumps(record))

    assert section(tmp_path, {"reaching": 2}) == ""
    told(0, [90, 90, -50])
    told(1, [80, 150, -52])
    found = section(tmp_path, {"tracking": 1, "reaching": 2})
    # 130/3 and 178/3 of 260/3; the shares 0.9, 0.45, 0.8, 0.75 are those that count.
    assert (
        "| 2 `reaching` | `dagger` 5,000, then `ppo` 5,000 | 2 | 51 (43 to 59) "
        "| 59.2% | 50.0% to 68.5% | 15.6% | 45.0% | 1 of 4 | 40 |\n"
    ) in found
    assert (
        "| 2 `reaching` | 1 | 59 | 68.5% | 75.0% | 0 | 1 | 1 | 33 | 40 | 6 |" in found
    )
    assert '- `dagger` in `reaching`: {"effort": 2}' in found
    assert "| 1 `tracking`" not in found


def test_what_a_planner_earns_in_the_same_episodes(tmp_path):
    learners, same = tmp_path / "learners", tmp_path / "same"
    learners.mkdir()
    same.mkdir()
    ceiling = [100, 100, 100, -10]
    for seed, returns in enumerate(([90, 20, 40, -20], [80, 10, 60, -30])):
        record = {"returns": returns, "ceiling": ceiling}
        (learners / f"reaching-{seed}.json").write_text(json.dumps(record))
    tasks = {"tracking": 1, "reaching": 2}
    assert same_episodes(learners, same, tasks) == ""
    planned = {"hold": 8, "returns": [95, 70, 30, -15]}
    (same / "reaching.json").write_text(json.dumps(planned))
    # Lacking: 85 of the second, 50 of the third, 15 of the first, 15 of the last.
    assert (
        "| 2 `reaching` | 4 | 45 | 62.1% | 1 | 31 | 43.1% | 1 | 1 | 1 |\n"
    ) in same_episodes(learners, same, tasks)
