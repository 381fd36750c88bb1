"""Contact inside a pipe: a rod rests in it, and is pushed out of a sheath."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import shapes

RADIUS, DENSITY, MODULUS = 0.005, 1000.0, 1e8
AREA = np.pi * RADIUS**2
WEIGHT = 9.81 * DENSITY * AREA  # per length [N/m]
BENDING = MODULUS * np.pi * RADIUS**4 / 4
SHEATH, STIFFNESS = 0.5, 2e4


def straight(n):
    return jaxrod.straight_rod(
        n,
        length=1.0,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=MODULUS,
        direction=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )


def test_a_rod_lies_in_a_pipe_at_the_depth_of_its_weight():
    rod, state = straight(10)
    way = 2e-3
    bore = shapes.pipe((-1.0, 0, way), (2.0, 0, way), RADIUS + way, thickness=0.01)
    touch = jaxrod.contact(
        bore, stiffness=STIFFNESS, damping=20.0, points_per_element=5
    )
    scene = jaxrod.make_scene(rod, jaxrod.gravity(), touch)
    end = jaxrod.advance(scene, state, 2e-5, 20_000)
    np.testing.assert_allclose(end.positions[2], -WEIGHT / STIFFNESS, rtol=1e-3)
    np.testing.assert_allclose(end.positions[1], 0.0, atol=1e-9)


def sag_outside(length):
    """Sag of the tip of a rod that reaches out of a long, soft sheath [m].

    A beam on an elastic foundation, with the shear force and the moment of the free
    part at its end.
    """
    beta = (STIFFNESS / (4 * BENDING)) ** 0.25
    shear, moment = WEIGHT * length, WEIGHT * length**2 / 2
    root = 2 * beta / STIFFNESS * (shear + beta * moment)
    slope = 2 * beta**2 / STIFFNESS * (shear + 2 * beta * moment)
    below = WEIGHT / STIFFNESS
    return below + root + slope * length + WEIGHT * length**4 / (8 * BENDING)


@pytest.mark.slow
# The end of the sheath is midway between contact points, as their lengths suppose.
@pytest.mark.parametrize("pushed", [0.153125, 0.253125])
def test_a_rod_that_is_pushed_out_of_a_sheath_sags_as_a_beam(pushed, record):
    rod, state = straight(80)
    # The bore is as wide as the rod and the onset of contact.
    bore = RADIUS * (1 + 0.5e-3)
    sheath = shapes.pipe((-1.0, 0, 0), (1.0, 0, 0), bore, thickness=0.02)
    touch = jaxrod.contact(
        sheath, stiffness=STIFFNESS, onset=1e-3, points_per_element=2
    )

    push = jaxrod.driven(
        state, displacement=(pushed, 0.0, 0.0), axes="x", free_to_turn=True
    )

    def at_rest(weight, start):
        fall = jaxrod.gravity(-9.81 * weight * jnp.array([0.0, 0.0, 1.0]))
        scene = jaxrod.make_scene(rod, fall, push, touch).at(0.0)
        return jaxrod.equilibrium(scene, start)

    rest = at_rest(1.0, state)
    assert rest.converged
    out = float(rest.state.tip[0]) - 1.0
    record(
        f"Sag of the tip of a rod pushed {pushed} m out of a sheath",
        "beam on an elastic foundation",
        abs(-float(rest.state.tip[2]) / sag_outside(out) - 1),
        at_most=0.01,
    )
    sag = jax.jit(lambda weight: at_rest(weight, rest.state).state.tip[2])
    slope, h = jax.grad(sag)(1.0), 1e-5
    difference = (sag(1 + h) - sag(1 - h)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-5)
