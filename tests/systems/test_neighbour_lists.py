"""Lists of neighbours: the same as without, and flags where they may not be."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import rod

RADIUS, ELEMENT = 0.02, 0.08
LAWS = {
    "line": (jaxrod.systems.rod_contact, {"stiffness": 2e3, "damping": 1.0}),
    "crossing": (
        jaxrod.systems.crossing_contact,
        {"stiffness": 100.0, "damping": 0.05},
    ),
}


def heap(count=12, n=4, seed=0, dtype=jnp.float64, speed=0.2):
    """Equal rods that fly about in a small box, and their state."""
    random = np.random.default_rng(seed)
    edge = (count * n * ELEMENT * RADIUS**2 * np.pi / 0.12) ** (1 / 3)
    starts = jnp.asarray(random.uniform(0, edge, (count, 3)), dtype)
    ways = random.normal(size=(count, 3))
    ways = jnp.asarray(ways / np.linalg.norm(ways, axis=1)[:, None], dtype)

    def one(start, way):
        made, state = jaxrod.straight_rod(
            n,
            length=n * ELEMENT,
            radius=RADIUS,
            density=1000.0,
            youngs_modulus=1e5,
            start=start,
            direction=way,
            dtype=dtype,
        )
        return jaxrod.make_scene(made), state

    scenes, state = jax.vmap(one)(starts, ways)
    kicks = jnp.asarray(speed * random.normal(size=(count, 3, 1)), dtype)
    return scenes, replace(state, velocities=state.velocities + kicks)


def system_of(scenes, state, law="crossing", lists=None, **changes):
    """The heap with contact."""
    factory, numbers = LAWS[law]
    points = {"points_per_element": 4} if law == "line" else {}
    contact = factory("rods", **numbers | points | changes, lists=lists)
    return jaxrod.make_system({"rods": scenes}, contact, state={"rods": state})


def difference(a, b):
    """Largest difference of two states' positions and velocities."""
    return max(
        float(jnp.max(jnp.abs(getattr(a["rods"], k) - getattr(b["rods"], k))))
        for k in ("positions", "velocities")
    )


@pytest.mark.slow
@pytest.mark.parametrize("law", ["line", "crossing"])
def test_runs_are_those_without_lists(law, record):
    """A heap of rods that collide with friction, over all pairs and with a grid."""
    scenes, state = heap(seed=3)
    dense = system_of(scenes, state, law, friction=0.3)
    dt = 0.3 * jaxrod.stable_dt(dense).dt
    without = jaxrod.advance(dense, {"rods": state}, dt, 300)
    assert set(without) == {"rods"}
    for cells in (0, None):
        lists = jaxrod.systems.neighbour_lists(
            refresh_every=8, skin=1.0, cell_slots=cells
        )
        listed = system_of(scenes, state, law, lists, friction=0.3)
        if cells is None:
            wide = replace(listed.couplings[0].lists, cell_slots=40)
            contact = replace(listed.couplings[0], lists=wide)
            listed = replace(listed, couplings=(contact,))
        after = jaxrod.advance(listed, {"rods": state}, dt, 300)
        assert not jaxrod.health(listed, after, dt).overflow
        assert not jaxrod.health(listed, after, dt).stale
        assert float(after["neighbours"].used) > 5
        record(
            f"{law} law with lists of neighbours, 300 steps",
            "the same without lists",
            difference(after, without),
            at_most=1e-12,
        )
        energies = [s.total_energy(after) for s in (listed, listed)]
        plain = dense.total_energy({"rods": after["rods"]})
        assert float(energies[0]) == pytest.approx(float(plain), rel=1e-13)
    assert difference(without, {"rods": state}) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("law", ["line", "crossing"])
