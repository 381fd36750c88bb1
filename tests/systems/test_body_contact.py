"""Contact of rods with bodies that move: momentum, weight, rolling."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import rod

RADIUS = 0.02


def ball(place, radius=0.05, density=500.0, **moving):
    return jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere(place, radius),
        density=density,
        dtype=jnp.float64,
        **moving,
    )


def pair(a, b, **law):
    (one, of_one), (two, of_two) = a, b
    system = jaxrod.make_system(
        {"rod": jaxrod.make_scene(one), "ball": two},
        jaxrod.systems.body_contact("rod", "ball", **{"stiffness": 1e4} | law),
    )
    return system, {"rod": of_one, "ball": of_two}


@pytest.mark.slow
def test_a_collision_keeps_momenta_and_spins_the_ball(record):
    thrown = ball((0.2, 0.01, 0.0705), velocity=(0.0, 0.3, -0.6))
    system, state = pair(rod(8, 0.4), thrown, damping=5.0, friction=0.5)
    dt = 0.5 * jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 300)
    assert after["ball"].velocities[2, 0] > -0.55
    # Friction at its lower side turns a ball that flies along y about -x.
    assert after["ball"].angular_velocities[0, 0] < -0.1
    mass = float(thrown[0].masses[0])
    for function, bar, size in (
        (jaxrod.System.momentum, 1e-14, 0.67 * mass),
        (jaxrod.System.angular_momentum, 1e-13, 0.67 * 0.2 * mass),
    ):
        change = np.linalg.norm(function(system, after) - function(system, state))
        record(
            "collision of a rod and a ball with friction and damping",
            function.__name__.replace("_", " "),
            change / size,
            at_most=bar,
        )
    assert not jaxrod.health(system, after, dt).flagged


@pytest.mark.slow
def test_loads_are_minus_the_gradient_of_the_energy():
    system, state = pair(rod(6, 0.3), ball((0.14, 0.01, 0.06)))

    @jax.jit
    def both(state):
        def energy(places):
            moved = {
                "rod": replace(state["rod"], positions=places[0]),
                "ball": replace(state["ball"], positions=places[1]),
            }
            seen, (contact,) = seen_at_rest(system, moved)
            return contact.energy(seen)

        seen, (contact,) = seen_at_rest(system, state)
        places = state["rod"].positions, state["ball"].positions
        return jax.grad(energy)(places), contact.loads(seen)

    (on_rod, on_ball), loads = both(state)
    assert np.max(np.abs(on_ball)) > 1.0
    for gradient, own in ((on_rod, loads["rod"]), (on_ball, loads["ball"])):
        np.testing.assert_allclose(
            np.stack(own.forces), -gradient, rtol=0, atol=1e-12 * np.abs(on_ball).max()
        )


@pytest.mark.slow
def test_a_ball_rolls_down_a_slope_of_rod(record):
    """A solid ball that rolls gains 5/7 of the slope's acceleration."""
    slope, radius = 0.1, 0.05
    stiff, of_stiff = rod(20, 1.0, radius=RADIUS, youngs_modulus=1e10)
    system, state = pair(
        (stiff, of_stiff),
        ball((0.2, 0.0, RADIUS + radius), radius, density=200.0),
        stiffness=1e5,
        damping=20.0,
        friction=0.8,
        friction_drag=2000.0,
        points_per_element=6,
    )
    down = (9.81 * np.sin(slope), 0.0, -9.81 * np.cos(slope))
    members = {
        "rod": jaxrod.make_scene(
            stiff, jaxrod.clamp(of_stiff), jaxrod.pin_support(of_stiff, "tip")
        ),
        "ball": replace(system.members["ball"], effects=(jaxrod.gravity(down),)),
    }
    system = jaxrod.make_system(members, *system.couplings)
    dt = jaxrod.stable_dt(system).dt
    time = 0.3
    half = jaxrod.advance(system, state, dt, int(0.5 * time / dt))
    after = jaxrod.advance(system, half, dt, int(0.5 * time / dt))
    speeds = [float(s["ball"].velocities[0, 0]) for s in (half, after)]
    gained = (speeds[1] - speeds[0]) / (int(0.5 * time / dt) * float(dt))
    record(
        "ball rolling down a rod: acceleration",
        "5/7 g sin of the slope",
        abs(gained / (5 / 7 * down[0]) - 1),
        at_most=0.01,
    )


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("rod", "none"), "no member is called 'none'"),
        (("ball", "rod"), "needs a rod and a rigid body"),
        (("rod", "point"), "has no shape"),
    ],
)
def test_bad_input(names, words):
    one, _ = rod(4, 0.3)
    round_one, _ = ball((0, 0, 1))
    point, _ = jaxrod.systems.rigid_body(mass=1.0, inertia=(1, 1, 1), dtype=jnp.float64)
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system(
            {"rod": jaxrod.make_scene(one), "ball": round_one, "point": point},
            jaxrod.systems.body_contact(*names, stiffness=1.0),
        )
