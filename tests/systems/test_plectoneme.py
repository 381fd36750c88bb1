"""A rod that is twisted while its ends come together, until it winds around itself.

Link is what the ends are turned by, whatever the rod does, unless it passes through
itself or slips over an end, where nothing is in its way: that takes two turns.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

N, RADIUS, YOUNG = 50, 0.025, 1e6
TURNS, COMING, TIME, DAMPING = 4.5, 0.225, 9.0, 5.0
"""At the end: of the last element, and by how much it has come nearer [m]; when [s]."""
EXTENSION = 10.0


def wound_up():
    """The system and its initial state, bent a little, so that it knows where to go."""
    rod, state = jaxrod.straight_rod(
        N,
        length=1.0,
        radius=RADIUS,
        density=1 / (np.pi * RADIUS**2),
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 1.5,
        direction=(0.0, 1.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    turned = jaxrod.driven(
        state,
        "finish",
        displacement=jaxrod.ramp((0.0, 0.0, 0.0), (0.0, -COMING, 0.0), TIME),
        axis=(0.0, 1.0, 0.0),
        angle=jaxrod.ramp(0.0, 2 * np.pi * TURNS, TIME),
        holds_element=True,
    )
    scene = jaxrod.make_scene(
        rod, jaxrod.fixed_end(state), turned, jaxrod.exponential_damping(DAMPING)
    )
    touch = jaxrod.rod_contact(
        "rod", itself=True, stiffness=1.5e6, damping=300.0, points_per_element=2
    )
    s = np.linspace(0, 1, N + 1)
    bent = state.positions.at[2].add(-1e-3 * np.sin(np.pi * s) ** 2)
    return jaxrod.make_system({"rod": scene}, touch), replace(state, positions=bent)


@jax.jit
def topology(state, radii):
    """Twist, writhe and link."""
    nodes, normals = state.positions, state.directors[0]
    far = {"ends": "next_tangent", "extension": EXTENSION}
    return (
        jaxrod.twist(nodes, normals),
        jaxrod.writhe(nodes, **far),
        jaxrod.link(nodes, normals, offset=radii, **far),
    )


@pytest.mark.slow
def test_link_of_a_plectoneme_is_what_its_end_is_turned_by(record):
    system, state = wound_up()
    radii = system.members["rod"].rod.radii
    dt = float(jaxrod.stable_dt(system, 0.9).dt)
    each = int(TIME / dt / 6)
    now, balances, links = {"rod": state}, [], []
    for k in range(6):
        before = now["rod"]
        now = jaxrod.advance(system, now, dt, jnp.asarray(each), first=k * each)
        twist, writhe, link = map(float, topology(now["rod"], radii))
        balances.append(abs(link - twist - writhe))
        links.append(abs(link - TURNS * (k + 1) * each * dt / TIME))
        assert not np.array_equal(before.positions, now["rod"].positions)
    assert writhe > 0.8
    # It touches itself: without contact no node would be pushed.
    seen = jaxrod.health(system.at(TIME), now, dt)
    assert not seen.flagged
    record(
        f"plectoneme of {N} elements, {TURNS:g} turns: link, at six moments",
        "what its end is turned by",
        max(links),
        at_most=1e-3,
    )
    record(
        f"plectoneme of {N} elements, {TURNS:g} turns: link less twist and writhe",
        "0, but for shear at the ends of the ribbon",
        max(balances),
        at_most=1e-4,
    )
