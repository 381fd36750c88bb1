"""Contact between rods and of a rod with itself, by PyElastica's law and by ours.

Loads of two rods are compared at states that PyElastica's own contact leads through,
where no others act and without dashpots: `RodRodContact` also answers what presses rods
together, the pull of dashpots included, in the order in which it works forces out, and
`element_contact` does not. `RodSelfContact` has no such part.
"""

from dataclasses import replace

import elastica
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.plectoneme.element_contact import element_contact
from jaxrod.systems.stepping.assembly import seen_at_rest

N, LENGTH, RADIUS, DENSITY, YOUNG = 12, 0.5, 0.01, 1000.0, 1e6
STIFFNESS, DAMPING = 1e3, 0.5
DT, STATES, EVERY = 1e-4, 50, 2


class Simulator(elastica.BaseSystemCollection, elastica.Contact):
    """What contact needs of PyElastica."""


def their_rod(n, start, direction, velocity):
    """A rod of PyElastica's that moves as a whole."""
    rod = elastica.CosseratRod.straight_rod(
        n,
        np.array(start),
        np.array(direction),
        np.array([0.0, 0.0, 1.0]),
        LENGTH,
        RADIUS,
        DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 3,
    )
    rod.velocity_collection[:] = np.reshape(velocity, (3, 1))
    return rod


def our_rod(n, start, direction):
    """The same here."""
    return jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 3,
        start=start,
        direction=direction,
        normal=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )


def forces_of(contact, *rods):
    """Their forces on the nodes of rods where they are, with no others."""
    for rod in rods:
        rod.compute_internal_forces_and_torques(np.float64(0.0))
        rod.internal_forces[:] = 0.0
        rod.external_forces[:] = 0.0
    contact.apply_contact(rods[0], rods[-1])
    return [rod.external_forces.copy() for rod in rods]


@jax.jit
def our_forces(system, state, moved):
    """Forces of contact at places and velocities of the members' nodes."""
    there = {
        name: replace(state[name], positions=x, velocities=v)
        for name, (x, v) in moved.items()
    }
    seen, (contact,) = seen_at_rest(system, there)
    moving = {
        name: replace(one, motion=replace(one.motion, velocity=tuple(moved[name][1])))
        for name, one in seen.items()
    }
    return {name: jnp.stack(on.forces) for name, on in contact.loads(moving).items()}


ANGLES = {"parallel": (0.0, -0.004), "inclined by 30 degrees": (np.pi / 6, -0.1)}
"""Of the second rod, and how far its start is to the side of the first [m]."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ANGLES)
def test_loads_of_two_rods_that_collide(name, record):
    (angle, aside), n, m = ANGLES[name], N, 15
    places = (0.0, 0.0, 0.0), (0.013, aside, 2 * RADIUS - 1e-4)
    ways = (1.0, 0.0, 0.0), (np.cos(angle), np.sin(angle), 0.0)
    rods = [
        their_rod(n, places[0], ways[0], (0.0, 0.0, 0.1)),
        their_rod(m, places[1], ways[1], (0.1, 0.0, -0.4)),
    ]
    made = {
        "one": our_rod(n, places[0], ways[0]),
        "two": our_rod(m, places[1], ways[1]),
    }
    state = {key: own for key, (_, own) in made.items()}
    system = jaxrod.make_system(
        {
            key: jaxrod.make_scene(rod, method=jaxrod.pyelastica())
            for key, (rod, _) in made.items()
        },
        element_contact("one", "two", stiffness=STIFFNESS),
    )
    simulator = Simulator()
    for rod in rods:
        simulator.append(rod)
    contact = elastica.RodRodContact(k=STIFFNESS, nu=0.0)
    simulator.detect_contact_between(*rods).using(
        elastica.RodRodContact, k=STIFFNESS, nu=0.0
    )
    simulator.finalize()
    stepper, time = elastica.PositionVerlet(), np.float64(0.0)
    apart, largest, touched = 0.0, 0.0, 0
    for _ in range(STATES):
        for _ in range(EVERY):
            time = stepper.step(simulator, time, np.float64(DT))
        now = [(r.position_collection, r.velocity_collection) for r in rods]
        mine = our_forces(system, state, dict(zip(state, now, strict=True)))
        theirs = dict(zip(state, forces_of(contact, *rods), strict=True))
        for rod in rods:
            rod.external_forces[:] = 0.0
        for key, other in theirs.items():
            apart = max(apart, float(np.max(np.abs(mine[key] - other))))
            largest = max(largest, float(np.max(np.abs(other))))
        touched += np.any(theirs["one"] != 0)
    assert touched > 10 and largest > 0.05
    record(
        f"Forces of rods that collide, {name}, at {STATES} states, over the largest",
        "PyElastica 1.0, RodRodContact",
        apart / largest,
        at_most=1e-11,
    )


@pytest.mark.slow
def test_loads_of_a_rod_that_touches_itself(record):
    """Coils that press on each other, from their own places and at random speeds."""
    n, turns = 40, 3
    angle = np.linspace(0, 2 * np.pi * turns, n + 1)
    coil = LENGTH / (2 * np.pi * turns)
    rise = 1.9 * RADIUS * angle / (2 * np.pi)
    helix = np.stack([coil * np.cos(angle), coil * np.sin(angle), rise])
    rod, state = our_rod(n, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    system = jaxrod.make_system(
        {"one": jaxrod.make_scene(rod, method=jaxrod.pyelastica())},
        element_contact("one", stiffness=STIFFNESS, damping=DAMPING),
    )
    other = their_rod(n, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    contact = elastica.RodSelfContact(k=STIFFNESS, nu=DAMPING)
    random, apart, largest = np.random.default_rng(0), 0.0, 0.0
    for _ in range(STATES):
        places = helix + random.normal(scale=0.05 * RADIUS, size=helix.shape)
        speeds = random.normal(scale=0.3, size=helix.shape)
        other.position_collection[:], other.velocity_collection[:] = places, speeds
        (theirs,) = forces_of(contact, other)
        mine = our_forces(system, {"one": state}, {"one": (places, speeds)})["one"]
        apart = max(apart, float(np.max(np.abs(mine - theirs))))
        largest = max(largest, float(np.max(np.abs(theirs))))
    assert largest > 0.1
    record(
        f"Forces of a coil that touches itself, at {STATES} states, over the largest",
        "PyElastica 1.0, RodSelfContact",
        apart / largest,
        at_most=1e-11,
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("members", "numbers", "words"),
    [
        ((), {}, "one rod or two"),
        (("one", "one"), {}, "one rod or two"),
        (("one", "two", "three"), {}, "one rod or two"),
        (("one", "none"), {}, "no member is called 'none'"),
        (("one", "ball"), {}, "'ball' is rigid"),
        (("several",), {}, "'several' is several"),
        (("one",), {"stiffness": 0.0}, "stiffness must be positive"),
        (("one",), {"damping": -1.0}, "damping must be non-negative"),
        (("one",), {"pairs": 0}, "pairs must be at least 1"),
    ],
)
def test_bad_input(members, numbers, words):
    rod, _ = our_rod(2, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    scene = jaxrod.make_scene(rod)
    ball, _ = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0, 0, 1), 0.1), density=1.0, dtype=jnp.float64
    )
    several = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), scene)
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system(
            {"one": scene, "two": scene, "ball": ball, "several": several},
            element_contact(*members, **{"stiffness": 1.0} | numbers),
        )
