"""Nothing passes through anything: a plait, a nest, a rope that comes to lie on itself.

Contact holds them apart with friction, and flags rise where it is forced too hard.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import assemblies

THICK, N = 0.01, 30
"""Radius of a strand [m], and its elements."""


def plait(pull, stiffness=2e3):
    """Three strands of a plait whose ends are pulled, or pushed if below zero [N]."""
    share = np.linspace(0, 1, N + 1)
    turns = [2 * np.pi * (share + k / 3) for k in range(3)]
    curves = [
        THICK * np.stack([3.0 * np.sin(t), 1.3 * np.sin(2 * t), 40.0 * share])
        for t in turns
    ]
    rods, states = assemblies.groups.rods_along(
        curves, radius=THICK, density=1000.0, youngs_modulus=1e6, dtype=jnp.float64
    )

    def one(rod, state):
        return jaxrod.make_scene(
            rod,
            jaxrod.pin_support(state),
            jaxrod.pin_support(state, "tip", axes="xy"),
            jaxrod.end_load((0.0, 0.0, pull)),
            jaxrod.exponential_damping(20.0),
        )

    law = {"stiffness": stiffness, "damping": 0.2, "friction": 0.3}
    touch = jaxrod.systems.crossing_contact("strands", **law)
    members, state = {"strands": jax.vmap(one)(rods, states)}, {"strands": states}
    return jaxrod.make_system(members, touch, state=state), state


def strands(state):
    """Nodes of the strands `(3, 3, n + 1)`."""
    return state["strands"].positions


def closed(nodes, number):
    """A strand with straight pieces that close it far away, each at its own height."""
    far, high = 2.0 + 0.3 * number, 0.5 + 0.1 * number
    start, finish = nodes[:, :1], nodes[:, -1:]
    up = jnp.array([[0.0], [0.0], [high]])
    out = jnp.array([[far], [0.1 * number], [0.0]])
    ends = [finish + up, finish + up + out, start - up + out, start - up]
    return jnp.concatenate([nodes, *ends], axis=1)


@jax.jit
def links(state):
    """Linking numbers of every two strands."""
    each = [closed(nodes, k) for k, nodes in enumerate(strands(state))]
    pairs = [(a, b) for a in range(len(each)) for b in range(a)]
    return jnp.stack(
        [jaxrod.topology.linking_number(each[a], each[b]) for a, b in pairs]
    )


@jax.jit
def passages(before, after):
    """How many rods, given by their nodes, passed through others or themselves."""
    rods = range(before.shape[0])
    itself = jnp.sum(jax.vmap(jaxrod.topology.crossed)(before, after))
    pairs = [(a, b) for a in rods for b in rods if b < a]
    if not pairs:
        return itself
    pick = lambda nodes, which: jnp.stack([nodes[pair[which]] for pair in pairs])
    own = pick(before, 0), pick(after, 0), pick(before, 1), pick(after, 1)
    return itself + jnp.sum(jax.vmap(jaxrod.topology.crossed)(*own))


def followed(system, state, duration, records, nodes):
    """States at equal times, flags of each, and passages from each to the next."""
    dt = float(jaxrod.stable_dt(system).dt)
    states = [state]
    for _ in range(records):
        steps = int(duration / records / dt) + 1
        states.append(jaxrod.advance(system, states[-1], dt, steps))
    examined = jax.jit(lambda own: jaxrod.health(system, own, dt))
    through = [
        int(passages(nodes(before), nodes(after)))
        for before, after in itertools.pairwise(states)
    ]
    return states, [examined(own) for own in states], through


@pytest.mark.slow
@pytest.mark.parametrize(("words", "pull"), [("pulled", 3.0), ("pressed", -0.5)])
def test_strands_of_a_plait_stay_linked(words, pull, record):
    system, state = plait(pull)
    states, flags, through = followed(system, state, 0.5, 20, strands)
    assert not any(health.flagged for health in flags)
    assert max(float(health.largest_violation) for health in flags) > 0.03
    found = np.stack([links(own) for own in states])
    # Closed they are Borromean rings: no two are linked, until one passes through.
    assert np.max(np.abs(found[0] - np.round(found[0]))) < 1e-10
    longer = float(strands(states[-1])[0, 2, -1] - strands(state)[0, 2, -1])
    assert longer * np.sign(pull) > 0.1 * THICK
    record(
        f"{words} plait of three strands, friction 0.3: linking numbers",
        "whole, as at the beginning, at 20 instants",
        np.max(np.abs(found - found[0])),
        at_most=1e-10,
    )
    record(
        f"{words} plait of three strands: passages through one another",
        "none",
        sum(through),
        at_most=0,
    )


@pytest.mark.slow
def test_a_plait_that_is_torn_through_itself_is_noticed():
    """Contact too soft for the pull: flagged before its links have changed."""
    system, state = plait(10.0, stiffness=20.0)
    states, flags, through = followed(system, state, 0.5, 40, strands)
    changed = [np.max(np.abs(links(own) - links(states[0]))) > 0.5 for own in states]
    assert any(through) and any(changed)
    first = int(np.flatnonzero(changed)[0])
    assert any(health.violation for health in flags[: first + 1])
    # Links and passages tell the same.
    assert int(np.flatnonzero(through)[0]) <= first - 1


def covered_nest(height):
    """Twelve rods in a pot under a smooth lid at a height [m]."""
    lid = jaxrod.shapes.plane((0.0, 0.0, height), (0.0, 0.0, -1.0))
    return assemblies.nest(
        12,
        6,
        length=0.2,
        radius=0.012,
        pot_radius=0.15,
        stiffness=2e4,
        damping=8.0,
        friction=0.3,
        points_per_element=4,
        effects=(
            jaxrod.gravity((0.0, 0.0, -9.81)),
            jaxrod.exponential_damping(3.0),
            jaxrod.contact(lid, stiffness=2e4, damping=8.0, points_per_element=2),
        ),
        density=1000.0,
        youngs_modulus=1e6,
        dtype=jnp.float64,
    )


@pytest.mark.slow
def test_rods_of_a_nest_stay_apart_under_a_lid(record):
    """Until it is pressed so hard that they are in each other, and that is flagged."""
    nodes = lambda own: own["rods"].positions
    system, state = covered_nest(0.4)
    states, flags, through = followed(system, state, 0.4, 16, nodes)
    top = float(jnp.max(nodes(states[-1])[:, 2])) + 0.012
    for share in (0.95, 0.85, 0.75):
        system, _ = covered_nest(share * top)
        after, more, passed = followed(system, states[-1], 0.1, 5, nodes)
        states, flags = states + after[1:], flags + more
        through = through + passed
    assert not any(health.flagged for health in flags)
    # It bears on the lid: what is in contact is pressed in.
    assert float(jnp.max(nodes(states[-1])[:, 2])) < 0.85 * (top - 0.012)
    assert max(float(health.largest_violation) for health in flags) > 0.05
    record(
        "twelve rods of a nest pressed by a plane, friction 0.3: passages",
        "none, between 31 instants",
        sum(through),
        at_most=0,
    )
    system, _ = covered_nest(0.02)
    _, flags, _ = followed(system, states[-1], 0.1, 5, nodes)
    assert any(health.flagged for health in flags)


@pytest.mark.slow
def test_a_rope_comes_to_lie_on_a_floor_and_on_itself(record):
    """A loop that is let fall flat, so that it is held up where it crosses."""
    radius, n = 0.01, 36
    t = np.linspace(-1.5, 1.5, 2000)
    # It crosses itself at right angles at t = -1 and, three radii higher, t = 1.
    height = 0.02 + 1.5 * radius * (1 + np.clip(t, -1, 1))
    curve = np.stack([0.1 * (t**3 - t), 0.1 * t**2, height])
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(curve), axis=0)))
    even = np.linspace(0, along[-1], n + 1)
    rod, state = jaxrod.rod_along(
        np.stack([np.interp(even, along, line) for line in curve]),
        radius=radius,
        density=1000.0,
        youngs_modulus=1e5,
        dtype=jnp.float64,
    )
    law = {"stiffness": 1e4, "damping": 10.0, "friction": 0.4}
    floor = jaxrod.contact(jaxrod.shapes.plane(), points_per_element=2, **law)
    scene = jaxrod.make_scene(
        rod, jaxrod.gravity((0.0, 0.0, -9.81)), floor, jaxrod.exponential_damping(3.0)
    )
    touch = jaxrod.systems.rod_contact(
        "rope", self_contact=True, points_per_element=4, **law
    )
    system = jaxrod.make_system({"rope": scene}, touch)
    nodes = lambda own: own["rope"].positions[None]
    states, flags, through = followed(system, {"rope": state}, 1.8, 30, nodes)
    assert not any(health.flagged for health in flags) and not any(through)
    energies = [float(system.kinetic_energy(own)) for own in states]
    record(
        "rope dropped on a floor and on itself, friction 0.4: kinetic energy left",
        "0, over the largest there was",
        energies[-1] / max(energies),
        at_most=1e-3,
    )
    heights = np.asarray(states[-1]["rope"].positions[2])
    sunk = float(rod.linear_density[0]) * 9.81 / law["stiffness"]
    # Most of it lies on the floor; where it crosses, one part lies on the other.
    record(
        "rope dropped on a floor and on itself: height of most of it, off by [radii]",
        "its radius, minus the indentation by its weight",
        abs(float(np.median(heights)) - (radius - sunk)) / radius,
        at_most=0.05,
    )
    depth = float(flags[-1].largest_violation) * radius
    assert 0.1 * radius < depth < 0.5 * radius
    top = np.min(heights) + 2 * radius - depth
    assert np.max(heights) == pytest.approx(top, abs=0.1 * radius)