@pytest.mark.parametrize("end", ["base", "tip"])
def test_loads_of_rods_on_themselves_and_tied_together(law, end):
    """Near along rods and near ties nothing touches, from lists as without.

    Tied at two starts, and where one rod goes on in the other, under a third.
    """
    arc = np.linspace(0, np.pi, 9)
    r = 0.9 * RADIUS
    legs = np.linspace(0.15, 0, 6)[:-1]
    x = np.concatenate([legs, -r * np.sin(arc), legs[::-1]])
    y = np.concatenate([np.full(5, r), r * np.cos(arc), np.full(5, -r)])
    nodes = np.stack([x, y, np.zeros_like(x)])
    hairpin, bent = jaxrod.rod_along(
        nodes, radius=RADIUS, density=1e3, youngs_modulus=1e6, dtype=jnp.float64
    )
    side = r if end == "base" else -r
    other, straight = rod(6, 0.3, (0.15, side, 0.0), (0.2, side / r, 0.3))
    third, across = rod(5, 0.3, (0.16, -0.1, 0.036), (0, 1, 0))
    state = {"one": bent, "two": straight, "three": across}
    members = {
        "one": jaxrod.make_scene(hairpin),
        "two": jaxrod.make_scene(other),
        "three": jaxrod.make_scene(third),
    }
    factory, numbers = LAWS[law]
    tie = jaxrod.systems.tie(("one", end), ("two", "base"), state)
    found = []
    for lists in (None, jaxrod.systems.neighbour_lists()):
        contact = factory(*members, **numbers, self_contact=True, lists=lists)
        system = jaxrod.make_system(members, contact, tie, state=state)
        seen, couplings = jax.jit(seen_at_rest)(system, state)
        found.append(jax.jit(lambda c, s: c.loads(s))(couplings[0], seen))
    for name in members:
        dense, listed = (np.stack(loads[name].forces) for loads in found)
        assert np.max(np.abs(dense)) > 0.05
        np.testing.assert_allclose(listed, dense, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_flags_rise_when_lists_are_too_short_or_too_old(record):
    """Sticky, named, and only where forced; energies are then no number."""
    scenes, state = heap(seed=3)
    roomy = {"pairs": 200, "candidates": 900, "cell_slots": 0, "refresh_every": 4}
    first = {"rods": state}
    raised = 0
    for change, flag in (
        ({}, None),
        ({"pairs": 3}, "overflow"),
        ({"candidates": 20}, "overflow"),
        ({"cell_slots": 1}, "overflow"),
        ({"refresh_every": 1000}, "stale"),
        ({"skin": 1e-3}, "stale"),
    ):
        settings = {"skin": 0.5} | roomy | change
        lists = jaxrod.systems.neighbour_lists(**settings)
        system = system_of(scenes, state, lists=lists)
        dt = 0.3 * jaxrod.stable_dt(system).dt
        after = jaxrod.advance(system, first, dt, 100)
        health = jaxrod.health(system, after, dt)
        for name in ("overflow", "stale"):
            assert bool(getattr(health, name)) == (name == flag), (change, name)
        assert bool(health.flagged) or flag is None
        assert bool(jnp.isnan(system.potential_energy(after))) == (flag == "overflow")
        raised += flag is not None
        if flag == "stale":
            # It stays, though the lists of one more step are young enough.
            again = jaxrod.advance(system, after, 1e-9, 1)
            assert jaxrod.health(system, again, dt).stale
            fresh = jaxrod.advance(system, {"rods": after["rods"]}, 1e-9, 1)
            assert not jaxrod.health(system, fresh, dt).stale
    record("flags of lists too short or too old", "forced 5 times", raised, at_most=5)
    assert raised == 5


@pytest.mark.slow
def test_a_fast_rod_makes_lists_old():
    """Twice as fast as half the skin in the time between lists."""
    scenes, state = heap(4, speed=0.0)
    lists = jaxrod.systems.neighbour_lists(refresh_every=10, skin=0.5)
    system, dt = system_of(scenes, state, lists=lists), 1e-5
    half = 0.25 * RADIUS
    for factor in (0.8, 1.2):
        # After the search nine more drifts are seen. Places on smooth axes are moved by
        # up to 1.17 times as much as a node.
        moving = state.velocities.at[1, 0].add(factor * half / (9 * dt))
        first = {"rods": replace(state, velocities=moving)}
        after = jaxrod.advance(system, first, dt, 10)
        assert bool(after["neighbours"].stale) == (factor > 1)
        assert 0.98 * factor < float(after["neighbours"].moved) < 1.2 * factor


@pytest.mark.slow
@pytest.mark.parametrize("spread", [False, True], ids=["heap", "rods far away"])
def test_nothing_is_missed_by_the_grid(spread):
    """Against all pairs; rods far away put all others beyond the grid's end."""
    scenes, state = heap(30, 5, seed=1)
    first = {"rods": state}
    if spread:
        far = state.positions.at[3].add(1e5).at[4].add(jnp.array([[-1e5], [0], [0]]))
        far = far.at[5].set(far[3] + 0.5 * RADIUS)
        first = {"rods": replace(state, positions=far)}
    sets = []
    for cells in (0, 200):
        lists = jaxrod.systems.neighbour_lists(
            pairs=3000, candidates=9000, cell_slots=cells
        )
        system = system_of(scenes, state, lists=lists)
        _, (contact,) = jax.jit(seen_at_rest)(system, first)
        (found,) = contact.found.lists
        assert float(contact.found.missed) <= 0
        taken = np.asarray(found.there)
        sets.append(
            set(
                zip(
                    np.asarray(found.own)[taken].tolist(),
                    np.asarray(found.other)[taken].tolist(),
                    strict=True,
                )
            )
        )
    assert len(sets[0]) > 50
    assert spread == any(15 <= a < 20 and 25 <= b < 30 for a, b in sets[0])
    assert sets[0] == sets[1]


@pytest.mark.slow
def test_many_systems_at_once_are_stepped_one_after_another():
    scenes, state = heap(5, seed=3)
    system = system_of(
        scenes, state, lists=jaxrod.systems.neighbour_lists(refresh_every=5)
    )
    dt = 0.2 * jaxrod.stable_dt(system).dt

    def run(speed):
        moving = replace(state, velocities=speed * state.velocities)
        return jaxrod.advance(system, {"rods": moving}, dt, 40)

    speeds = jnp.array([0.5, 1.0])
    together = jax.vmap(run)(speeds)
    for k, speed in enumerate(speeds):
        one = run(speed)
        assert (
            difference(jax.tree.map(lambda leaf, k=k: leaf[k], together), one) < 1e-13
        )
    # So blocks that hold nothing stay branches.
    text = str(jax.make_jaxpr(jax.vmap(run))(speeds))
    assert "jaxrod_one_by_one" in text


@pytest.mark.slow
@pytest.mark.parametrize("law", ["line", "crossing"])
def test_gradients_are_those_without_lists(law, record):
    scenes, state = heap(5, 3, seed=3)
    lists = jaxrod.systems.neighbour_lists(refresh_every=7, skin=1.0, cell_slots=30)
    dense = system_of(scenes, state, law, friction=0.3)
    listed = system_of(scenes, state, law, lists, friction=0.3)
    dt = 0.3 * jaxrod.stable_dt(dense).dt
    weights = jax.random.normal(jax.random.key(1), state.positions.shape)

    def ended(speed, system):
        moving = replace(state, velocities=speed * state.velocities)
        after = jaxrod.advance(system, {"rods": moving}, dt, 100)
        return jnp.sum(weights * after["rods"].positions)

    slope = jax.jit(jax.grad(ended))
    with_lists, without = (float(slope(1.0, s)) for s in (listed, dense))
    assert with_lists == pytest.approx(without, rel=1e-10)
    h = 1e-6
    value = jax.jit(ended)
    ahead, back = (float(value(1.0 + k * h, listed)) for k in (1, -1))
    record(
        f"{law} law with lists, gradient of 100 steps",
        "central differences",
        abs(with_lists / ((ahead - back) / (2 * h)) - 1),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_moved_away_from_the_origin_all_is_the_same():
    scenes, state = heap(6, seed=3)
    system = system_of(
        scenes, state, lists=jaxrod.systems.neighbour_lists(refresh_every=5)
    )
    dt = 0.3 * jaxrod.stable_dt(system).dt
    shift = jnp.array([[[3.0], [-2.0], [5.0]]])
    away = replace(state, positions=state.positions + shift)
    here = jaxrod.advance(system, {"rods": state}, dt, 100)["rods"]
    there = jaxrod.advance(system, {"rods": away}, dt, 100)["rods"]
    np.testing.assert_allclose(
        there.positions - shift, here.positions, rtol=0, atol=1e-11
    )


@pytest.mark.slow
def test_in_single_precision_and_with_schedules():
    """Types stay as they are; gravity that changes; recorded runs."""
    scenes, state = heap(6, dtype=jnp.float32)
    rising = jaxrod.gravity(
        jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, -9.81), 0.01)
    )
    falling = jax.vmap(lambda s: jaxrod.make_scene(s.rod, rising))(scenes)
    lists = jaxrod.systems.neighbour_lists(refresh_every=3)
    system = system_of(falling, state, lists=lists)
    dt = 0.3 * jaxrod.stable_dt(system).dt
    path = jaxrod.rollout(system, {"rods": state}, dt, 20, every=5)
    assert path["rods"].positions.shape[0] == 5
    assert {leaf.dtype for leaf in jax.tree.leaves(path)} == {jnp.dtype("float32")}
    assert path["neighbours"].used.shape == (5,)
    after = jaxrod.advance(system, {"rods": state}, dt, 20)
    np.testing.assert_allclose(
        path["rods"].positions[-1], after["rods"].positions, rtol=0, atol=1e-6
    )


