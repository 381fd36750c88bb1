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
from benchmarks.plectoneme.guided import BENDING, LENGTH, TORSION, guided, nearest
from benchmarks.plectoneme.guided import topology as guided_topology

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
        "tip",
        displacement=jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, -COMING, 0.0), TIME),
        axis=(0.0, 1.0, 0.0),
        angle=jaxrod.schedules.ramp(0.0, 2 * np.pi * TURNS, TIME),
        holds_element=True,
    )
    scene = jaxrod.make_scene(
        rod, jaxrod.fixed_end(state), turned, jaxrod.exponential_damping(DAMPING)
    )
    touch = jaxrod.systems.rod_contact(
        "rod", self_contact=True, stiffness=1.5e6, damping=300.0, points_per_element=2
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
        jaxrod.topology.twist(nodes, normals),
        jaxrod.topology.writhe(nodes, **far),
        jaxrod.topology.link(nodes, normals, offset=radii, **far),
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
        "turns of its end",
        max(links),
        at_most=1e-3,
    )
    record(
        f"plectoneme of {N} elements, {TURNS:g} turns: link minus twist minus writhe",
        "0, but for shear at the ends of the ribbon",
        max(balances),
        at_most=1e-4,
    )


GUIDED, WINDING, TEN = 10, 40.0, 10.0
"""Elements in each guide; the time in which the end is turned [s], by so many turns."""
BUCKLING = 8.9868
"""Couple that buckles a twisted rod whose ends are held, times length over EI [1]."""


@pytest.mark.slow
def test_link_of_ten_turns_stays_in_a_rod_that_winds_up(record):
    """Its end slides freely; the rod is straight until Greenhill's twist."""
    made = guided(
        N,
        GUIDED,
        jaxrod.schedules.ramp(0.0, 2 * np.pi * TEN, WINDING),
        stiffness=6e6,
        dashpot=4500.0,
        damping=(2.0, 12800.0),
        across=0.01,
    )
    system, now = made.system, made.state
    radii = system.members["rod"].rod.radii
    dt = float(jaxrod.stable_dt(system, 0.9).dt)
    each = int((WINDING + 2.0) / dt / 14)
    advance = jax.jit(jaxrod.advance)
    # The couple that buckles the length between the guides twists the guides too.
    critical = BUCKLING * BENDING / LENGTH * made.whole / TORSION / (2 * np.pi)
    balances, missing, straight = [], [], []
    for k in range(14):
        first = jnp.asarray(k * each)
        now = advance(system, now, dt, jnp.asarray(each), first=first)
        turned = TEN * min(1.0, (k + 1) * each * dt / WINDING)
        twist, writhe, link = map(float, guided_topology(now["rod"], radii))
        balances.append(abs(link - twist - writhe))
        missing.append(abs(link - turned))
        if turned < 0.9 * critical:
            straight.append(abs(writhe))
    assert writhe > 3 and twist > 6 and straight
    assert not jaxrod.health(system.at(WINDING + 2.0), now, dt).flagged
    name = f"rod wound up by {TEN:g} turns between guides, at 14 moments"
    record(f"{name}: link", "turns of its end", max(missing), at_most=1e-3)
    record(f"{name}: link minus twist minus writhe", "0", max(balances), at_most=1e-10)
    record(
        f"{name}: writhe below 0.9 of the twist that buckles it, {critical:.3f} turns",
        "0 (Greenhill)",
        max(straight),
        at_most=1e-4,
    )
    record(
        f"{name}: distance of the nearest axes at the end, over the diameter",
        "1 minus the indentation",
        nearest(now["rod"]),
        between=(0.9, 1.0),
    )
