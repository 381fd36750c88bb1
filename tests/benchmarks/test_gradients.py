"""`python -m benchmarks gradients`: derivatives of a named scene, measured."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_report_is_right_and_written(tmp_path):
    out = tmp_path / "report"
    words = "slam --elements 4 --duration 0.1 --batch 4 --no-memory --out".split()
    # In a process of its own: it sets up JAX, which has long started here.
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "gradients", *words, str(out)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    text = done.stdout
    assert "slam, no contact" in text
    assert (out / "report.md").read_text() == text.removesuffix("\n")
    assert (out / "gradients.png").read_bytes().startswith(b"\x89PNG")
    with_post, without = json.loads((out / "report.json").read_text())
    for report in (with_post, without):
        assert min(report["reverse_errors"]) < 1e-6
        assert min(report["forward_errors"]) < 1e-6
        assert report["single_reverse"] < 1e-2
        assert report["gradient_ratio"] > 1
        # Large steps are far off and the smallest drown in round-off.
        assert report["reverse_errors"][0] > 10 * min(report["reverse_errors"])
        assert report["reverse_errors"][-1] > 10 * min(report["reverse_errors"])
        assert report["horizons"] == sorted(report["horizons"])
        for values in report["singular_values"]:
            assert values == sorted(values, reverse=True)