@pytest.mark.slow
def test_counted_neighbours_and_sizes():
    scenes, state = heap(8, seed=3)
    system = system_of(scenes, state, lists=jaxrod.systems.neighbour_lists())
    (near,) = jaxrod.systems.neighbours(system, {"rods": state})
    assert near.members == (("rods", "rods"),)
    assert system.couplings[0].lists.pairs[0] >= 1.5 * near.pairs[0] > 0
    assert 0.2 < near.occupancy < 0.7
    assert near.suggested.pairs == system.couplings[0].lists.pairs


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"skin": 0.0}, "skin must be positive"),
        ({"refresh_every": 0}, "refresh_every must be at least 1"),
        ({"pairs": 0}, "pairs must be at least 1"),
        ({"candidates": -1}, "candidates must be at least 1"),
        ({"cell_slots": -1}, "cell_slots must be at least 0"),
    ],
)
def test_bad_input(options, words):
    with pytest.raises(ValueError, match=words):
        jaxrod.systems.neighbour_lists(**options)


def test_reserved_name_and_record_of_another_kind():
    scene, state = jaxrod.make_scene(rod(3, 0.3)[0]), rod(3, 0.3)[1]
    lists = jaxrod.systems.neighbour_lists(pairs=9, candidates=9, cell_slots=0)
    contact = {"stiffness": 1.0, "lists": lists}
    with pytest.raises(ValueError, match="no member can be called 'neighbours'"):
        jaxrod.make_system(
            {"a": scene, "neighbours": scene},
            jaxrod.systems.crossing_contact("a", "neighbours", **contact),
        )
    system = jaxrod.make_system(
        {"a": scene, "b": scene}, jaxrod.systems.crossing_contact("a", "b", **contact)
    )
    unsized = {"stiffness": 1e4, "lists": jaxrod.systems.neighbour_lists()}

    @jax.jit
    def counted(stiffness):
        contact = {**unsized, "stiffness": stiffness}
        joined = jaxrod.systems.crossing_contact("a", "b", **contact)
        both = {"a": state, "b": state}
        jaxrod.make_system({"a": scene, "b": scene}, joined, state=both)
        return stiffness

    with pytest.raises(ValueError, match="numbers of the contact are traced: give nei"):
        counted(1e4)
    with pytest.raises(TypeError, match="leave it out to start again"):
        jaxrod.advance(system, {"a": state, "b": state, "neighbours": 1.0}, 1e-5, 1)
    without = jaxrod.make_system(
        {"a": scene, "b": scene},
        jaxrod.systems.crossing_contact("a", "b", stiffness=1.0),
    )
    with pytest.raises(ValueError, match="must have the members"):
        jaxrod.advance(without, {"a": state, "b": state, "neighbours": 1.0}, 1e-5, 1)


