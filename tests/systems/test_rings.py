"""Closed rods against closed forms of rings."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxrod
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    split_quaternion,
)
from jaxrod.systems.contact.crossing_contact import CrossingContact
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import stirred

RADIUS, THICK, YOUNG, DENSITY = 0.5, 0.004, 1e7, 1000.0


def made(n, ratio=1.5, thick=THICK, **options):
    """A ring of radius 0.5 m; `ratio` is that of bending to twisting stiffness."""
    return jaxrod.systems.ring(
        n,
        length=2 * np.pi * RADIUS,
        radius=thick,
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / (2 * ratio),
        dtype=jnp.float64,
        **options,
    )


def closed(rod, state, closure, *effects):
    return jaxrod.make_system({"ring": jaxrod.make_scene(rod, *effects)}, closure), {
        "ring": state
    }


def bending(rod):
    return float(rod.bend_twist_stiffness[0, 0])


def displaced(state, way):
    """A state with its nodes moved and its elements turned by `(6 n,)` numbers."""
    move, turn = jnp.split(way, 2)
    move, turn = move.reshape(3, -1), turn.reshape(3, -1)
    move = jnp.concatenate([move, move[:, :1]], axis=1)
    turned = multiply_quaternions(
        rotation_exp((turn[0], turn[1], turn[2])), split_quaternion(state.orientations)
    )
    return replace(
        state,
        positions=state.positions + move,
        orientations=join_quaternion(turned),
    )


def inertia(rod, state):
    """Mass matrix of the same numbers."""
    n = rod.n_elements
    matrix = np.zeros((6 * n, 6 * n))
    # The nodes at both ends are one.
    matrix[: 3 * n, : 3 * n] = np.diag(np.tile(np.asarray(rod.element_masses), 3))
    axes, moments = np.asarray(state.directors), np.asarray(rod.principal_inertias)
    for k in range(n):
        own = axes[:, :, k].T @ np.diag(moments[:, k]) @ axes[:, :, k]
        where = 3 * n + k + n * np.arange(3)
        matrix[np.ix_(where, where)] = own
    return matrix


@jax.jit
def slope_and_stiffness(system, state):
    """First and second derivatives of the energy."""

    def energy(way):
        return system.potential_energy({"ring": displaced(state["ring"], way)})

    none = jnp.zeros(6 * system.members["ring"].rod.n_elements)
    return jax.grad(energy)(none), jax.hessian(energy)(none)


def squares_of_frequencies(system, state):
    """In units of B / (rho A R^4), ascending."""
    rod = system.members["ring"].rod
    _, stiffness = slope_and_stiffness(system, state)
    found = scipy.linalg.eigh(stiffness, inertia(rod, state["ring"]), eigvals_only=True)
    line = float(rod.linear_density[0])
    return found * line * RADIUS**4 / bending(rod)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("straight", "turns"), [(False, 0.0), (True, 0.0), (True, 0.3)]
)
def test_a_ring_stores_what_bends_it_round_and_twists_it(straight, turns):
    """B (2 pi)^2 / 2L if the rod was straight, and C (2 pi turns)^2 / 2L.

    Both together are one rotation at each joint, so the sum is of second order in n.
    """
    rod, state, closure = made(7, straight_at_rest=straight, turns=turns)
    system, whole = closed(rod, state, closure)
    twisting = float(rod.bend_twist_stiffness[2, 0])
    stiffness = straight * bending(rod) + twisting * turns**2
    expected = 0.5 * stiffness * (2 * np.pi) ** 2 / (2 * np.pi * RADIUS)
    found = float(jax.jit(system.potential_energy)(whole))
    rtol = 0.2 / 7**2 if turns else 1e-9
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=1e-15)


@pytest.mark.slow
def test_frequencies_of_a_ring(record):
    found = {}
    for n in (40, 80):
        rod, state, closure = made(n)
        squares = squares_of_frequencies(*closed(rod, state, closure))
        assert np.all(np.abs(squares[:6]) < 1e-4)
        found[n] = np.sqrt(squares[6:])
    orders = (2, 2, 3, 3)
    for k, (order, plane) in enumerate(zip(orders, ("out of", "in") * 2, strict=True)):
        ratio = 1.5 if plane == "out of" else 1.0
        wanted = order * (order**2 - 1) / np.sqrt(order**2 + ratio)
        feature = f"ring, {order} waves {plane} its plane: frequency"
        errors = [abs(found[n][2 * k] / wanted - 1) for n in (40, 80)]
        # Of differences along a wave: (k h)^2 / 12, which 40 elements miss the bar by.
        assert errors[0] < 1.1 * (2 * np.pi * order / 40) ** 2 / 12
        record(
            f"{feature}, 80 elements",
            "n (n^2 - 1) / sqrt(n^2 + 1 or B/C)",
            errors[1],
            at_most=5e-3,
        )
        # The closed form is that of a thin ring: 1e-4 is not of the discretisation.
        record(
            f"{feature}, order of convergence from 40 to 80 elements",
            "2",
            np.log2(errors[0] / errors[1]),
            between=(np.log2(3.5), np.log2(4.5)),
        )
        limit = (4 * found[80][2 * k] - found[40][2 * k]) / 3
        record(
            f"{feature}, extrapolated from 40 and 80 elements",
            "the same",
            abs(limit / wanted - 1),
            at_most=5e-3,
        )


def equilibrium(system, state):
    """Newton's method, for what can move."""
    for _ in range(5):
        slope, stiffness = slope_and_stiffness(system, state)
        way = -np.linalg.pinv(np.asarray(stiffness), rcond=1e-9) @ np.asarray(slope)
        state = {"ring": displaced(state["ring"], jnp.asarray(way))}
    assert np.max(np.abs(slope)) < 1e-10
    return state


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.0, 1.5])
def test_a_twisted_ring_buckles(ratio, record):
    """At Michell's number of turns, of a rod that is straight at rest."""
    critical = np.sqrt(3) * ratio
    turns, lowest = np.array([0.97, 1.03]) * critical, []
    for link in turns:
        rod, state, closure = made(40, ratio, turns=float(link), straight_at_rest=True)
        system, rest = closed(rod, state, closure)
        squares = squares_of_frequencies(system, equilibrium(system, rest))
        # Six rigid motions, and all elements about themselves.
        others = squares[np.argsort(np.abs(squares))[7:]]
        lowest.append(float(np.min(others)))
    assert lowest[0] > 0 > lowest[1]
    found = turns[0] + (turns[1] - turns[0]) * lowest[0] / (lowest[0] - lowest[1])
    record(
        f"twisted ring, B/C = {ratio:g}: turns at which it buckles",
        "sqrt(3) B/C",
        abs(found / critical - 1),
        at_most=8 / 40**2,
    )


