"""Extreme actions in free space: nothing non-finite, no energy from nowhere."""

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from benchmarks.extremes.actions import CONTROL_POINTS, DT, N_ELEMENTS, run, turned
from jaxrod.envs.arm.soft_arm import TORQUE_PER_ELEMENT
from physics.rods import arm


def check(result, record):
    name = f"{result['episodes']:,} episodes of {result['seconds']:g} s"
    record(
        f"Extreme actions, {name}: states that are not finite",
        "none",
        result["flags"]["not_finite"] + result["states_not_finite_after_freezing"],
        at_most=0,
    )
    record(
        f"Extreme actions, {name}: fraction flagged",
        "none",
        result["episodes_flagged"] / result["episodes"],
        at_most=1e-3,
    )
    record(
        f"Extreme actions, {name}: energy in excess of the work done, relative",
        "work of the couples",
        result["energy_beyond_work"],
        at_most=0.01,
    )


@pytest.mark.slow
@pytest.mark.default_precision
def test_extreme_actions_on_the_benchmarks_arm(record):
    check(run(48, 0.14, batch=48), record)


@pytest.mark.slow
@pytest.mark.default_precision
def test_extreme_actions_for_whole_episodes(record):
    check(run(192, 5.0), record)


@jax.jit
def energy_and_work(scene, state, couples, dt):
    """After every step of an undamped arm under held couples [J]."""

    def one(carry, _):
        before, work = carry
        after = jaxrod.step(scene, before, dt)
        work = work + jnp.sum(couples * turned(before, after))
        return (after, work), (scene.total_energy(after), work)

    return jax.lax.scan(one, (state, jnp.zeros(())), length=1500)[1]


def test_without_damping_the_energy_is_the_work_of_the_couples(record):
    """The published strength, held: the arm curls up in 0.15 s."""
    rod, state = arm(N_ELEMENTS)
    values = jaxrod.actuation.control_spline(CONTROL_POINTS)(
        jnp.asarray([[1.0, 1.0], [1.0, -1.0], [0.0, 0.0]]), rod.arc_length_midpoints
    )
    couples = TORQUE_PER_ELEMENT * values
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), jaxrod.actuation.ElementCouples(couples)
    )
    energy, work = energy_and_work(scene, state, couples, DT)
    record(
        "Energy of an undamped arm under strong constant couples, in excess of their "
        "work",
        "work of the couples, largest",
        jnp.max(jnp.abs(energy - work)) / jnp.max(work),
        at_most=0.05,
    )
