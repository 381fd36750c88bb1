"""Every task, randomised: each has the faults that the page names."""

import numpy as np
import pytest

from benchmarks.randomised import run
from jaxrod import envs


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "own"))
        for name in run.TASKS
    ],
)
def test_a_task_has_its_faults(name):
    """Paths and names are those of the task, or this would raise."""
    env = run.environment(name, run.randomisation(run.TASKS[name]))
    params = env.default_params()
    stiff, heavy = params.ranges.values()
    np.testing.assert_allclose(np.ravel(stiff)[[0, -1]], run.STIFFNESS)
    np.testing.assert_allclose(np.ravel(heavy)[[0, -1]], run.MASS)
    assert params.actuator["delay"][1] == run.TASKS[name].delay
    np.testing.assert_allclose(
        params.actuator["lag"][1] * env.control_period, run.LAG, rtol=1e-6
    )
    assert params.noise.shape == (env.observation_size,)


def test_all_built_in_tasks_are_there_but_the_trivial_one():
    assert set(run.TASKS) == {*envs.names(), "own"} - {"trivial"}


def test_the_gain_is_over_random_actions_on_the_same_task():
    record = {
        "random": 1.0,
        "random_randomised": 2.0,
        "plain": {"return": 11.0},
        "randomised": {"return": 7.0},
    }
    assert run.gain(record, "randomised") == 0.5