@pytest.mark.slow
def test_lists_are_counted_where_a_rod_is_driven():
    """Supports that move hold what they hold at the beginning."""
    one, of_one = rod(4, 0.4)
    two, of_two = rod(4, 0.4, (0.1, -0.2, 0.041), (0, 1, 0))
    state = {"one": of_one, "two": of_two}
    down = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, -0.01), 0.1)
    scenes = {
        "one": jaxrod.make_scene(one, jaxrod.clamp(of_one)),
        "two": jaxrod.make_scene(two, jaxrod.driven(of_two, displacement=down)),
    }

    def after(lists):
        contact = jaxrod.systems.crossing_contact(
            "one", "two", stiffness=1e3, lists=lists
        )
        system = jaxrod.make_system(scenes, contact, state=state)
        dt = jaxrod.stable_dt(system).dt
        return jaxrod.advance(system, state, dt, 100)["one"].positions

    dense = after(None)
    assert np.max(np.abs(dense - of_one.positions)) > 1e-6
    listed = after(jaxrod.systems.neighbour_lists(refresh_every=4, skin=1.0))
    np.testing.assert_allclose(listed, dense, rtol=0, atol=1e-13)


def test_a_list_is_old_once_a_node_has_moved_by_half_the_skin():
    scenes, state = heap(2, n=2, speed=0.0)
    skin = 0.5
    lists = jaxrod.systems.neighbour_lists(skin=skin)
    system = system_of(scenes, state, law="line", lists=lists)

    @jax.jit
    def moved(far):
        _, (contact,) = seen_at_rest(system, {"rods": state})
        there = replace(state, positions=state.positions.at[1, 2, 1].add(far))
        later, _ = seen_at_rest(system, {"rods": there})
        return contact.moved(later)

    half = 0.5 * skin * RADIUS
    for far in (0.0, 0.3 * half, -1.7 * half):
        np.testing.assert_allclose(moved(far), abs(far) / half, rtol=1e-12)


@pytest.mark.slow
def test_rods_near_each_other_are_found_wherever_they_are():
    found = []
    for x in (0.0, 20.0):
        law = {"length": 1.0, "radius": 0.02, "density": 1e3, "youngs_modulus": 1e6}
        one = jaxrod.straight_rod(6, start=(x, 0, 0), direction=(1, 0, 0), **law)
        two = jaxrod.straight_rod(
            6, start=(x + 0.5, -0.5, 0.03), direction=(0, 1, 0), **law
        )
        members = {"one": jaxrod.make_scene(one[0]), "two": jaxrod.make_scene(two[0])}
        contact = jaxrod.systems.rod_contact(
            "one", "two", stiffness=1e3, lists=jaxrod.systems.neighbour_lists()
        )
        state = {"one": one[1], "two": two[1]}
        system = jaxrod.make_system(members, contact, state=state)
        (near,) = jaxrod.systems.neighbours(system, state)
        found.append(near.pairs)
    assert found[0][0] >= 4
    assert found[1] == found[0]
