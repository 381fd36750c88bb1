"""Learners on a bad arm: each has the faults that its name says."""

import pytest

from benchmarks.reality import run


@pytest.mark.parametrize(
    ("name", "faults"),
    [
        ("ideal", set()),
        ("recurrent-privileged", {"delay", "dropout", "flags", "noise", "parameters"}),
        ("mlp-delay", {"delay"}),
        ("mlp-stiffness", {"parameters"}),
        ("imitator-delay", {"delay", "past_actions"}),
    ],
)
def test_a_learner_has_the_faults_of_its_name(name, faults):
    randomisation = getattr(run.task(name), "randomisation", None)
    found = {} if randomisation is None else randomisation.record()
    assert set(found) == faults
    assert found.get("delay", [14, 14]) == [14, 14]  # 20 ms of 1.4 ms each
