"""Energy from nowhere is flagged; what work and rounding account for is not."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.methods.laws import IN_SPACE
from physics.worlds import HERE, WORLDS

N = 20


@pytest.fixture(params=WORLDS)
def anywhere(request):
    return WORLDS[request.param]


@pytest.fixture
def world(anywhere, dtype):
    return replace(anywhere, dtype=dtype.name)


@pytest.fixture
def single(anywhere):
    """In float32, where rounding matters."""
    return replace(anywhere, dtype="float32")


def readme_rod(direction=(1.0, 0.0, 0.0)):
    rod, state = jaxrod.straight_rod(
        N,
        length=1.0,
        radius=0.05,
        density=1000.0,
        youngs_modulus=1e7,
        direction=direction,
        dtype=jnp.float64,
    )
    return jax.tree.map(np.asarray, (rod, state))


def falling(world, rod, state, *, held, acceleration=9.81, mode="consistent"):
    """A rod under its weight, and its state."""
    rod, state = world.rod(rod), world.state(state)
    weight = jaxrod.gravity(world.vector([0.0, -acceleration, 0.0], length=1, time=-2))
    hold = jaxrod.clamp if mode == "consistent" else jaxrod.fixed_end
    effects = (hold(state), weight) if held else (weight,)
    return jaxrod.make_scene(rod, *effects, method=IN_SPACE[mode]), state


examine = jax.jit(jaxrod.health)
energy_of = jax.jit(jaxrod.Scene.total_energy)


def examined(scene, state):
    """Reports on ten states a hundred steps apart, and on all of the way."""
    dt = jaxrod.stable_dt(scene).dt
    first = energy = energy_of(scene, state)
    reports = []
    for _ in range(10):
        state = jaxrod.advance(scene, state, dt, 100)
        reports.append(examine(scene, state, dt, energy_before=energy, n_steps=100))
        energy = energy_of(scene, state)
    reports.append(examine(scene, state, dt, energy_before=first, n_steps=1000))
    return reports


def is_sound(scene, state):
    return not any(report.flagged for report in examined(scene, state))


@pytest.mark.fast_sets(1)
def test_a_held_rod_that_is_let_go_is_sound(world):
    assert is_sound(*falling(world, *readme_rod(), held=True))


def test_a_rod_in_free_fall_is_sound(single):
    assert is_sound(*falling(single, *readme_rod(), held=False))


@pytest.mark.slow
def test_a_rod_that_is_let_go_under_pyelasticas_law_is_sound(world):
    assert is_sound(*falling(world, *readme_rod(), held=True, mode="pyelastica"))


def test_a_rod_at_rest_stays_sound(single):
    rod, state = readme_rod((0.3, 0.1, 0.7))
    assert is_sound(*falling(single, rod, state, held=False, acceleration=0.0))


def test_a_bent_rod_that_flies_at_a_kilometre_per_second_is_sound(single):
    rod, state = readme_rod()
    wind = np.array([300.0, -900.0, 316.0])[:, None] + 0 * state.velocities
    wind[1] += np.cos(np.pi * np.arange(N + 1) / N)
    assert is_sound(*falling(single, rod, replace(state, velocities=wind), held=False))


def check_63_joules(world, held):
    """All nodes at 4 m/s, but for the one that is held."""
    rod, state = readme_rod()
    scene, before = falling(world, rod, state, held=held)
    wind = np.array([0.0, 4.0, 0.0])[:, None] + 0 * state.velocities
    wind[:, 0] *= not held
    after = world.state(replace(state, velocities=wind))
    dt, start = jaxrod.stable_dt(scene).dt, energy_of(scene, before)

    def report_on(state, **work):
        return examine(scene, state, dt, energy_before=start, n_steps=1000, **work)

    report = report_on(after)
    assert report.energy and report.flagged
    assert report.energy_growth / world.unit(2, 1, -2) == pytest.approx(62, rel=0.03)
    assert report.energy_allowed < report.energy_growth / 2
    assert not report_on(before).flagged
    assert not report_on(after, work_input=report.energy_growth).energy


@pytest.mark.fast_sets(1)
def test_63_joules_from_nowhere_are_flagged_in_a_held_rod(world):
    check_63_joules(world, held=True)


def test_63_joules_from_nowhere_are_flagged_in_a_free_rod(single):
    check_63_joules(single, held=False)


def test_rounding_is_what_it_is_said_to_be(record):
    """A rod at rest 1 km from the origin, in float32, shaken by rounding alone."""
    world = replace(WORLDS["1 km down"], dtype="float32")
    rod, state = readme_rod((0.3, 0.1, 0.7))
    scene, state = falling(world, rod, state, held=False, acceleration=0.0)
    report = examined(scene, state)[-1]
    record(
        "Energy that rounding gives a rod 1 km from the origin in 1000 steps, float32",
        "the allowance of the health check",
        report.energy_growth / report.energy_allowed,
        between=(0.1, 1.0),
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("n_steps", [0, -1, float("nan")])
def test_a_count_of_steps_is_positive(n_steps):
    scene, state = falling(HERE, *readme_rod(), held=False)
    with pytest.raises(ValueError, match="n_steps must be"):
        jaxrod.health(scene, state, 1e-4, n_steps=n_steps)
