"""An overhand knot in a rod: what pulls it tight, and that it stays tied."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from examples.loading import load
from systems.knots import closed, determinant

KNOT = load("knot")
LOOP = KNOT.LOOP


def unit_of_time(rod):
    """In which a loop of that size moves [s]."""
    bending, line = rod.bend_twist_stiffness[0, 0], rod.linear_density[0]
    return LOOP**2 / float(jnp.sqrt(bending / line))


def settled(system, state, dt, units, records=20):
    """Records of a run of so many units of time, the first state before them."""
    rod = system.members["rope"].rod
    every = int(units * unit_of_time(rod) / dt / records)
    path = jaxrod.rollout(system, state, dt, every * records, every)
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]),
        state["rope"],
        path["rope"],
    ), jax.tree.map(lambda leaf: leaf[-1], path)


def geometry(rod, state):
    """Strains of elements, curvatures of joints, joints of the loop, its radius [m].

    The loop is all around the middle that touches nothing; its radius is its length
    over the angle that it turns by.
    """
    nodes, rest = np.asarray(state.positions), float(rod.rest_lengths[0])
    lengths = np.linalg.norm(np.diff(nodes), axis=0)
    tangents = np.diff(nodes) / lengths
    turns = np.arccos(np.clip(np.sum(tangents[:, 1:] * tangents[:, :-1], 0), -1, 1))
    middles = 0.5 * (nodes[:, 1:] + nodes[:, :-1])
    apart = np.linalg.norm(middles[:, :, None] - middles[:, None], axis=0)
    number = np.arange(rod.n_elements)
    radius = float(rod.radii[0])
    near_along = np.abs(number[:, None] - number) * rest < 4 * np.pi * radius
    touches = np.min(np.where(near_along, 1.0, apart), axis=1) < 2.4 * radius
    middle = rod.n_elements // 2
    first = middle - np.argmax(touches[middle::-1]) + 1
    last = middle + np.argmax(touches[middle:]) - 1
    loop = (last - first) * rest / np.sum(turns[first:last])
    return lengths / rest - 1, 2 * np.tan(turns / 2) / rest, slice(first, last), loop


def is_tied(records):
    """Whether each record of a rod is a trefoil when closed far away."""
    return [
        determinant(closed(np.asarray(nodes), 10 * LOOP)) == 3
        for nodes in records.positions
    ]


def passages(records):
    """Whether the rod passed through itself between neighbouring records."""
    before, after = records.positions[:-1], records.positions[1:]
    return jax.jit(jax.vmap(jaxrod.topology.crossed))(before, after)


def test_knots_are_told_apart():
    """Of curves whose determinants are known, from any side; and mirrored."""
    t = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    torus = lambda p, q: np.stack(
        [
            (2 + np.cos(q * t)) * np.cos(p * t),
            (2 + np.cos(q * t)) * np.sin(p * t),
            -np.sin(q * t),
        ]
    )
    eight = np.stack(
        [
            (2 + np.cos(2 * t)) * np.cos(3 * t),
            (2 + np.cos(2 * t)) * np.sin(3 * t),
            np.sin(4 * t),
        ]
    )
    for curve, known in (
        (torus(1, 0), 1),
        (torus(1, 3), 1),
        (torus(2, 3), 3),
        (torus(2, 5), 5),
        (torus(2, 7), 7),
        (torus(3, 4), 3),
        (eight, 5),
    ):
        for seed in range(5):
            assert determinant(curve, seed) == known
            assert determinant(curve * np.array([[1], [1], [-1]]), seed) == known


@pytest.mark.slow
def test_the_pull_of_a_knot_without_friction(record):
    """Against the circle of Audoly, Clauvelin and Neukirch, and the exact invariant.

    Forces of contact are across the rod, so B kappa^2 / 2 plus tension is one number
    along it. A loop of a rod without thickness carries no force, so its pull is
    B / (2 R^2); one with thickness carries some, which turns with it, and its radius
    is the length of what is free of the loop over the angle that this turns by.
    """
    shares, thicknesses = [], []
    for n, ratio in ((160, 20), (240, 40)):
        system, state, dt = KNOT.build(n, LOOP / ratio)
        rod = system.members["rope"].rod
        records, after = settled(system, state, dt, 40)
        health = jaxrod.health(system, after, dt)
        assert not health.overflow and not health.stale and not health.violation
        assert not np.any(passages(records)) and all(is_tied(records))
        strains, curvatures, free, loop = geometry(rod, after["rope"])
        bending = float(rod.bend_twist_stiffness[0, 0])
        pull = bending / (2 * LOOP**2)
        # Speeds that are left are far below those of free waves.
        assert np.max(np.abs(after["rope"].velocities)) < 2e-3 * LOOP / unit_of_time(
            rod
        )
        stored = 0.5 * bending * curvatures**2
        tension = float(rod.shear_stretch_stiffness[2, 0]) * strains
        balance = stored + 0.5 * (tension[1:] + tension[:-1])
        record(
            f"overhand knot, {n} elements, loop of {ratio} radii: B kappa^2 / 2 and "
            "tension anywhere on the loop",
            "the pull, without friction",
            np.max(np.abs(balance[free] / pull - 1)),
            at_most=0.03,
        )
        shares.append(pull / (bending / (2 * loop**2)))
        thicknesses.append(float(rod.radii[0]) / loop)
    assert 20 < 1 / thicknesses[0] < 23 and 40 < 1 / thicknesses[1] < 44
    record(
        "overhand knot, loop of 42 radii: pull over B / (2 R^2)",
        "1, and 3 r / R more",
        shares[1],
        between=(1.0, 1.1),
    )
    slope = (shares[0] - shares[1]) / (thicknesses[0] - thicknesses[1])
    record(
        "overhand knot, loops of 22 and 42 radii: pull, extrapolated to a rod "
        "without thickness",
        "B / (2 R^2)",
        abs(shares[1] - slope * thicknesses[1] - 1),
        at_most=0.05,
    )


@pytest.mark.slow
def test_friction_holds_a_knot(record):
    """Pulled harder, it tightens less; let loose, it opens less."""
    system, state, dt = KNOT.build(120)
    rod = system.members["rope"].rod
    _, after = settled(system, state, dt, 30)
    start = float(jnp.mean(geometry(rod, after["rope"])[-1]))
    moved = {}
    for friction in (0.0, 0.1):
        for pull in (0.6, 1.5):
            other, _, dt = KNOT.build(120, pull=pull, friction=friction or None)
            records, end = settled(other, {"rope": after["rope"]}, dt, 15)
            assert not np.any(passages(records)) and all(is_tied(records))
            moved[friction, pull] = geometry(rod, end["rope"])[-1] - start
    assert moved[0.0, 1.5] < -0.1 * start and moved[0.0, 0.6] > 0.1 * start
    for pull, words in ((0.6, "pulled less"), (1.5, "pulled harder")):
        record(
            f"overhand knot {words}: change of its loop with friction 0.1",
            "less than without",
            moved[0.1, pull] / moved[0.0, pull],
            between=(0.0, 0.6),
        )


@pytest.mark.slow
def test_a_knot_that_is_torn_through_itself_is_noticed():
    """Contact too soft for the pull: flagged, found between records, and untied."""
    system, state, dt = KNOT.build(120, pull=400.0)
    records, _ = settled(system, state, dt, 2, records=80)
    at = jax.jit(jax.vmap(lambda own: jaxrod.health(system, {"rope": own}, dt)))
    health = at(records)
    tied, passed = is_tied(records), np.asarray(passages(records))
    assert tied[0] and not tied[-1]
    assert np.any(passed)
    # Nothing is untied before a passage has been found, and that is no surprise.
    through = int(np.flatnonzero(passed)[0])
    assert all(tied[: through + 1])
    assert np.any(np.asarray(health.flagged)[: through + 2])
