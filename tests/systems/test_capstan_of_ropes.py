"""A rope drawn over another: tension grows as the capstan equation says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.test_capstan import (
    CENTRELINE,
    CYLINDER,
    half_around,
    ratio_of_tensions,
    rope_law,
)


def over_a_rope(friction):
    """The other one is thick, of two elements, and all of it is held."""
    scene, state = half_around(friction)
    post, of_post = jaxrod.straight_rod(
        2,
        length=0.2,
        radius=CYLINDER,
        density=1000.0,
        youngs_modulus=1e5,
        start=(0.0, 0.0, -0.1),
        direction=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    held = (
        jaxrod.fixed_end(of_post),
        jaxrod.fixed_end(of_post, end="tip"),
        jaxrod.pin_support(of_post, 1),
    )
    members = {"rope": scene, "post": jaxrod.make_scene(post, *held)}
    # The onset is a share of the mean of both radii: as wide as at a cylinder.
    onset = 0.01 * 2 * (CENTRELINE - CYLINDER) / CENTRELINE
    law = rope_law(friction) | {"onset": onset, "max_contacts": 1}
    return (
        jaxrod.make_system(members, jaxrod.systems.rod_contact("rope", "post", **law)),
        {"rope": state, "post": of_post},
    )


@jax.jit
def drawn(system, state, dt):
    """Mean tension at the winch, and speed there, from 30 to 50 ms later."""
    steps = (jnp.asarray([0.03, 0.05]) / dt).astype(int)
    early = jaxrod.advance(system, state, dt, steps[0])
    late = jaxrod.advance(system, early, dt, steps[1] - steps[0])
    way = (late["rope"].positions - early["rope"].positions)[1, -1]
    velocity = way / ((steps[1] - steps[0]) * dt)
    return system.members["rope"].effects[0].pull(velocity), -velocity


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.1, 0.3, 0.6])
def test_tension_grows_over_another_rope_as_over_a_cylinder(friction, record):
    """Friction acts between both surfaces, within the centreline: hence R/(R+r)."""
    system, state = over_a_rope(friction)
    tension, speed = drawn(system, state, jaxrod.stable_dt(system).dt)
    expected = np.exp(friction * np.pi * CYLINDER / CENTRELINE)
    record(
        f"Ratio of tensions of a rope drawn over another, friction {friction:g}",
        "capstan equation, exp(friction angle)",
        abs(ratio_of_tensions(tension, speed) / expected - 1),
        at_most=0.02,
    )
