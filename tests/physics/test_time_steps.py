"""The result of `stable_dt`, wherever a time step is asked for."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import control, systems, viz
from jaxrod.control import estimation

ROD, STATE = jaxrod.straight_rod(
    4, length=0.2, radius=0.01, density=1e3, youngs_modulus=1e6
)
SCENE = jaxrod.make_scene(
    ROD, jaxrod.clamp(STATE), jaxrod.gravity(), jaxrod.exponential_damping(20.0)
)
WHOLE = jaxrod.stable_dt(SCENE)
SYSTEM = jaxrod.make_system({"arm": SCENE}, state={"arm": STATE})
OF_SYSTEM = jaxrod.stable_dt(SYSTEM)
NAMESPACES = (jaxrod, control, estimation, systems, jaxrod.tradeoff, viz)


def step_of_page(dt):
    """The step of a live page."""
    with viz.live(SCENE, STATE, dt=dt, port=None) as live:
        return live.dt


CALLS = {
    "advance": lambda dt: jaxrod.advance(SCENE, STATE, dt, 3),
    "step": lambda dt: jaxrod.step(SCENE, STATE, dt),
    "rollout": lambda dt: jaxrod.rollout(SCENE, STATE, dt, 4, every=2),
    "rollout_times": lambda dt: jaxrod.rollout_times(dt, 4, every=2),
    "health": lambda dt: jaxrod.health(SCENE, STATE, dt, energy_before=1.0),
    "scale_inertia": lambda dt: jaxrod.scale_inertia(SCENE, dt).factors,
    "linearise": lambda dt: control.linearise(SCENE, STATE, dt).state_matrix,
    "local_coordinates": lambda dt: control.local_coordinates(SCENE, STATE, dt).instant,
    "make_process": lambda dt: (
        estimation.make_process(
            SCENE, STATE, dt, 2, measure=lambda _, seen: seen.tip, noise=1e-3
        ).dt
    ),
    "reach": lambda dt: (
        control.reach(
            jaxrod.envs.actuated_arm(4, n_controls=2), (0.3, 0.8, 0.0), 0.01, dt=dt
        ).data.dt
    ),
    "settled": lambda dt: (
        systems.settled(SCENE, STATE, dt=dt, every=1, max_steps=2).state
    ),
    "live": step_of_page,
}
SLOW = ("linearise", "make_process", "reach", "scale_inertia", "settled")
"""Those that compile much."""


def equal(these, those):
    """Asserts that two pytrees have the same numbers."""
    jax.tree.map(np.testing.assert_array_equal, these, those)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in CALLS],
)
def test_whole_result_is_its_step(name):
    equal(CALLS[name](WHOLE), CALLS[name](WHOLE.dt))


def test_whole_result_of_a_system_is_its_step():
    start = {"arm": STATE}
    after = [jaxrod.step(SYSTEM, start, step) for step in (OF_SYSTEM, OF_SYSTEM.dt)]
    equal(*after)
    examined = [
        jaxrod.health(SYSTEM, start, step) for step in (OF_SYSTEM, OF_SYSTEM.dt)
    ]
    equal(*examined)


def test_no_function_with_a_step_is_missing():
    own = {
        name
        for space in NAMESPACES
        for name in space.__all__
        if inspect.isfunction(made := getattr(space, name))
        and "dt" in inspect.signature(made).parameters
    }
    assert own == set(CALLS)


def test_traced_results_are_steps_too():
    def velocity(load, step):
        scene = jaxrod.make_scene(ROD, jaxrod.clamp(STATE), jaxrod.end_load(load))
        return jaxrod.step(scene, STATE, step(jaxrod.stable_dt(scene))).velocities

    loads = jnp.array([[1.0, 0, 0], [0, 2.0, 0]])
    both = lambda load: [
        velocity(load, step) for step in (lambda whole: whole, lambda whole: whole.dt)
    ]
    equal(*jax.jit(jax.vmap(both))(loads))


def test_results_cross_the_border_of_a_compiled_function():
    inside = jax.jit(lambda step: jaxrod.rollout_times(step, 4))
    equal(inside(WHOLE), inside(WHOLE.dt))


def test_records_one_step_apart_are_shown(tmp_path):
    records = jaxrod.rollout(SCENE, STATE, WHOLE, 4)
    shown = viz.show(SCENE, records, WHOLE, tmp_path / "replay.html")
    np.testing.assert_allclose(shown.times, jaxrod.rollout_times(WHOLE, 4))


def test_results_for_a_batch_are_no_step():
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), WHOLE)
    with pytest.raises(ValueError, match=r"dt must have shape \(\), got \(2,\)"):
        jaxrod.advance(SCENE, STATE, batch, 3)
