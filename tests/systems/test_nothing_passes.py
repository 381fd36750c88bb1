"""Nothing passes through anything: a braid, a nest, a rope that comes to lie on itself.

Contact holds them apart with friction, and flags rise where it is forced too hard.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import assemblies

THICK, LONG, WIDE = 0.002, 0.2, 0.03
"""Radius of the strands, length and radius of the braid [m]."""


def braid(stiffness, way):
    """Two strands each way between plates that are drawn apart by `way` each [m]."""
    built, state = assemblies.braid(
        2,
        24,
        radius=WIDE,
        length=LONG,
        turns=1.0,
        thickness=THICK,
        joined="free",
        effects=(jaxrod.exponential_damping(20.0),),
        density=1000.0,
        youngs_modulus=1e6,
        dtype=jnp.float64,
    )
    springs = [
        jaxrod.pose_spring(
            (plate,),
            state,
            stiffness=500.0,
            damping=2.0,
            turning_stiffness=1.0,
            turning_damping=1e-3,
            displacement=(0.0, 0.0, sign * way),
        )
        for plate, sign in (("bottom", -1), ("top", 1))
    ]
    law = {"stiffness": stiffness, "damping": 0.02, "friction": 0.3}
    touch = jaxrod.crossing_contact("left", "right", **law)
    couplings = (*built.couplings, *springs, touch)
    return jaxrod.make_system(built.members, *couplings, state=state), state


def strands(state):
    """Nodes of all rods of a state `(rods, 3, nodes)`."""
    return jnp.concatenate([state["left"].positions, state["right"].positions])


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
    return jnp.stack([jaxrod.linking_number(each[a], each[b]) for a, b in pairs])


@jax.jit
def passages(before, after):
    """How many rods, given by their nodes, passed through others or themselves."""
    rods = range(before.shape[0])
    itself = jnp.sum(jax.vmap(jaxrod.crossed)(before, after))
    pairs = [(a, b) for a in rods for b in rods if b < a]
    if not pairs:
        return itself
    pick = lambda nodes, which: jnp.stack([nodes[pair[which]] for pair in pairs])
    own = pick(before, 0), pick(after, 0), pick(before, 1), pick(after, 1)
    return itself + jnp.sum(jax.vmap(jaxrod.crossed)(*own))


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
        for before, after in zip(states[:-1], states[1:], strict=True)
    ]
    return states, [examined(own) for own in states], through


@pytest.mark.slow
@pytest.mark.parametrize(("words", "way"), [("pulled", 0.006), ("pressed", -0.01)])
def test_strands_of_a_braid_stay_linked(words, way, record):
    system, state = braid(2e3, way)
    states, flags, through = followed(system, state, 0.2, 20, strands)
    assert not any(health.flagged for health in flags)
    assert max(float(health.largest_violation) for health in flags) > 0.01
    first, found = links(states[0]), np.stack([links(own) for own in states])
    assert np.max(np.abs(first - np.round(first))) < 1e-10
    height = lambda own: float(own["top"].positions[2, 0] - own["bottom"].positions[2, 0])
    moved = height(states[-1]) - height(states[0])
    assert moved / (2 * way) > 0.3
    record(
        f"braid that is {words}, friction 0.3: linking numbers, at 20 instants",
        "whole, as at the beginning",
        np.max(np.abs(found - first)),
        at_most=1e-10,
    )
    record(
        f"braid that is {words}: passages of strands through one another",
        "none",
        sum(through),
        at_most=0,
    )


@pytest.mark.slow
def test_a_braid_that_is_torn_through_itself_is_noticed():
    """Contact too soft for the pull: flagged before its links have changed."""
    system, state = braid(20.0, 0.02)
    states, flags, through = followed(system, state, 0.2, 40, strands)
    changed = [np.max(np.abs(links(own) - links(states[0]))) > 0.5 for own in states]
    assert any(through) and any(changed)
    first = int(np.flatnonzero(changed)[0])
    assert any(health.violation for health in flags[: first + 1])
    # Links and passages tell the same.
    assert int(np.flatnonzero(through)[0]) == first - 1


def pressed_nest(depth):
    """Twelve rods in a pot under a heavy lid that is pressed down by `depth` [m]."""
    built, state = assemblies.nest(
        12,
        6,
        length=0.2,
        radius=0.012,
        pot_radius=0.15,
        stiffness=2e4,
        damping=8.0,
        friction=0.3,
        points_per_element=4,
        effects=(jaxrod.gravity(), jaxrod.exponential_damping(3.0)),
        density=1000.0,
        youngs_modulus=1e6,
        dtype=jnp.float64,
    )
    top = float(jnp.max(state["rods"].positions[:, 2])) + 0.015
    disc = jaxrod.cylinder((0, 0, top), (0, 0, top + 0.05), 0.149)
    lid, of_lid = jaxrod.rigid_body(disc, density=300.0, dtype=jnp.float64)
    members, state = {**built.members, "lid": lid}, {**state, "lid": of_lid}
    press = jaxrod.pose_spring(
        ("lid",),
        state,
        stiffness=2e3,
        damping=50.0,
        turning_stiffness=50.0,
        turning_damping=0.5,
        displacement=(0.0, 0.0, -depth),
    )
    law = {"stiffness": 2e4, "damping": 8.0, "friction": 0.3, "points_per_element": 4}
    touch = jaxrod.body_contact("rods", "lid", **law)
    return jaxrod.make_system(members, *built.couplings, press, touch), state


@pytest.mark.slow
def test_rods_of_a_nest_stay_apart_under_a_lid(record):
    """Until it is pressed so hard that they are in each other, and that is flagged."""
    nodes = lambda own: own["rods"].positions
    system, state = pressed_nest(0.2)
    states, flags, through = followed(system, state, 0.5, 50, nodes)
    assert not any(health.flagged for health in flags)
    # They bear the lid, in a heap lower than they were.
    lid = states[-1]["lid"]
    assert float(lid.positions[2, 0]) < 0.8 * float(state["lid"].positions[2, 0])
    assert float(jnp.max(nodes(states[-1])[:, 2])) < float(lid.positions[2, 0])
    assert max(float(health.largest_violation) for health in flags) > 0.05
    record(
        "twelve rods of a nest pressed by a lid, friction 0.3: passages, in 50 times",
        "none",
        sum(through),
        at_most=0,
    )
    system, _ = pressed_nest(2.0)
    _, flags, _ = followed(system, states[-1], 0.1, 10, nodes)
    assert any(health.violation for health in flags)


@pytest.mark.slow
def test_a_rope_comes_to_lie_on_a_floor_and_on_itself(record):
    """A loop that is let fall: it bends over itself where it crosses."""
    radius, loop, n = 0.01, 0.1, 40
    turn = np.linspace(-1.0, 2 * np.pi + 1.0, n + 1)
    x, y = loop * 1.4 * np.sin(turn), loop * (1 - np.cos(turn))
    before, after = np.minimum(turn, 0), np.maximum(turn - 2 * np.pi, 0)
    x = np.where((before < 0) | (after > 0), 1.4 * loop * (before + after), x)
    y = np.where((before < 0) | (after > 0), 0 * x, y)
    # From below the crossing to above it, three radii higher.
    z = 0.02 + 3.0 * radius * np.clip(turn / (2 * np.pi), 0, 1)
    rod, state = jaxrod.rod_along(
        np.stack([x, y + 0.3 * np.abs(before + after) * loop, z]),
        radius=radius,
        density=1000.0,
        youngs_modulus=1e5,
        dtype=jnp.float64,
    )
    law = {"stiffness": 1e4, "damping": 10.0, "friction": 0.4}
    floor = jaxrod.contact(jaxrod.plane(), points_per_element=2, **law)
    scene = jaxrod.make_scene(
        rod, jaxrod.gravity((0.0, 0.0, -9.81)), floor, jaxrod.exponential_damping(1.0)
    )
    touch = jaxrod.rod_contact("rope", itself=True, points_per_element=4, **law)
    system = jaxrod.make_system({"rope": scene}, touch)
    nodes = lambda own: own["rope"].positions[None]
    states, flags, through = followed(system, {"rope": state}, 1.5, 30, nodes)
    assert not any(health.flagged for health in flags) and not any(through)
    energies = [float(jaxrod.kinetic_energy(system, own)) for own in states]
    record(
        "rope let fall on a floor and on itself, friction 0.4: kinetic energy left",
        "0, over the largest there was",
        energies[-1] / max(energies),
        at_most=1e-3,
    )
    heights = np.asarray(states[-1]["rope"].positions[2])
    sunk = float(rod.linear_density[0]) * 9.81 / law["stiffness"]
    # Most of it lies on the floor; where it crosses, one part lies on the other.
    record(
        "rope let fall on a floor and on itself: height of most of it, off by [radii]",
        "its radius, less by what its weight presses in",
        abs(float(np.median(heights)) - (radius - sunk)) / radius,
        at_most=0.05,
    )
    assert 2.7 * radius < np.max(heights) < 3.3 * radius
