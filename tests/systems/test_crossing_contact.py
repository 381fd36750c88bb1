"""Contact between rods by the crossing law: counted once, conservative, smooth."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.contact.element_pairs import Elements
from jaxrod.systems.contact.segment_distance import apart
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import rod
from systems.resting_ropes import (
    LENGTH,
    nodes_of,
    resting_ropes,
    two_elasticae,
)
from systems.resting_ropes import (
    STIFFNESS as OF_ROPES,
)

STIFFNESS, RADIUS = 1e3, 0.02


def crossing(a, b, **law):
    """A system of two rods with contact by the crossing law, and its state."""
    (one, of_one), (two, of_two) = a, b
    system = jaxrod.make_system(
        {"one": jaxrod.make_scene(one), "two": jaxrod.make_scene(two)},
        jaxrod.systems.crossing_contact("one", "two", stiffness=STIFFNESS, **law),
    )
    return system, {"one": of_one, "two": of_two}


@jax.jit
def loads_and_slopes(system, state):
    """Loads of the contact, its energy and the gradient of that."""

    def energy(positions):
        moved = {k: replace(state[k], positions=positions[k]) for k in state}
        seen, (contact,) = seen_at_rest(system, moved)
        return contact.energy(seen)

    positions = {name: own.positions for name, own in state.items()}
    seen, (contact,) = seen_at_rest(system, state)
    return contact.loads(seen), *jax.value_and_grad(energy)(positions)


@jax.jit
def loads_alone(system, state):
    """Loads of the contact."""
    seen, (contact,) = seen_at_rest(system, state)
    return contact.loads(seen)


def bent_elements(rng, n, bulge):
    """Pairs of elements whose axes bulge by random vectors, about a diameter apart."""
    vector = lambda scale: tuple(jnp.asarray(scale * rng.normal(size=(3, n))))
    middle = (jnp.zeros(n), jnp.zeros(n), jnp.asarray(rng.uniform(0, 3 * RADIUS, n)))
    made = []
    for at in (vector(0.2 * RADIUS), middle):
        edge = vector(4 * RADIUS)
        first = tuple(c - 0.5 * e for c, e in zip(at, edge, strict=True))
        made.append(
            Elements(
                first=first,
                edge=edge,
                radii=jnp.full(n, RADIUS),
                follows=jnp.ones(n),
                first_velocity=vector(0.0),
                velocity_change=vector(0.0),
                bulges=(vector(bulge), vector(bulge)),
                velocity_bulges=(vector(0.0), vector(0.0)),
            )
        )
    return made


def test_pairs_that_are_left_out_do_not_touch(record):
    """All points of two axes that bulge anyhow; few pairs are computed in vain."""
    system, _ = crossing(rod(), rod())
    contact = system.couplings[0]
    rng = np.random.default_rng(0)
    places = jnp.stack(jnp.meshgrid(*2 * [jnp.linspace(0, 1, 21)]), -1).reshape(-1, 2)

    @jax.jit
    def distances(own, other, place):
        way = tuple(a - b for a, b in zip(own.first, other.first, strict=True))
        between = apart(way, own, other, tuple(place))
        return jnp.sqrt(sum(x * x for x in between))

    for bulge in (0.0, 0.3 * RADIUS, 3 * RADIUS):
        own, other = bent_elements(rng, 4000, bulge)
        one = jnp.ones(4000)
        touching = jax.jit(contact.touching)(own, other, one)
        nearest = jnp.min(jax.vmap(distances, (None, None, 0))(own, other, places), 0)
        near = nearest < 2 * RADIUS
        assert int(near.sum()) > 400
        assert not bool(jnp.any(near & ~touching))
        in_vain = float(jnp.mean(touching & ~near))
        record(
            "share of pairs that do not touch",
            f"bulges of {bulge / RADIUS:g} radii",
            in_vain,
            at_most=0.01 + 0.12 * bulge / RADIUS,
        )


@pytest.mark.slow
@pytest.mark.parametrize("length", [1, 2, 8])
def test_a_crossing_is_counted_once_wherever_it_is(length, record):
    """Sliding along three elements, of any length for their radius."""
    element = length * RADIUS
    gap, angle = 0.9 * 2 * RADIUS, np.deg2rad(80)
    way = np.array((np.cos(angle), np.sin(angle), 0.0))
    energies = []
    for shift in np.linspace(0, 3 * element, 31):
        middle = np.array((3 * element + shift, 0.0, gap))
        system, state = crossing(
            rod(10, 10 * element),
            rod(9, 9 * element, tuple(middle - 4.3 * element * way), tuple(way)),
        )
        energies.append(float(loads_and_slopes(system, state)[1]))
    # The smooth onset adds what does not depend on depth, a width squared over 24.
    width = 0.01 * RADIUS
    expected = 0.5 * STIFFNESS * (0.2 * RADIUS) ** 2 + STIFFNESS * width**2 / 24
    record(
        f"crossing law, energy along 3 elements of {length} radii: ripple",
        "one spring",
        np.max(np.abs(np.array(energies) / expected - 1)),
        at_most=1e-12,
    )


@pytest.mark.slow
def test_a_load_on_a_limp_rope_may_be_anywhere_along_an_element(record):
    """Work of a load that slides, at its share of each node of a rope under tension."""
    n, pull = 12, []
    tight = np.linalg.inv(2 * np.eye(n - 1) - np.eye(n - 1, k=1) - np.eye(n - 1, k=-1))
    for share in np.linspace(0, 1, 9):
        across = rod(3, 0.3, (5 + share, -0.15, 0.038), (0, 1, 0))
        system, state = crossing(rod(n, float(n)), across)
        loads = loads_alone(system, state)
        shares = np.asarray(loads["one"].forces[2])
        shares = shares[1:-1] / np.sum(shares)
        place = np.sum(shares * np.arange(1, n))
        assert place == pytest.approx(5 + share, abs=1e-12)
        smooth = place * (n - place) / n
        pull.append(0.5 * (smooth - shares @ tight @ shares))
    record(
        "crossing law, work of a load that slides along an element of a limp rope",
        "the same everywhere, over load, angle and length of an element",
        np.ptp(pull),
        at_most=2e-4,
    )


@pytest.mark.slow
def test_loads_of_bent_rods_are_minus_the_gradient_of_the_energy():
    """Hooks of few elements, one in the other and back to back."""
    angles = np.linspace(-1, 1, 9)
    hook = 0.2 * np.stack([np.sin(angles), 0 * angles, 1 - np.cos(angles)])
    turned = np.stack([-0.7 * hook[0], 0.75 * hook[0], -hook[2]])
    law = {"radius": RADIUS, "density": 1000.0, "youngs_modulus": 1e6}
    law["dtype"] = jnp.float64
    for shift in (0.0, 0.011, 0.03):
        moved = turned + np.array((shift, 0.0, -0.036))[:, None]
        two = turned * [[1], [1], [-1]] + np.array((shift, 0.0, 0.036))[:, None]
        for other in (moved, two):
            system, state = crossing(
                jaxrod.rod_along(hook, **law), jaxrod.rod_along(other, **law)
            )
            loads, energy, slopes = loads_and_slopes(system, state)
            assert energy > 1e-5
            total = np.zeros(3)
            moment = np.zeros(3)
            for name, own in loads.items():
                force = np.stack(own.forces)
                most = np.max(np.abs(slopes[name]))
                assert np.max(np.abs(force + slopes[name])) < 1e-11 * most
                total += np.sum(force, axis=1)
                moment += np.sum(np.cross(state[name].positions.T, force.T), axis=0)
            assert np.max(np.abs(total)) < 1e-13 * most
            assert np.max(np.abs(moment)) < 1e-13 * most


@pytest.mark.slow
@pytest.mark.parametrize("n", [20, 21, 50, 51])
def test_ropes_that_rest_on_each_other_stay_where_they_are(n, record):
    """Held at both ends: in the middle of an element as at a node."""
    found, free = two_elasticae()
    rest = nodes_of(found, n)
    contact = jaxrod.systems.crossing_contact(
        *rest, stiffness=OF_ROPES, damping=0.1, lists=jaxrod.systems.neighbour_lists()
    )
    system, state = resting_ropes(n, rest, contact)
    dt = float(jaxrod.stable_dt(system).dt)
    steps = int(0.5 / dt)
    step = jax.jit(jaxrod.advance, static_argnums=3)
    path = []
    for _ in range(40):
        state = step(system, state, 0.5 / steps, steps)
        path.append({name: np.asarray(state[name].positions) for name in rest})
    # Each moves aside by as much as it has slid along the other.
    aside = {"below": 1, "above": 0}
    slid = max(np.max(np.abs(p[k][aside[k]])) for p in path[3:] for k in rest)
    record(
        f"ropes of {n} elements at rest on each other from 2 s to 20 s: way along them",
        "none, in elements",
        slid * n / LENGTH,
        at_most=0.1,
    )
    moved = max(np.max(np.abs(p[k] - path[9][k])) for p in path[9:] for k in rest)
    record(
        f"ropes of {n} elements at rest on each other from 5 s to 20 s: movement",
        "none, in lengths",
        moved / LENGTH,
        at_most=1e-6,
    )
    shape = max(np.max(np.abs(path[-1][k] - rest[k])) for k in rest)
    record(
        f"ropes of {n} elements at rest on each other: shape",
        "two elasticae with a load in the middle, in lengths",
        shape / LENGTH,
        at_most=1.5 / n**2,
    )
    if n % 2 == 0:
        lift = free.y[1, -1] - found.y[1, -1], found.y[5, -1] - free.y[5, -1]
        middle = [path[-1][k][2, n // 2] - rest[k][2, n // 2] for k in rest]
        record(
            f"ropes of {n} elements at rest on each other: lift of the upper one",
            "the same, relative",
            abs(middle[1] / lift[1]),
            at_most=16 / n**2,
        )


@pytest.mark.slow
@pytest.mark.parametrize("n", [20, 21])
def test_the_middle_is_a_stable_place_only_while_the_ropes_ends_are_near(n):
    """Ropes whose ends differ by 10 cm slide off each other, whatever the grid."""
    for lower, stable in ((0.05, True), (0.1, False)):
        found, _ = two_elasticae(lower)
        rest = nodes_of(found, n)
        contact = jaxrod.systems.crossing_contact(*rest, stiffness=OF_ROPES)
        system, state = resting_ropes(n, rest, contact)
        balance = jaxrod.equilibrium(system.at(0.0), state)
        assert balance.converged
        assert balance.stable == stable
        slid = (
            balance.state["below"].positions[1],
            balance.state["above"].positions[0],
        )
        assert np.max(np.abs(slid)) < 1e-12 * LENGTH


@pytest.mark.slow
def test_loads_are_minus_the_gradient_of_the_energy(record):
    """At all angles: crossed, nearly parallel, parallel."""
    random = np.random.default_rng(0)
    worst, most = 0.0, 0.0
    for angle in (1.5, 0.3, 0.05, 0.003, 0.002, 0.0):
        for _ in range(3):
            start = (random.uniform(0, 0.15), random.uniform(-0.01, 0.01), 0.037)
            way = (np.cos(angle), np.sin(angle), 0.0)
            system, state = crossing(rod(5, 0.5), rod(4, 0.4, start, way))
            loads, _, slopes = loads_and_slopes(system, state)
            for name, own in loads.items():
                error = np.max(np.abs(np.stack(own.forces) + slopes[name]))
                worst = max(worst, error)
                most = max(most, float(np.max(np.abs(slopes[name]))))
    assert most > 1
    record(
        "crossing law, forces at angles from 90 degrees to parallel",
        "gradient of the energy",
        worst / most,
        at_most=2e-11,
    )


@pytest.mark.slow
def test_nearly_parallel_rods_push_apart_however_little_they_touch():
    """Where only a node touches, the middles of elements do not."""
    for degrees in (0.3, 1.0, 3.0, 5.0):
        for shift in (0.0, 0.3, 0.5):
            angle, depth = np.deg2rad(degrees), 1e-3 * RADIUS
            way = np.array((np.cos(angle), np.sin(angle), 0.0))
            middle = np.array((0.2 + 0.1 * shift, 0.0, 2 * RADIUS - depth))
            system, state = crossing(
                rod(4, 0.4), rod(4, 0.4, tuple(middle - 0.2 * way), tuple(way))
            )
            loads, energy, _ = loads_and_slopes(system, state)
            assert energy > 0
            # Of one spring, in the middle of its onset.
            width = 0.01 * RADIUS
            push = STIFFNESS * (depth + 0.5 * width) ** 2 / (2 * width)
            assert np.sum(loads["two"].forces[2]) == pytest.approx(push, rel=1e-3)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("angle", [1.2, 0.06, 0.02])
def test_dashpots_and_friction_only_take_energy(angle):
    """Of rods that are bent and turn, so that places near each other move apart."""
    random = np.random.default_rng(1)
    law = {"damping": 0.5, "friction": 0.4, "friction_drag": 3.0}
    taken = 0.0
    for _ in range(20):
        start = (random.uniform(0, 0.1), random.uniform(-0.01, 0.01), 0.037)
        way = (np.cos(angle), np.sin(angle), 0.0)
        pair = rod(5, 0.5), rod(5, 0.5, start, way)
        with_law, state = crossing(*pair, **law)
        without, _ = crossing(*pair)
        state = {name: stirred(own, random) for name, own in state.items()}
        power = 0.0
        rubbing, sliding = (
            moving_loads(system, state) for system in (with_law, without)
        )
        for name, (loads, spins) in rubbing.items():
            springs = sliding[name][0]
            force = np.stack(loads.forces) - np.stack(springs.forces)
            power += np.sum(force * state[name].velocities)
            power += np.sum(np.stack(loads.couples) * np.stack(spins))
        assert power <= 1e-15
        taken = min(taken, power)
    assert taken < -1e-3


def stirred(state, random):
    """A state with bent axes and random velocities."""
    shape = state.positions.shape
    return replace(
        state,
        positions=state.positions + random.normal(0, 1e-3, shape),
        velocities=jnp.asarray(random.normal(0, 1.0, shape)),
        angular_momenta=state.angular_momenta
        + random.normal(0, 1e-3, state.angular_momenta.shape),
    )


@jax.jit
def moving_loads(system, state):
    """Loads of contact on each rod, and spins in the frames of its elements."""
    seen, (contact,) = seen_at_rest(system, state)
    loads = contact.loads(seen)
    return {
        name: (own, jaxrod.angular_velocities(system.members[name].rod, state[name]))
        for name, own in loads.items()
    }


@pytest.mark.slow
def test_collision_keeps_momenta(record):
    """Two rods that spin collide off their middles, with damping and friction."""
    one, of_one = rod(4, 0.4)
    two, of_two = rod(3, 0.3, (0.12, -0.2, 0.041), (0.3, 1, 0.1))
    of_two = replace(of_two, velocities=of_two.velocities.at[2].set(-0.5))
    spin = np.zeros((3, 3))
    spin[2] = 20.0
    of_two = jaxrod.with_angular_velocities(two, of_two, spin)
    system, state = crossing((one, of_one), (two, of_two), damping=0.5, friction=0.4)
    dt = 0.5 * jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 400)
    assert np.max(np.abs(after["one"].velocities)) > 0.01
    size = float(np.sum(two.node_masses)) * 0.5
    for function, unit, bar in (
        (jaxrod.System.momentum, size, 1e-13),
        (jaxrod.System.angular_momentum, 0.3 * size, 1e-13),
    ):
        change = np.linalg.norm(function(system, after) - function(system, state))
        record(
            "crossing law, collision with friction and damping",
            function.__name__.replace("_", " "),
            change / unit,
            at_most=bar,
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "way", "h"),
    [
        ((0.12, -0.12, 0.037), (0, 1, 0), 1e-4),
        ((0.03, 0.0, 0.036), (1, 0, 0), 3e-4),
        ((0.03, -0.003, 0.036), (1, 0.05, 0), 1e-4),
        ((0.12, -0.12, 0.0), (0, 1, 0), 1e-4),
        ((0.12, -0.12, 0.0401), (0, 1, 0), 1e-4),
    ],
    ids=["crossing", "parallel", "nearly parallel", "coincident", "onset"],
)
def test_gradient_of_a_run(place, way, h, record):
    """Through a rod's fall on another with friction, against central differences.

    For parallel rods, rounding and truncation of differences are equal at 2e-6.
    """
    one, of_one = rod(3, 0.3)
    two, of_two = rod(3, 0.3, place, way)
    system, state = crossing((one, of_one), (two, of_two), damping=0.5, friction=0.3)
    dt = 0.3 * jaxrod.stable_dt(system).dt
    direction = jnp.array((0.3, 0.2, -1.0))[:, None]
    weights = jax.random.normal(jax.random.key(0), (3, 4))

    @jax.jit
    def ended(speed):
        moved = {**state}
        moved["two"] = replace(of_two, velocities=of_two.velocities + speed * direction)
        after = jaxrod.advance(system, moved, dt, 20)
        return jnp.sum(weights * after["one"].velocities)

    slope = float(jax.jit(jax.grad(ended))(0.2))
    difference = float((ended(0.2 + h) - ended(0.2 - h)) / (2 * h))
    assert np.isfinite(slope)
    record(
        "crossing law, gradient of 20 steps",
        "central differences",
        abs(slope - difference) / (abs(difference) + 1e-3),
        at_most=2e-6,
    )


@pytest.mark.slow
@pytest.mark.parametrize("along", [0.1, 0.13, 0.15])
def test_the_bound_is_above_the_stiffness_and_within_a_factor(along):
    """Against the largest eigenvalue of the contact alone, at nodes and between."""
    one, of_one = rod(3, 0.3)
    two, of_two = rod(2, 0.2, (along, -0.1, 0.036), (0, 1, 0))
    system, state = crossing((one, of_one), (two, of_two), max_contacts=1)

    @jax.jit
    def energy(flat):
        nodes = {"one": flat[:12].reshape(3, 4), "two": flat[12:].reshape(3, 3)}
        moved = {k: replace(state[k], positions=nodes[k]) for k in nodes}
        seen, (contact,) = seen_at_rest(system, moved)
        return contact.energy(seen)

    flat = jnp.concatenate([of_one.positions.ravel(), of_two.positions.ravel()])
    masses = np.concatenate([np.tile(r.node_masses, 3) for r in (one, two)])
    slopes = np.asarray(jax.hessian(energy)(flat)) / np.sqrt(np.outer(masses, masses))
    stiffest = np.max(np.linalg.eigvalsh(slopes))
    parts = system.parts()
    bounds = system.couplings[0].stability_bounds(parts)
    bound = max(np.max(bounds[k].nodes / parts[k].node_masses) for k in parts)
    assert bound / 8 <= stiffest <= bound


@pytest.mark.slow
def test_order_of_members_and_couplings_does_not_matter():
    """Three rods in a heap: the same to rounding in any order."""
    rods = {
        "a": rod(4, 0.4),
        "b": rod(3, 0.3, (0.12, -0.15, 0.037), (0, 1, 0.01)),
        "c": rod(5, 0.4, (0.0, 0.04, 0.02), (1, 0.03, 0.1)),
    }
    state = {name: own for name, (_, own) in rods.items()}
    state["b"] = replace(state["b"], velocities=state["b"].velocities - 0.2)
    law = {"stiffness": STIFFNESS, "damping": 0.3, "friction": 0.3}
    lines = law | {"stiffness": 20 * STIFFNESS, "points_per_element": 3}
    system = jaxrod.make_system(
        {name: jaxrod.make_scene(rods[name][0]) for name in "abc"},
        jaxrod.systems.crossing_contact("a", "b", **law),
        jaxrod.systems.rod_contact("a", "c", **lines),
    )
    turned = jaxrod.make_system(
        {name: jaxrod.make_scene(rods[name][0]) for name in "cba"},
        jaxrod.systems.rod_contact("c", "a", **lines),
        jaxrod.systems.crossing_contact("b", "a", **law),
    )
    dt = 0.3 * jaxrod.stable_dt(system).dt
    ends = [jaxrod.advance(one, state, dt, 100) for one in (system, turned)]
    assert np.max(np.abs(ends[0]["a"].velocities)) > 0.01
    for name in rods:
        np.testing.assert_allclose(
            ends[0][name].velocities, ends[1][name].velocities, rtol=0, atol=1e-12
        )


@pytest.mark.parametrize(
    ("members", "options", "words"),
    [
        (("one", "none"), {}, "no member is called 'none'"),
        (("one",), {}, "nothing to touch but itself"),
        (("one", "one"), {}, "named once"),
        (("one", "two"), {"friction": 0.2}, "friction_drag"),
        (("one", "two"), {"stiffness": -1.0}, "stiffness must be positive"),
        (("one", "ball"), {}, "is rigid"),
        (
            ("one", "two"),
            {"lists": jaxrod.systems.neighbour_lists()},
            "make_system a state",
        ),
    ],
)
def test_bad_input(members, options, words):
    one, _ = rod(4, 0.3)
    ball, _ = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0, 0, 1), 0.1), density=1.0, dtype=jnp.float64
    )
    scene = jaxrod.make_scene(one)
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system(
            {"one": scene, "two": scene, "ball": ball},
            jaxrod.systems.crossing_contact(*members, **{"stiffness": 1.0} | options),
        )
