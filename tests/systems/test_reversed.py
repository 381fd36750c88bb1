"""A rod in contact is the same rod described from its other end.

Friction is included but for the crossing law, whose friction belongs to one of the two
elements at a node.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry.rotations import multiply_quaternions
from systems.members import rod

PER_LENGTH = {"stiffness": 1e4, "damping": 5.0, "friction": 0.4}


def with_ball(states):
    ball, rest = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.13, 0.01, -0.03), 0.02),
        density=500.0,
        dtype=jnp.float64,
    )
    coupling = jaxrod.systems.body_contact("one", "ball", **PER_LENGTH)
    return {"ball": ball}, {"ball": rest}, coupling


def with_rod(coupling):
    def made(states):
        other, rest = rod(4, 0.4, (0.11, -0.2, 0.035), (0.1, 1, 0))
        moved = replace(rest, velocities=rest.velocities - 0.5)
        return {"two": jaxrod.make_scene(other)}, {"two": moved}, coupling

    return made


def bent_and_spinning(seed):
    """A rod whose elements turn at different rates."""
    one, state = rod(5, 0.3)
    random = np.random.default_rng(seed)
    wave = 0.004 * np.sin(np.linspace(0, 3, 6))
    return one, replace(
        state,
        positions=state.positions + jnp.asarray(np.stack([0 * wave, wave, -wave])),
        angular_momenta=jnp.asarray(2e-5 * random.normal(size=(3, 5))),
    )


def from_its_other_end(state):
    """The same rod with d2 and d3 turned round, and elements in the other order."""
    half_turn = (jnp.zeros(5), jnp.ones(5), jnp.zeros(5), jnp.zeros(5))
    turned = jnp.stack(multiply_quaternions(tuple(state.orientations), half_turn))
    return replace(
        state,
        positions=state.positions[:, ::-1],
        velocities=state.velocities[:, ::-1],
        angular_momenta=state.angular_momenta[:, ::-1],
        orientations=turned[:, ::-1],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "beside",
    [
        pytest.param(with_ball, id="body"),
        pytest.param(
            with_rod(jaxrod.systems.crossing_contact("one", "two", stiffness=1e3)),
            id="crossing",
        ),
        pytest.param(
            with_rod(
                jaxrod.systems.rod_contact(
                    "one", "two", points_per_element=3, **PER_LENGTH
                )
            ),
            id="lines",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_contact_knows_no_first_end(beside):
    one, state = bent_and_spinning(0)
    members, rest, coupling = beside(state)
    system = jaxrod.make_system({"one": jaxrod.make_scene(one), **members}, coupling)
    dt = 0.1 * jaxrod.stable_dt(system).dt
    run = jax.jit(lambda state: jaxrod.advance(system, state, dt, 30))
    plain = run({"one": state, **rest})
    turned = run({"one": from_its_other_end(state), **rest})
    back = from_its_other_end(turned["one"])
    free = jax.jit(lambda state: jaxrod.advance(system.members["one"], state, dt, 30))
    alone = free(state)
    for name in ("positions", "velocities", "angular_momenta"):
        there, other = (np.asarray(getattr(s, name)) for s in (plain["one"], back))
        size = np.max(np.abs(there))
        np.testing.assert_allclose(other, there, atol=1e-11 * size)
    pushed = np.max(np.abs(np.asarray(plain["one"].velocities - alone.velocities)))
    assert pushed > 1e-3, "nothing touched"
