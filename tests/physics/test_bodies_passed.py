"""A rod that went through a body is flagged, and one that went around it is not."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import shapes
from jaxrod.contacts.passages import passed

DT, RADIUS = 1e-4, 0.02


def distance_from(point, radius):
    return jnp.sqrt(jnp.sum(point**2) + 1e-12) - radius


def block_of_grid():
    """A block of 20 cm, 10 cm and 2 cm as a table of distances."""
    block = shapes.box((0.0, 0.0, 0.0), (0.1, 0.05, 0.01))
    axes = [np.arange(-h, h + 1e-9, 0.01) for h in (0.15, 0.1, 0.06)]
    places = np.meshgrid(*axes, indexing="ij")
    distances, _ = block.surface(tuple(jnp.ravel(jnp.asarray(p)) for p in places))
    values = np.asarray(distances).reshape(places[0].shape)
    return shapes.signed_distance_grid(values, 0.01, (-0.15, -0.1, -0.06))


BODIES = {
    "sphere": shapes.sphere((0.0, 0.0, 0.0), 0.1),
    "capsule": shapes.capsule((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), 0.05),
    "cylinder": shapes.cylinder((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), 0.05),
    "wire": shapes.cylinder((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), 1e-4),
    "box": shapes.box((0.0, 0.0, 0.0), (0.5, 0.5, 0.05)),
    "sheet": shapes.box((0.0, 0.0, 0.0), (0.5, 0.5, 1e-6)),
    "wall of a pipe": shapes.pipe((0, -1, -0.3), (0, 1, -0.3), 0.25, thickness=0.05),
    "function": shapes.signed_distance(distance_from, 0.1),
    "grid": block_of_grid(),
}


def of_points(body, *ways):
    """Whether points went through a body, each from a place to another."""
    before, after = (tuple(jnp.asarray(x, float).T) for x in zip(*ways, strict=True))
    return passed(body.surface, jnp.full(len(ways), RADIUS), before, after).tolist()


@pytest.mark.fast_sets(3)
@pytest.mark.parametrize("name", BODIES)
def test_a_point_that_crosses_a_body_counts_and_one_that_turns_back_does_not(name):
    above, below, inside = (0.004, 0.0, 0.14), (0.003, 0.0, -0.12), (0.004, 0.0, 0.004)
    beside, back = (0.003, 0.04, 0.13), (0.004, 0.0, 0.13)
    ways = [(above, below), (below, above), (above, beside), (above, inside)]
    found = of_points(BODIES[name], *ways, (inside, back))
    assert found == [True, True, False, False, False]


def test_a_half_space_has_no_other_side_and_a_bore_can_be_crossed():
    floor = shapes.plane((0.0, 0.0, 0.0))
    bore = shapes.pipe((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), 0.05, thickness=0.01)
    for body, heights in ((floor, (0.5, 0.1)), (bore, (0.045, 0.03))):
        ways = [((0, 0, s * z), (0, 0, -s * z)) for z in heights for s in (1, -1)]
        assert not any(of_points(body, *ways))


def test_a_way_around_a_post_or_over_an_edge_is_no_passage():
    """Chords of less than a right angle of the places where a rod touches."""
    out = 0.05 + 0.9 * RADIUS
    turns = np.deg2rad([10, 80, -60, 175])
    around = [(out * np.sin(turn), 0.0, out * np.cos(turn)) for turn in turns]
    ways = [((0.0, 0.0, out), there) for there in around]
    assert of_points(BODIES["cylinder"], *ways) == [False, False, False, True]
    top, side = (0.48, 0.0, 0.05 + RADIUS), (0.5 + RADIUS, 0.0, 0.02)
    assert not any(of_points(BODIES["box"], (top, side), (side, top)))


def fallen(scene, state, way):
    there = replace(state, positions=state.positions.at[2].add(-way))
    return jaxrod.health(scene, there, DT, before=state)


def lying():
    """A metre along x, whose nodes are 12.5 cm apart."""
    given = {"length": 1.0, "radius": RADIUS, "density": 1000.0, "youngs_modulus": 1e6}
    return jaxrod.straight_rod(
        8, start=(-0.51, 0.0, 0.14), direction=(1, 0, 0), **given
    )


def test_health_of_a_scene_counts_the_points_that_went_through_its_bodies():
    """Also where a thin post is between the nodes, and among many bodies."""
    rod, state = lying()
    posts = jax.vmap(lambda x: shapes.capsule((x, -1, 0), (x, 1, 0), 0.11))
    several = jaxrod.contact(posts(jnp.asarray([0.0525, 2.0, 0.39])), stiffness=1e4)
    post = shapes.capsule((0.0525, -1.0, 0.0), (0.0525, 1.0, 0.0), 0.11)
    still = jaxrod.contact(post, stiffness=1e4)
    moving = jaxrod.moving_contact(still, displacement=(0.01, 0.0, 0.0))
    for touch, count in ((still, 3), (several, 5), (moving, 3)):
        scene = jaxrod.make_scene(rod, touch).at(0.0)
        found = fallen(scene, state, 0.3)
        assert found.passages == count and found.passed and found.flagged
        assert found.largest_violation == 0
        (line,) = found.faults
        assert f"{count} points of the rod went through" in line and "[N/m^2]" in line
        assert not fallen(scene, state, 0.015).flagged
    # Impaled between two nodes: points between contact points are examined, too.
    deep = fallen(jaxrod.make_scene(rod, still), state, 0.14)
    np.testing.assert_allclose(deep.largest_violation, 1 + 0.11 / RADIUS, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [10.0, None])
def test_a_rod_dropped_on_a_block_is_flagged_if_its_contact_is_too_soft(stiffness):
    rod, state = lying()
    block = jaxrod.contact(
        shapes.box((0.0, 0.0, 0.0), (1, 1, 0.12)), stiffness=stiffness
    )
    effects = jaxrod.gravity(), block
    if stiffness is not None:
        with pytest.warns(jaxrod.UnlikelyWarning, match="cannot carry the rod"):
            scene = jaxrod.make_scene(rod, *effects)
    else:
        scene = jaxrod.make_scene(rod, *effects)
    dt = jaxrod.stable_dt(scene).dt
    after = jaxrod.advance(scene, state, dt, int(0.5 / dt))
    assert (after.positions[2].max() < -0.5) == (stiffness is not None)
    assert not jaxrod.health(scene, after, dt).flagged
    found = jaxrod.health(scene, after, dt, before=state)
    assert found.passed == found.flagged == (stiffness is not None)


@pytest.mark.slow
def test_health_of_a_system_counts_passages_of_members_through_bodies():
    """A fixed one of a member, of equal members, and a rigid body that moves."""
    rod, state = lying()
    sheet = jaxrod.contact(shapes.box((0.0, 0.0, 0.0), (1, 1, 0.12)), stiffness=1e4)
    ball, there = jaxrod.systems.rigid_body(
        shapes.sphere((0.0, 0.0, 0.5), 0.1), density=1000.0
    )
    touch = jaxrod.systems.body_contact("rod", "ball", stiffness=1e4)
    system = jaxrod.make_system(
        {"rod": jaxrod.make_scene(rod, sheet), "ball": ball}, touch
    )
    before = {"rod": state, "ball": there}
    down = replace(there, positions=there.positions.at[2].add(-0.7))
    sunk = replace(state, positions=state.positions.at[2].add(-0.28))
    found = jaxrod.health(system, {"rod": state, "ball": down}, DT, before=before)
    assert found.passed and found.passages["'ball' and 'rod'"] > 3
    assert found.passages["'rod' and fixed bodies"] == 0
    found = jaxrod.health(system, {"rod": sunk, "ball": there}, DT, before=before)
    assert found.passed and found.passages["'rod' and fixed bodies"] == 17
    assert found.faults == ("'rod' and fixed bodies passed through each other: 17",)
    assert not jaxrod.health(system, before, DT, before=before).flagged


def test_health_is_printed_in_one_line_or_one_for_each_flag():
    rod, state = lying()
    scene = jaxrod.make_scene(rod)
    well = jaxrod.health(scene, state, DT)
    assert str(well) == "Health(no flags; stretch 1 to 1, violation 0 radii)"
    longer = replace(state, positions=3.0 * state.positions)
    wrong = jaxrod.health(scene, longer, 1.0)
    title, *lines = str(wrong).splitlines()
    assert title == "Health, flags: 1" and wrong.faults == (lines[0].strip(),)
    assert "3 times their length at rest" in lines[0]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), well, wrong, wrong)
    assert str(both).splitlines() == ["Health, flags: 1", "  stretch: 2 of 3 states"]


@pytest.mark.slow
def test_health_of_a_system_is_printed_in_one_line():
    rod, state = lying()
    system = jaxrod.make_system({"rod": jaxrod.make_scene(rod)})
    text = str(jaxrod.health(system, {"rod": state}, DT))
    assert text == "SystemHealth(no flags; members 1, violation 0 radii)"
