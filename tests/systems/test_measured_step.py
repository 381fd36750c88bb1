"""The step of a system measured at a state: contact that touches there, all methods.

`test_stability_bounds` compares it with the limit of the linearised step, for every
coupling.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from systems.members import SOFT, rod

RADIUS = SOFT["radius"]


def pair(gap, stiffness=1e8, method=jaxrod.consistent()):
    """Two rods on top of each other, with a gap between their surfaces [m]."""
    scenes, state = {}, {}
    for name, height in (("lower", 0.0), ("upper", 2 * RADIUS + gap)):
        one, state[name] = rod(3, 0.3, (0.0, 0.0, height))
        scenes[name] = jaxrod.make_scene(one, method=method)
    contact = jaxrod.systems.rod_contact(*scenes, stiffness=stiffness)
    return jaxrod.make_system(scenes, contact, state=state), state


def test_contact_counts_where_it_touches(record):
    """Rods that do not touch have the step of free rods, and less where they do."""
    system, apart = pair(0.1 * RADIUS)
    _, touching = pair(-0.1 * RADIUS)
    bound = jaxrod.stable_dt(system, 1.0).dt
    free, pressed = (
        jaxrod.stable_dt(system, 1.0, state=state) for state in (apart, touching)
    )
    alone = jaxrod.stable_dt(system.members["lower"], 1.0).dt
    record(
        "Step of two rods that do not touch, measured, over the bound of one of them",
        "above 1, and not far",
        float(free.dt / alone),
        between=(1.0, 1.1),
    )
    assert bound <= pressed.dt < 0.5 * free.dt
    assert "'lower'" in pressed.limiting_mode or "'upper'" in pressed.limiting_mode
    moving = jax.tree.map(lambda leaf: leaf, touching)
    moving["upper"] = replace(
        moving["upper"], velocities=moving["upper"].velocities + 3.0
    )
    assert jaxrod.stable_dt(system, 1.0, state=moving).dt == pressed.dt


def test_the_step_is_measured_for_explicit_members_at_one_moment():
    system, state = pair(0.0, method=jaxrod.implicit(0.8))
    with pytest.raises(ValueError, match="'lower' has implicit steps"):
        jaxrod.stable_dt(system, state=state)
    scene, one = rod()
    pull = jaxrod.schedules.ramp(jnp.zeros(3), jnp.ones(3), 1.0)
    driven = jaxrod.make_system(
        {"arm": jaxrod.make_scene(scene, jaxrod.end_load(pull))}
    )
    with pytest.raises(ValueError, match=r"give system.at\(time\)"):
        jaxrod.stable_dt(driven, state={"arm": one})
    assert jaxrod.stable_dt(driven.at(0.5)).dt > 0
    with pytest.raises(ValueError, match="members"):
        jaxrod.stable_dt(driven.at(0.5), state={})


METHODS = {
    "consistent": jaxrod.consistent(),
    "pyelastica": jaxrod.pyelastica(),
    "planar": jaxrod.planar("zx"),
    "torsion_free": jaxrod.torsion_free(),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_member_alone_has_the_step_of_its_scene(method, record):
    """A clamped rod with drag, compressed and bent: by loads alone, and by steps."""
    one, state = rod(6, 0.5)
    bent = state.positions * jnp.asarray([[0.9], [1.0], [1.0]])
    state = replace(state, positions=bent.at[2].add(bent[0] ** 2))
    scene = jaxrod.make_scene(
        one,
        jaxrod.clamp(state),
        jaxrod.exponential_damping(3.0),
        method=METHODS[method],
    )
    alone = jaxrod.stable_dt(scene, 1.0, state=state)
    system = jaxrod.make_system({"arm": scene})
    measured = jaxrod.stable_dt(system, 1.0, state={"arm": state})
    # Of a scene in a plane motions out of the plane are measured too.
    record(
        f"Step of a bent rod of `{method}` as a member, over that of its scene",
        "1",
        float(measured.dt / alone.dt),
        between=(0.99, 1.03 if method == "planar" else 1.01),
    )
    own = measured.steps[0]
    assert own.angular_frequency == pytest.approx(float(alone.angular_frequency), 3e-2)


@pytest.mark.slow
def test_equal_rods_and_batches_have_the_step_of_the_worst():
    def made(squeezed):
        one, state = rod(4, 0.4)
        state = replace(state, positions=squeezed * state.positions)
        return jaxrod.make_scene(one, method=jaxrod.pyelastica()), state

    squeezed = jnp.asarray([1.0, 0.5, 0.8])
    scenes, states = jax.vmap(made)(squeezed)
    together = jaxrod.stable_dt(
        jaxrod.make_system({"rods": scenes}), state={"rods": states}
    )
    assert "of rod 1 of 'rods'" in together.limiting_mode
    member, _ = made(1.0)
    system = jaxrod.make_system({"rods": member})
    each = jax.vmap(lambda own: jaxrod.stable_dt(system, state={"rods": own}).dt)(
        states
    )
    assert np.argmin(each) == 1
    assert together.dt == pytest.approx(float(each[1]), rel=2e-3)


@pytest.mark.slow
def test_the_measured_step_has_a_gradient(record):
    system, state = pair(-0.1 * RADIUS)

    def step(stiffness):
        contact = replace(system.couplings[0], stiffness=stiffness)
        now = replace(system, couplings=(contact,))
        return jaxrod.stable_dt(now, 1.0, state=state).dt

    at, change = system.couplings[0].stiffness, 1e7
    slope = float(jax.grad(step)(at))
    # Apart by more than the tolerance of the search.
    difference = float(step(at + change) - step(at - change)) / (2 * change)
    record(
        "Gradient of the measured step by the stiffness of contact, over differences",
        "1",
        slope / difference,
        between=(0.97, 1.03),
    )