def period(system, state, dt, steps, seen):
    """From the upward crossings of a quantity, which begins with its rate."""
    path = jaxrod.rollout(system, state, dt, steps, 10)
    value = np.asarray(seen(path["ring"]))
    times = np.asarray(jaxrod.rollout_times(dt, steps, 10))
    up = np.flatnonzero((value[:-1] < 0) & (value[1:] >= 0))
    slope = (value[up + 1] - value[up]) / (times[1] - times[0])
    crossings = times[up] - value[up] / slope
    return (crossings[-1] - crossings[0]) / (len(crossings) - 1)


@pytest.mark.slow
def test_a_ring_breathes(record):
    rod, state, closure = made(40)
    system, _ = closed(rod, state, closure)
    outwards = state.positions / RADIUS
    start = {"ring": replace(state, velocities=1e-3 * outwards)}
    wanted = np.sqrt(YOUNG / DENSITY) / RADIUS
    dt = float(jaxrod.stable_dt(system).dt)
    steps = int(5 * 2 * np.pi / wanted / dt) // 10 * 10
    size = float(jnp.linalg.norm(state.positions[:, 3]))
    found = period(
        system,
        start,
        dt,
        steps,
        lambda path: jnp.linalg.norm(path.positions[:, :, 3], axis=1) - size,
    )
    record(
        "ring that breathes: frequency",
        "sqrt(E / rho) / R",
        abs(2 * np.pi / found / wanted - 1),
        at_most=5e-3,
    )


@pytest.mark.slow
def test_pressure_buckles_a_ring(record):
    """Its lowest frequency goes to zero at 3 B / R^3: squares are linear in it."""
    rod, state, closure = made(40, thick=5 * THICK)
    critical = 3 * bending(rod) / RADIUS**3
    angles = 2 * np.pi * np.arange(41) / 40
    around = np.stack([-np.sin(angles), np.cos(angles), 0 * angles])
    outwards = np.asarray(state.positions) / RADIUS
    wave = np.cos(2 * angles) * outwards - 0.5 * np.sin(2 * angles) * around
    start = {"ring": replace(state, velocities=jnp.asarray(1e-4 * wave))}
    squares = []
    for share in (0.0, 0.4):
        # d1 points inwards.
        press = jaxrod.uniform_load((share * critical, 0.0, 0.0), follower=True)
        system, _ = closed(rod, state, closure, press)
        dt = float(jaxrod.stable_dt(system).dt)
        slow = 2.683 * np.sqrt(
            (1 - share) * bending(rod) / float(rod.linear_density[0])
        )
        steps = int(3.2 * 2 * np.pi / (slow / RADIUS**2) / dt) // 10 * 10

        def wide(path):
            x, y = path.positions[:, 0], path.positions[:, 1]
            return x[:, 0] - x[:, 20] - y[:, 10] + y[:, 30]

        squares.append(period(system, start, dt, steps, wide) ** -2)
    found = 0.4 / (1 - squares[1] / squares[0])
    record(
        "ring under pressure: where its frequency vanishes",
        "3 E I / R^3",
        abs(found - 1),
        at_most=0.01,
    )


