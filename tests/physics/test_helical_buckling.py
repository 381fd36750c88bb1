"""A long rod twisted by its ends, which come together: buckling that localises.

Gazzola et al., R. Soc. Open Sci. 5 (2018) 171628, section 3.4.1: 27 turns and a slack
of 3 % of the length, with bending and twisting stiffness of 1.345 and 0.789. Of a rod
that is long and does not stretch the angle to its line is (van der Heijden and
Thompson, Nonlinear Dynamics 21 (2000) 71), with moment and tension over B / L and
B / L^2,

    (cos a - cos a0) / (1 - cos a0) = tanh^2(sqrt(T - M^2 / 4) s / L),
    cos a0 = M^2 / 2 T - 1,

where slack and turns say what M and T are.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import fsolve

import jaxrod

N, RADIUS, YOUNG, DENSITY = 100, 4e-4, 1e9, 1000.0
TURNS, SLACK, SOFTER = 27.0, 0.03, 0.789 / 1.345
BENDING = YOUNG * np.pi * RADIUS**4 / 4
TIME = np.sqrt(DENSITY * np.pi * RADIUS**2 / BENDING)
"""In which a bending wave of the rod's length passes [s]; the rod is 1 m long."""


def loads_of_the_long_rod():
    """Moment over B / L and tension over B / L^2."""

    def misses(loads):
        moment, tension = loads
        rate = np.sqrt(tension - moment**2 / 4)
        deep = 1 - (moment**2 / (2 * tension) - 1)
        turned = moment / SOFTER + 4 * np.arccos(moment / (2 * np.sqrt(tension)))
        return (
            2 * deep * np.tanh(rate / 2) / rate - SLACK,
            turned / (2 * np.pi * TURNS) - 1,
        )

    return fsolve(misses, (98.0, 2900.0), xtol=1e-12)


def test_moment_and_tension_are_the_published_ones():
    np.testing.assert_allclose(loads_of_the_long_rod(), (98.5415, 2900.993), rtol=1e-5)


def envelope(positions):
    """What the tanh above is of elements, and the largest angle [rad]."""
    edges = np.diff(positions, axis=1)
    cosine = edges[2] / np.linalg.norm(edges, axis=0)
    least = np.min(cosine)
    return (cosine - least) / (1 - least), np.arccos(least)


def buckled():
    """The scene with its ends where they come to, and a state that has come to rest."""
    rod, state = jaxrod.straight_rod(
        N,
        length=1.0,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG * SOFTER / 2,
        dtype=jnp.float64,
    )
    # So that the rod buckles in its middle.
    s = np.linspace(0, 1, N + 1)
    bump = 1e-4 * np.exp(-((s - 0.5) ** 2) / 0.005) * 4 * s * (1 - s)
    state = replace(state, positions=state.positions.at[0].add(bump))
    walls = [
        jaxrod.driven(
            state,
            end,
            displacement=jaxrod.schedules.ramp(
                (0, 0, 0), (0, 0, way * SLACK / 2), TIME
            ),
            axis=(0, 0, 1),
            angle=jaxrod.schedules.ramp(0.0, way * np.pi * TURNS, TIME),
        )
        for end, way in (("base", 1), ("tip", -1))
    ]
    scene = jaxrod.make_scene(rod, *walls, jaxrod.exponential_damping(10 / TIME))
    # Where it comes to rest does not depend on inertia.
    scene = jaxrod.scale_inertia(scene).scene
    dt = float(jaxrod.stable_dt(scene, 0.9).dt)
    after = jaxrod.advance(scene, state, dt, jnp.asarray(int(1.4 * TIME / dt)))
    return scene.at(2 * TIME), after


@pytest.mark.slow
def test_a_twisted_rod_buckles_where_it_is_kicked(record):
    scene, state = buckled()
    rest = jaxrod.equilibrium(scene, state)
    assert rest.converged and rest.stable
    moved = np.max(np.abs(rest.state.positions - state.positions))
    assert moved < 1e-3, "the dynamics has not come to rest there"
    moment, tension = loads_of_the_long_rod()
    found, angle = envelope(np.asarray(rest.state.positions))
    s = (np.arange(N) + 0.5) / N - 0.5
    expected = np.tanh(np.sqrt(tension - moment**2 / 4) * s) ** 2
    record(
        f"helical buckling, {N} elements: envelope, root mean square",
        "the localised solution of a long rod",
        np.sqrt(np.mean((found - expected) ** 2)),
        at_most=0.02,
    )
    deepest = np.arccos(moment**2 / (2 * tension) - 1)
    pull = jaxrod.reactions(scene, rest.state)[1]
    for name, one, other, bar in (
        ("largest angle to the line", angle, deepest, 0.05),
        ("moment of the ends", abs(pull.couple[2]), moment * BENDING, 0.01),
        ("tension", pull.force[2], tension * BENDING, 0.05),
    ):
        record(
            f"helical buckling, {N} elements: {name}",
            "the same",
            abs(float(one) / other - 1),
            at_most=bar,
        )
