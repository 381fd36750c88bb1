"""Springs towards a pose that may move: closed forms, work, gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from systems.members import rod

MASS, INERTIA = 2.0, (0.1, 0.2, 0.25)


def held(**law):
    """A body on a spring."""
    body, state = jaxrod.systems.rigid_body(
        mass=MASS, inertia=INERTIA, dtype=jnp.float64
    )
    rest = {"body": state}
    spring = jaxrod.systems.pose_spring(("body",), rest, **{"stiffness": 50.0} | law)
    return jaxrod.make_system({"body": body}, spring), rest


@pytest.mark.slow
def test_a_body_swings_about_a_place_and_an_orientation(record):
    system, rest = held(turning_stiffness=0.5)
    start = replace(
        rest["body"],
        velocities=jnp.array([[0.2], [0.0], [0.0]]),
        angular_velocities=jnp.array([[0.0], [0.0], [0.3]]),
    )
    dt = 1e-3
    after = jaxrod.advance(system, {"body": start}, dt, 1000)["body"]
    fast, turning = np.sqrt(50 / MASS), np.sqrt(0.5 / INERTIA[2])
    record(
        "body on a pose spring: place and angle after 1 s",
        "sine",
        max(
            abs(float(after.positions[0, 0]) - 0.2 / fast * np.sin(fast)),
            abs(
                2 * np.arctan2(*np.asarray(after.orientations[[3, 0], 0]))
                - 0.3 / turning * np.sin(turning)
            ),
        ),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_a_spring_that_is_moved_follows_the_driven_oscillator(record):
    """Displacement a sin(w t): the spring's end, and the dashpot's."""
    size, period, drag = 0.1, 1.5, 3.0
    way = jaxrod.schedules.sine((size, 0.0, 0.0), period)
    system, rest = held(displacement=way, damping=drag)
    w, time = 2 * np.pi / period, 20.0
    answer = (50 + 1j * w * drag) / (50 - MASS * w**2 + 1j * w * drag)
    wanted = size * np.imag(answer * np.exp(1j * w * time))
    found = [
        float(jaxrod.advance(system, rest, time / steps, steps)["body"].positions[0, 0])
        for steps in (10_000, 20_000)
    ]
    # Dashpots know the speed at the beginning of a step: they are of first order.
    errors = [abs(place - wanted) / size for place in found]
    assert 1.8 < errors[0] / errors[1] < 2.2
    record(
        "body whose spring and dashpot are moved: steady motion, extrapolated",
        "driven oscillator",
        abs(2 * found[1] - found[0] - wanted) / size,
        at_most=1e-4,
    )


@pytest.mark.slow
def test_work_of_the_drive_is_what_is_gained_and_lost(record):
    """On the end of a rod, pulled and turned along a path with dashpots."""
    body, state = rod(6, 0.5)
    rest = {"rod": state}
    drag, turning_drag = 0.5, 2e-3
    spring = jaxrod.systems.pose_spring(
        ("rod", "tip"),
        rest,
        stiffness=200.0,
        damping=drag,
        turning_stiffness=0.3,
        turning_damping=turning_drag,
        displacement=jaxrod.schedules.sine((0.05, 0.02, 0.1), 0.7),
        axis=(0.3, 1.0, 0.2),
        angle=jaxrod.schedules.sine(0.6, 0.9),
        at=(0.5, 0.01, 0.0),
    )
    system = jaxrod.make_system(
        {"rod": jaxrod.make_scene(body, jaxrod.clamp(state))}, spring
    )
    dt, steps = 1e-5, 40_000
    assert dt < jaxrod.stable_dt(system).dt
    path = jaxrod.rollout(system, rest, dt, steps, 5)
    times = jnp.asarray(jaxrod.rollout_times(dt, steps, 5))

    @jax.jit
    @jax.vmap
    def power(state, time):
        now = system.at(time)
        (reaction,) = jaxrod.systems.pose_spring_reactions(now, state)
        (own,) = now.couplings
        bare = replace(own, damping=None, turning_damping=None)
        (spring,) = jaxrod.systems.pose_spring_reactions(
            replace(now, couplings=(bare,)), state
        )
        pull = (reaction.force - spring.force) / drag
        turn = (reaction.couple - spring.couple) / turning_drag
        lost = drag * jnp.sum(pull**2) + turning_drag * jnp.sum(turn**2)
        return reaction.power, lost, now.total_energy(state)

    given, lost, energy = map(np.asarray, power(path, times))
    h = 5 * dt
    work = h * (np.sum(given[1:-1]) + 0.5 * (given[0] + given[-1]))
    heat = h * (np.sum(lost[1:-1]) + 0.5 * (lost[0] + lost[-1]))
    gained = energy[-1] - energy[0]
    size = h * np.sum(np.abs(given))
    assert min(abs(work), abs(heat), abs(gained)) > 0.01 * size
    record(
        "pose spring on a rod: work minus heat minus energy gained",
        "0 of all the work",
        abs(work - heat - gained) / size,
        at_most=1e-3,
    )


def test_the_power_of_the_drive_is_what_the_spring_of_a_body_that_is_still_gains():
    """Whether it is moved or turned."""
    system, rest = held(
        turning_stiffness=0.5,
        displacement=jaxrod.schedules.sine((0.05, 0.02, 0.1), 0.7),
        axis=(0.3, 1.0, 0.2),
        angle=jaxrod.schedules.sine(0.6, 0.9),
    )
    time, h = 0.2, 1e-4

    @jax.jit
    def energy(time):
        return system.at(time).potential_energy(rest)

    (reaction,) = jaxrod.systems.pose_spring_reactions(system.at(time), rest)
    gained = (energy(time + h) - energy(time - h)) / (2 * h)
    assert abs(float(gained)) > 0.1
    assert float(reaction.power) == pytest.approx(float(gained), rel=1e-6)
    # All of it by the angle's change, where the place does not move.
    turned, _ = held(
        turning_stiffness=0.5, axis=(0, 0, 1), angle=jaxrod.schedules.sine(0.6, 0.9)
    )
    (reaction,) = jaxrod.systems.pose_spring_reactions(turned.at(time), rest)
    phase = 2 * np.pi * time / 0.9
    rate = 0.6 * 2 * np.pi / 0.9 * np.cos(phase)
    expected = 0.5 * 0.6 * np.sin(phase) * rate
    assert float(reaction.power) == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_gradients_match_differences():
    system, rest = held(
        turning_stiffness=0.5,
        damping=1.0,
        turning_damping=0.02,
        axis=(1.0, 0.5, 0.0),
        angle=0.7,
    )

    def reach(scales):
        (own,) = system.couplings
        own = replace(
            own,
            stiffness=scales[0] * own.stiffness,
            turning_stiffness=scales[1] * own.turning_stiffness,
            damping=scales[2] * own.damping,
            place=replace(own.place, position=own.place.position + scales[3] - 1),
        )
        start = rest["body"]
        after = jaxrod.advance(
            replace(system, couplings=(own,)), {"body": start}, 1e-2, 60
        )["body"]
        return jnp.sum(after.positions) + after.angular_velocities[0, 0]

    here, h = jnp.array([1.0, 1.0, 1.0, 1.05]), 1e-5
    gradient = jax.jit(jax.grad(reach))(here)
    function = jax.jit(reach)
    differences = np.array(
        [
            (function(here.at[k].add(h)) - function(here.at[k].add(-h))) / (2 * h)
            for k in range(4)
        ]
    )
    np.testing.assert_allclose(
        gradient, differences, atol=1e-6 * np.abs(differences).max()
    )
    assert np.all(np.abs(differences) > 1e-4)


@pytest.mark.slow
def test_the_bound_is_sharp():
    system, rest = held(turning_stiffness=50.0)
    kicked = replace(
        rest["body"],
        velocities=jnp.full((3, 1), 1e-3),
        angular_velocities=jnp.full((3, 1), 1e-3),
    )
    bound = float(jaxrod.stable_dt(system, 1.0).dt)
    assert bound == pytest.approx(2 / np.sqrt(50 / 0.1), rel=1e-12)

    @jax.jit
    def size(dt):
        after = jaxrod.advance(system, {"body": kicked}, dt, 4000)["body"]
        return jnp.max(jnp.abs(after.angular_velocities))

    assert size(0.99 * bound) < 0.1
    assert not size(1.03 * bound) < 0.1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stiffness": -1.0}, "stiffness must be positive, got -1 N/m"),
        ({"angle": 0.3}, "axis must be given with angle"),
        ({"axis": (0, 0, 1), "angle": 0.3}, "turning_stiffness .* is needed"),
        ({"turning_stiffness": 0.0}, "turning_stiffness must be positive, got 0 N m"),
        ({"position": (0, 0)}, r"position must have shape \(3,\)"),
        (
            {"orientation": (0, 0, 0, 0), "turning_stiffness": 1.0},
            "orientation must not be zero",
        ),
        (
            {"displacement": jaxrod.schedules.sine(1.0, 2.0)},
            r"displacement must have values of shape \(3,\)",
        ),
    ],
)
def test_bad_input(options, words):
    with pytest.raises(ValueError, match=words):
        held(**options)