@pytest.mark.slow
def test_no_place_on_a_ring_is_special(record):
    """The same motion, begun a quarter further round."""
    n, quarter = 16, 4
    rod, state, closure = made(n, turns=2.0)
    system, _ = closed(rod, state, closure, jaxrod.gravity())
    moving = stirred(state, 1, 0.2).velocities.at[:, -1].set(0)
    moving = moving.at[:, 0].set(0)

    def shifted(field):
        inner = np.asarray(field)[:, :n]
        turned = np.roll(inner, -quarter, axis=1)
        return jnp.asarray(np.concatenate([turned, turned[:, :1]], axis=1))

    one = {"ring": replace(state, velocities=moving)}
    frames = np.roll(np.asarray(state.orientations), -quarter, axis=1)
    # Past the closure an element is turned by as much as was twisted before.
    two = {
        "ring": replace(
            state,
            positions=shifted(state.positions),
            velocities=shifted(moving),
            orientations=jnp.asarray(frames),
        )
    }
    dt = 0.5 * float(jaxrod.stable_dt(system).dt)
    first = jaxrod.advance(system, one, dt, 1000)["ring"]
    second = jaxrod.advance(system, two, dt, 1000)["ring"]
    assert np.max(np.abs(first.positions - state.positions)) > 4e-3
    record(
        "ring closed at another element",
        "the same ring",
        float(np.max(np.abs(shifted(first.positions) - second.positions))),
        at_most=1e-10,
    )
    np.testing.assert_array_equal(first.positions[:, 0], first.positions[:, -1])


@pytest.mark.slow
def test_a_ring_has_the_link_that_was_put_in():
    rod, state, closure = made(24, turns=3.0, straight_at_rest=True)
    nodes = np.asarray(state.positions)
    middles = 0.5 * (nodes[:, 1:] + nodes[:, :-1])
    ribbon = middles + 0.01 * np.asarray(state.directors[0])
    curve = np.concatenate([middles, middles[:, :1]], axis=1)
    edge = np.concatenate([ribbon, ribbon[:, :1]], axis=1)
    number = jaxrod.topology.linking_number(jnp.asarray(curve), jnp.asarray(edge))
    assert abs(float(number)) == pytest.approx(3.0, abs=1e-6)
    # And the joint that closes it is as all others are.
    system, rest = closed(rod, state, closure)
    seen, (joint, _) = seen_at_rest(system, rest)
    stored = float(system.potential_energy(rest))
    assert float(joint.energy(seen)) == pytest.approx(stored / 24, rel=1e-9)


LISTS = {"lists": jaxrod.systems.neighbour_lists(refresh_every=8)}


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, LISTS], ids=["all", "lists"])
@pytest.mark.parametrize("law", ["line", "crossing"])
def test_contact_counts_the_place_where_a_ring_is_closed_once(law, options):
    """A rod across it presses as across any other node."""
    contact = {
        "line": functools.partial(jaxrod.systems.rod_contact, points_per_element=9),
        "crossing": jaxrod.systems.crossing_contact,
    }[law]
    n = 12
    ring, of_ring, closure = made(n, thick=0.02)
    found = []
    for node in (0, 3, 6):
        place = np.asarray(of_ring.positions[:, node])
        other, of_other = jaxrod.straight_rod(
            3,
            length=0.3,
            radius=0.02,
            density=DENSITY,
            youngs_modulus=YOUNG,
            start=0.7 * place + np.array([0, 0, 0.037]),
            direction=place,
            dtype=jnp.float64,
        )
        state = {"ring": of_ring, "rod": of_other}
        system = jaxrod.make_system(
            {"ring": jaxrod.make_scene(ring), "rod": jaxrod.make_scene(other)},
            closure,
            contact("ring", "rod", stiffness=1e4, **options),
            state=state,
        )
        found.append(float(system.potential_energy(state)))
    assert found[1] > 1e-6
    np.testing.assert_allclose(found, found[1], rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"n": 2}, "n_elements must be at least 3"),
        ({"length": -1.0}, "length must be positive, got -1 m"),
        ({"normal": (0, 0, 0)}, "normal must not be the zero vector"),
        ({"turns": np.nan}, "turns must be finite"),
        ({"radius": 0.0}, "radius must be positive, got 0 m"),
    ],
)
def test_bad_input(options, words):
    given = {"length": 1.0, "radius": 0.01, "density": 1e3, "youngs_modulus": 1e6}
    given = given | options
    with pytest.raises(ValueError, match=words):
        jaxrod.systems.ring(given.pop("n", 10), **given)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("n", [3, 8])
def test_contact_knows_that_a_ring_is_closed_and_a_rod_is_not(n):
    rod, state, closure = made(n)
    arm, at_rest = jaxrod.straight_rod(
        n,
        length=1.0,
        radius=THICK,
        density=DENSITY,
        youngs_modulus=YOUNG,
        start=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    contact = jaxrod.systems.crossing_contact("ring", "arm", stiffness=1e3)
    system = jaxrod.make_system(
        {"ring": jaxrod.make_scene(rod), "arm": jaxrod.make_scene(arm)},
        closure,
        contact,
    )
    _, couplings = seen_at_rest(system, {"ring": state, "arm": at_rest})
    (fitted,) = (c for c in couplings if isinstance(c, CrossingContact))
    assert [own.closed for own in fitted.segments] == [(0,), ()]
