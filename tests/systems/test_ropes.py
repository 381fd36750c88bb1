"""A rope that hangs over another, and one twisted until it buckles."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

import jaxrod
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
)
from physics.small_motions import unbalance

SPAN, THICK, G = 1.0, 0.02, 9.81
MATERIAL = {"density": 1000.0, "youngs_modulus": 1e7, "dtype": jnp.float64}
STIFFNESS = 2e4
LIFTED = 0.02
"""Height of the ends of the upper rope over those of the lower [m]."""


def hanging(n, direction, height, fall):
    """A rope whose ends are on ball joints that are lowered, in a second, by a fall."""
    direction = np.asarray(direction)
    rod, state = jaxrod.straight_rod(
        n,
        length=SPAN,
        radius=THICK,
        start=(0, 0, height) - 0.5 * SPAN * direction,
        direction=direction,
        **MATERIAL,
    )
    down = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, -fall), 0.5)
    held = [
        jaxrod.driven(state, end, displacement=down, free_to_turn=True)
        for end in ("base", "tip")
    ]
    effects = (*held, jaxrod.gravity(), jaxrod.exponential_damping(20.0))
    return jaxrod.make_scene(rod, *effects), state


def heights(n):
    """Of the middles of two ropes that cross and touch [m], and their speed [m/s]."""
    lower, of_lower = hanging(n, (1.0, 0.0, 0.0), 0.0, 0.0)
    start = 2.2 * THICK
    upper, of_upper = hanging(n, (0.0, 1.0, 0.0), start, start - LIFTED)
    state = {"lower": of_lower, "upper": of_upper}
    contact = jaxrod.systems.crossing_contact(
        "lower", "upper", stiffness=STIFFNESS, damping=5.0, onset=1e-3
    )
    system = jaxrod.make_system({"lower": lower, "upper": upper}, contact)
    dt = float(jaxrod.stable_dt(system).dt)
    after = jaxrod.advance(system, state, dt, int(2.5 / dt))
    middles = [float(after[k].positions[2, n // 2]) for k in ("lower", "upper")]
    speed = max(float(jnp.max(jnp.abs(after[k].velocities))) for k in after)
    return np.array(middles), speed


def two_elasticae(rod, touching=True):
    """Heights of both middles, by the equations of plane rods and their contact [m].

    Half of each rope: places x, z, the angle and the moment, the horizontal tension H
    and the push P between them as parameters. Stretch and shear are those of the rod.
    """
    shear, _, stretch = np.asarray(rod.shear_stretch_stiffness[:, 0])
    bending = float(rod.bend_twist_stiffness[0, 0])
    weight = float(rod.linear_density[0]) * G
    half = 0.5 * SPAN

    def slopes(s, y, numbers):
        push = numbers[2]
        rates = []
        for k, sign in ((0, -1), (4, 1)):
            angle, moment = y[k + 2], y[k + 3]
            across = numbers[k // 4]
            up = sign * 0.5 * push + weight * (s - half)
            c, d = np.cos(angle), np.sin(angle)
            along = 1 + (across * c + up * d) / stretch
            aside = (up * c - across * d) / shear
            x, z = along * c - aside * d, along * d + aside * c
            rates += [x, z, moment / bending, across * z - up * x]
        return np.stack(rates)

    def ends(start, finish, numbers):
        push = numbers[2]
        gap = 2 * THICK - push / STIFFNESS
        return np.array(
            [
                start[0],
                start[1],
                start[3],
                finish[0] - half,
                finish[2],
                start[4],
                start[5] - LIFTED,
                start[7],
                finish[4] - half,
                finish[6],
                finish[5] - finish[1] - gap if touching else push,
            ]
        )

    s = np.linspace(0, half, 200)
    guess = np.zeros((8, s.size))
    guess[0] = guess[4] = s
    guess[1], guess[5] = -0.03 * np.sin(np.pi * s), LIFTED - 0.01 * np.sin(np.pi * s)
    found = solve_bvp(
        slopes, ends, s, guess, [40.0, 40.0, 1.0], tol=1e-8, max_nodes=9999
    )
    assert found.success
    assert not touching or found.p[2] > 1.0
    return np.array([found.y[1, -1], found.y[5, -1]])


@pytest.mark.slow
def test_a_rope_that_lies_on_another_is_lifted_by_it(record):
    scene, _ = hanging(4, (1.0, 0.0, 0.0), 0.0, 0.0)
    lifted = two_elasticae(scene.rod) - two_elasticae(scene.rod, touching=False)
    assert lifted[0] < -5e-3 and lifted[1] > 5e-3
    alone = two_elasticae(scene.rod, touching=False)
    errors = {}
    for n in (20, 40):
        found, speed = heights(n)
        assert speed < 1e-6
        errors[n] = (found - alone) / lifted - 1
    for k, words in enumerate(("fall of the lower rope", "rise of the upper rope")):
        record(
            f"two ropes that cross, 40 elements: {words}",
            "two elasticae and their contact, as a boundary value problem",
            abs(errors[40][k]),
            at_most=3e-3,
        )
        assert abs(errors[40][k]) < 0.5 * abs(errors[20][k])


# A rod between a wall and one that slides.

LONG, FINE = 1.0, 0.005


def twisted(n, pull, turn, shift=0.0):
    """A rod stretched by a pull and twisted by an angle, straight; and its scene.

    Args:
        n: Elements.
        pull: On the wall that slides [N].
        turn: Of that wall [rad].
        shift: Of the middle, sideways [m].
    """
    rod, state = jaxrod.straight_rod(
        n, length=LONG, radius=FINE, direction=(1.0, 0.0, 0.0), **MATERIAL
    )
    longer = 1 + pull / rod.shear_stretch_stiffness[2, 0]
    angles = turn * (jnp.arange(n) + 0.5) / n

    def turned(state, angles):
        about = split_quaternion(state.orientations)
        turns = (jnp.cos(angles / 2), jnp.sin(angles / 2), 0 * angles, 0 * angles)
        return join_quaternion(multiply_quaternions(turns, about))

    # The wall is where an element beyond it would be by half of one.
    wall = replace(state, orientations=turned(state, jnp.full(n, turn)))
    at = replace(
        state,
        positions=state.positions * longer,
        orientations=turned(state, angles),
    )
    aside = shift * jnp.sin(jnp.pi * jnp.linspace(0, 1, n + 1)) ** 2
    at = replace(at, positions=at.positions.at[1].add(aside))
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.driven(wall, "tip", axes="yz", axis=(1.0, 0.0, 0.0)),
        jaxrod.end_load((pull, 0.0, 0.0)),
    )
    return scene, at


def lowest_stiffness(n, pull, turn):
    """Lowest eigenvalue of the tangent stiffness of what can move."""
    scene, state = twisted(n, pull, turn)
    load, stiffness = map(np.asarray, unbalance(scene.at(0.0), state))
    free = np.ones((6, n + 1), bool)
    free[:3, 0] = free[1:3, -1] = False
    free = np.concatenate([free[:3].ravel(), free[3:, :n].ravel()])
    # Straight, it is in balance.
    assert np.max(np.abs(load[free])) < 1e-9
    within = stiffness[np.ix_(free, free)]
    return np.linalg.eigvalsh(0.5 * (within + within.T))[0]


def critical_moment(pull, bending):
    """Of a rod between walls under a pull: Greenhill's, with tension [N m].

    Of w = y + i z, B w'''' - i M w''' - T w'' = 0: waves exp(i k s) of two wave numbers
    with B k^2 - M k + T = 0, of which walls let the lowest pair be.
    """

    def walls(moment):
        root = np.sqrt(moment**2 - 4 * bending * pull)
        u, v = ((moment + sign * root) / (2 * bending) * LONG / 2 for sign in (1, -1))
        pinch = lambda k: np.sin(k) - k * np.cos(k)
        return u * np.sin(u) * pinch(v) - v * np.sin(v) * pinch(u)

    least = 2 * np.sqrt(bending * pull)
    tries = least + np.linspace(0.02, 12, 2000) * bending / LONG
    values = np.array([walls(moment) for moment in tries])
    first = np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))[0]
    return brentq(walls, tries[first], tries[first + 1])


@pytest.mark.slow
@pytest.mark.parametrize("tension", [0.0, 20.0, 100.0])
def test_a_twisted_rod_between_walls_buckles_at_greenhills_moment(tension, record):
    """Tension in B / L^2; a straight rod is stable up to the critical twist."""
    rod = twisted(4, 0.0, 0.0)[0].rod
    bending, _, twisting = np.asarray(rod.bend_twist_stiffness[:, 0])
    pull = tension * bending / LONG**2
    # Waves of no tension at all are of one length only.
    moment = critical_moment(max(pull, 1e-9 * bending), bending)
    if not tension:
        assert moment * LONG / bending == pytest.approx(2 * 4.493409, rel=1e-6)
    critical = moment * LONG / twisting
    found = {}
    for n in (30, 60):
        turns = critical * np.array([0.98, 1.02])
        low = [lowest_stiffness(n, pull, turn) for turn in turns]
        assert low[0] > 0 > low[1]
        found[n] = turns[0] + (turns[1] - turns[0]) * low[0] / (low[0] - low[1])
    record(
        f"rod of 60 elements twisted under {tension:g} B / L^2, a wall slides: "
        "turn at which it buckles",
        "Greenhill, with tension",
        abs(found[60] / critical - 1),
        at_most=5e-3,
    )
    limit = (4 * found[60] - found[30]) / 3
    record(
        f"the same under {tension:g} B / L^2, extrapolated from 30 and 60 elements",
        "the same",
        # Of which up to 6e-4 are its stretch.
        abs(limit / critical - 1),
        at_most=2e-3,
    )


@pytest.mark.slow
def test_it_moves_away_above_and_swings_below(record):
    """The motion itself: squares of rates are linear in the turn, and vanish there."""
    n, pull_over = 30, 20.0
    rod = twisted(4, 0.0, 0.0)[0].rod
    bending, _, twisting = np.asarray(rod.bend_twist_stiffness[:, 0])
    pull = pull_over * bending / LONG**2
    critical = critical_moment(pull, bending) * LONG / twisting
    largest = {}
    for share in (0.97, 1.03):
        scene, state = twisted(n, pull, share * critical, shift=1e-6)
        dt = float(jaxrod.stable_dt(scene).dt)
        path = jaxrod.rollout(scene, state, dt, int(6.0 / dt) // 50 * 50, 50)
        nodes = np.asarray(path.positions)
        size = np.max(np.hypot(nodes[:, 1], nodes[:, 2]), axis=1)
        largest[share] = np.max(size)
    assert largest[0.97] < 2e-5
    assert largest[1.03] > 1e-3
