"""The clean variants as problems: what their settings are judged by."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.clean_settings.problem import clean_problem, recorded_actions
from jaxrod.envs import make
from jaxrod.tradeoff import Setting, measure, prepare, reference
from jaxrod.tradeoff.measure import tips_of
from physics.validation import record as record
from playing import play

TASKS = pytest.mark.parametrize(
    "name", ["tracking", "reaching", "structured", "unstructured"]
)


def task_setting(task, problem, dtype):
    """The task's own elements, steps and reductions."""
    planar = () if problem.plane is None else ("planar",)
    return Setting(
        task.n_elements, task.control_period / task.substeps, dtype, reductions=planar
    )


@pytest.mark.slow
@TASKS
def test_a_problem_moves_as_its_task_does(name):
    task = make(name, variant="clean")
    actions = recorded_actions(task)[60:120]
    problem = clean_problem(task, actions)
    prepared = prepare(problem, task_setting(task, problem, "float64"))
    played = play(task, jnp.asarray(actions))[0].arm.tip
    assert np.ptp(played[:, 0]) > 1e-3
    np.testing.assert_allclose(tips_of(problem, prepared), played, rtol=0, atol=1e-9)


@pytest.mark.slow
@TASKS
def test_settings_keep_the_tip_within_one_percent(name, record):
    task = make(name, variant="clean")
    problem = clean_problem(task, recorded_actions(task))
    exact = reference(problem, 80)
    assert exact.error < 2e-3
    one = measure(problem, task_setting(task, problem, "float32"), exact, batches=())
    record(
        f"Tip of the {name} task's clean arm, 1 s of recorded actions [lengths]",
        "80 elements, an eighth of the stable step",
        one.error,
        at_most=0.01,
    )


def test_what_is_drawn_is_that_of_its_seed():
    task = make("unstructured", variant="clean")
    first, again, other = (recorded_actions(task, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)
    assert 0.29 < np.max(np.abs(first)) <= 0.3


def test_bad_input_is_refused():
    task = make("reaching", variant="clean")
    with pytest.raises(ValueError, match="clean variant"):
        clean_problem(dataclasses.replace(task, variant="paper"), np.zeros((3, 18)))
    with pytest.raises(ValueError, match=r"shape \(periods, 18\)"):
        clean_problem(task, np.zeros((3, 12)))
    with pytest.raises(ValueError, match="consistent"):
        clean_problem(task, np.zeros((3, 18))).build(10, "pyelastica")
