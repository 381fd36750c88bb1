"""Control steps behind Gymnasium: what a line says, and what cannot be measured."""

import sys

import pytest

from benchmarks.gymnasium_steps import bursts
from benchmarks.gymnasium_steps import run as gymnasium_steps


def test_rod_steps_and_motion_follow_from_control_steps():
    measured = {"speeds": [100.0, 300.0, 200.0], "busy": 0.24}
    known = {"steps": 5, "elements": 30, "seconds": 0.01}
    words = gymnasium_steps.line("arm", {**measured, **known})
    assert words == (
        "arm: best 300, median 200 control steps/s, 250 in a second of processor time; "
        "of 5 steps of 30 elements: 1,250 rod-steps in it, 2.50 s of motion"
    )
    unknown = {"steps": None, "elements": None, "seconds": None}
    words = gymnasium_steps.line("arm", {**measured, **unknown})
    assert words.endswith("200 control steps/s, 250 in a second of processor time")


def test_the_arm_says_what_its_control_step_is():
    pytest.importorskip("gymnasium")
    from jaxrod.envs.gym import GymnasiumEnv

    env = GymnasiumEnv("tracking", variant="clean", substeps=5, n_elements=10)
    said = bursts._content(env)
    assert said == {"elements": 10, "steps": 5, "seconds": pytest.approx(1.4e-3)}


def test_a_python_that_cannot_measure_is_named_with_its_reason(tmp_path):
    with pytest.raises(ValueError, match=r"--softrobot .*nowhere: No such file"):
        gymnasium_steps.in_other_python(str(tmp_path / "nowhere"), 0.1)
    bare = tmp_path / "bare"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -S -E "$@"\n')
    bare.chmod(0o755)
    with pytest.raises(ValueError, match=r"could not measure SoftArm.*ModuleNotFound"):
        gymnasium_steps.in_other_python(str(bare), 0.1)
