"""Collisions of rigid bodies: what they keep, and what forces come from."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry.rotations import (
    directors,
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    split_quaternion,
    to_world,
)
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.rigid_pairs import SHAPES, alone, body, moved, pair, thrown


def changes(system, before, after):
    return [
        float(np.linalg.norm(function(system, after) - function(system, before)))
        for function in (jaxrod.System.momentum, jaxrod.System.angular_momentum)
    ]


def test_equal_balls_exchange_their_velocities(record):
    system, state = pair(
        body(SHAPES["sphere"](), position=(0, 0, 0)),
        body(SHAPES["sphere"](), position=(0.21, 0, 0), velocity=(-1.0, 0, 0)),
    )
    dt = 0.02 * float(jaxrod.stable_dt(system).dt)
    after = jaxrod.advance(system, state, dt, int(0.06 / dt))
    left = abs(float(after["b"].velocities[0, 0]))
    record(
        "head-on collision of equal balls", "all momentum passes on", left, at_most=1e-4
    )
    assert after["a"].velocities[0, 0] == pytest.approx(-1, abs=1e-4)


@pytest.mark.slow
def test_a_ball_that_strikes_at_an_angle_is_slowed_by_friction(record):
    """It slips all along: along the wall it loses mu times what it gets across."""
    friction = 0.1
    system, state = alone(
        jaxrod.shapes.sphere((0, 0, 0.101), 0.1),
        stiffness=1e6,
        damping=None,
        friction=friction,
        friction_drag=1e4,
    )
    mass = float(system.members["body"].masses[0])
    bare = replace(system.members["body"], effects=())
    system = jaxrod.make_system({"body": bare}, *system.couplings)
    state = moved(state, velocities=jnp.array([[3.0], [0.0], [-1.0]]))
    dt = 0.03 * float(jaxrod.stable_dt(system).dt)
    after = jaxrod.advance(system, state, dt, int(0.01 / dt))["body"]
    across = float(after.velocities[2, 0]) + 1
    along = 3 - float(after.velocities[0, 0])
    assert across == pytest.approx(2, rel=1e-3)
    record(
        "oblique collision: impulse along the wall",
        "friction times the impulse across it",
        abs(along / (friction * across) - 1),
        at_most=5e-3,
    )
    turned = 0.4 * mass * 0.1**2 * float(after.angular_velocities[1, 0])
    assert turned == pytest.approx(mass * 0.1 * along, rel=1e-2)


PAIRS = list(itertools.combinations_with_replacement(SHAPES, 2))


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_collisions_keep_momenta_and_make_no_energy(first, second, record):
    system, state = pair(*thrown(first, second), damping=20.0, friction=0.5)
    dt = 1e-4
    assert dt < jaxrod.stable_dt(system).dt
    path = jaxrod.rollout(system, state, dt, 1500, 50)
    energies = np.asarray(jax.vmap(lambda s: system.total_energy(s))(path))
    started = float(system.total_energy(state))
    assert np.max(np.diff(np.append(started, energies))) < 1e-4 * started
    assert energies[-1] < 0.95 * started
    after = jax.tree.map(lambda leaf: leaf[-1], path)
    mass = float(system.members["b"].masses[0])
    for change, bar, name in zip(
        changes(system, state, after),
        (1e-14, 1e-13),
        ("momentum", "angular momentum"),
        strict=True,
    ):
        size = 2.0 * mass * (1 if name == "momentum" else 0.2)
        record(
            f"collision of {first} and {second}, friction and damping: {name}",
            "as before",
            change / size,
            at_most=bar,
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second"),
    [("sphere", "box"), ("capsule", "cylinder"), ("cylinder", "box"), ("box", "box")],
)
def test_loads_are_minus_the_gradient_of_the_energy(first, second):
    system, state = pair(*thrown(first, second))
    near = state["b"].positions - jnp.array([[0.06], [0.0], [0.0]])
    state = {**state, "b": replace(state["b"], positions=near)}

    def energy(way, turn):
        own = state["a"]
        turned = multiply_quaternions(
            rotation_exp((turn[0], turn[1], turn[2])),
            split_quaternion(own.orientations),
        )
        own = replace(
            own,
            positions=own.positions + way,
            orientations=join_quaternion(turned),
        )
        seen, (contact,) = seen_at_rest(system, {**state, "a": own})
        return contact.energy(seen)

    none = jnp.zeros((3, 1))
    force, couple = jax.jit(jax.grad(energy, (0, 1)))(none, none)
    seen, (contact,) = seen_at_rest(system, state)
    loads = contact.loads(seen)["a"]
    own = np.stack(to_world(directors(seen["a"].motion.orientation), loads.couples))
    size = np.abs(force).max()
    assert size > 10
    np.testing.assert_allclose(np.stack(loads.forces), -force, atol=1e-12 * size)
    np.testing.assert_allclose(own, -couple, atol=1e-13 * size)
