"""Systems as replays: every member, contact forces, colours; pictures and pages."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry import surfaces
from jaxrod.systems.stepping.assembly import seen_at_rest
from jaxrod.viz import Arrows, Mesh, Replay, html, save_html
from viz.browser import Browser
from viz.busy_system import busy_replay, busy_run
from viz.test_page import unpack


@pytest.fixture(scope="module")
def run():
    return busy_run()


@pytest.fixture(scope="module")
def replay(run):
    return busy_replay(run)


def by_name(parts):
    return {part.name: part for part in parts}


def turned(quaternion, vectors):
    w, axis = quaternion[0], quaternion[1:]
    cross = 2 * np.cross(axis, vectors)
    return vectors + w * cross + np.cross(axis, cross)


def test_several_equal_bodies_are_shown_each_in_its_place_in_every_frame():
    ball = jaxrod.shapes.sphere((0.0, 0.0, 0.0), 0.1)
    draws = np.random.default_rng(0)
    one = [jaxrod.systems.rigid_body(ball, density=1000.0) for _ in range(3)]
    bodies, state = jaxrod.systems.stacked_bodies(*one)
    system = jaxrod.make_system({"balls": bodies})
    frames = draws.normal(size=(5, 3, 3))
    turns = draws.normal(size=(5, 4, 3))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    states = {"balls": jax.tree.map(lambda x: jnp.stack([x] * 5), state)}
    states["balls"] = dataclasses.replace(
        states["balls"], positions=jnp.asarray(frames), orientations=jnp.asarray(turns)
    )
    (mesh,) = Replay.from_states(system, states, np.arange(5.0)).meshes
    for frame in range(5):
        for body in range(3):
            np.testing.assert_allclose(
                mesh.positions[frame, body], frames[frame, :, body], rtol=1e-6
            )
            # A quaternion and its opposite are the same orientation.
            alike = np.dot(mesh.orientations[frame, body], turns[frame, :, body])
            assert abs(alike) == pytest.approx(1, abs=1e-6)


@pytest.mark.slow
def test_every_member_is_there_where_its_states_are(run, replay):
    _, states, times = run
    rods = by_name(replay.rods)
    assert {name: r.positions.shape[1:] for name, r in rods.items()} == {
        "arm": (1, 11, 3),
        "hairs": (3, 7, 3),
    }
    np.testing.assert_array_equal(replay.times, times)
    where = np.moveaxis(np.asarray(states["hairs"].positions), -2, -1)
    np.testing.assert_array_equal(rods["hairs"].positions, where)
    meshes = by_name(replay.meshes)
    assert set(meshes) >= {"ball", "box", "capsule", "drum", "ring", "obstacle"}
    assert replay.floor == 0.0
    for name in ("ball", "box", "capsule", "drum", "ring"):
        np.testing.assert_allclose(
            meshes[name].positions[:, 0], np.asarray(states[name].positions)[:, :, 0]
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ball", "box", "capsule", "drum", "ring"])
def test_corners_of_moving_bodies_lie_on_their_surfaces(run, replay, name):
    system, states, _ = run
    mesh = by_name(replay.meshes)[name]
    shape = system.members[name].shape
    for frame in (0, -1):
        centre = np.asarray(states[name].positions)[frame, :, 0]
        turn = np.asarray(states[name].orientations)[frame, :, 0]
        back = turn * np.array([1, -1, -1, -1])
        placed = mesh.placed(frame, 0)
        own = turned(back, placed - centre)
        distance, _ = shape.surface(tuple(jnp.asarray(own.T)))
        assert np.abs(distance).max() < 1e-6


@pytest.mark.parametrize(
    ("triangles", "volume"),
    [
        (surfaces.ball(0.5), np.pi / 6),
        (surfaces.capsule(0.5, 0.2), np.pi * 0.04 * (1 + 0.8 / 3)),
        (surfaces.cylinder(0.5, 0.2), np.pi * 0.04),
        (surfaces.box(np.array([0.1, 0.2, 0.3])), 0.048),
    ],
    ids=["ball", "capsule", "cylinder", "box"],
)
def test_surfaces_are_closed_face_outwards_and_hold_their_volume(triangles, volume):
    vertices, faces = triangles
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert sorted(map(tuple, edges)) == sorted(map(tuple, edges[:, ::-1]))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    found = np.sum(a * np.cross(b, c)) / 6
    assert volume * 0.97 < found < volume * 1.0001


def test_a_signed_distance_becomes_a_closed_surface():
    def torus(points):
        across = np.hypot(points[:, 0], points[:, 1])
        ring = np.stack([points[:, 0], points[:, 1], 0 * across], -1) / across[:, None]
        away = points - 0.5 * ring
        size = np.linalg.norm(away, axis=1)
        return size - 0.2, away / size[:, None]

    low = np.array([-0.81, -0.83, -0.31])
    vertices, faces = surfaces.of_distance(torus, low, -low)
    assert np.abs(torus(vertices)[0]).max() < 1e-9
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert sorted(map(tuple, edges)) == sorted(map(tuple, edges[:, ::-1]))
    assert len(vertices) - len(edges) // 2 + len(faces) == 0  # a torus
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.sum(a * np.cross(b, c)) / 6 == pytest.approx(
        2 * np.pi**2 * 0.5 * 0.04, rel=0.02
    )
    with pytest.raises(ValueError, match="no surface between"):
        surfaces.of_distance(torus, low + 5, 5 - low)


@pytest.mark.slow
def test_contact_forces_hold_up_what_lies_on_the_ground():
    rod, state = jaxrod.straight_rod(
        8,
        length=0.4,
        radius=0.01,
        density=1000.0,
        youngs_modulus=1e6,
        start=(0.0, 0.0, 0.01),
        direction=(1.0, 0.0, 0.0),
    )
    ground = jaxrod.contact(
        jaxrod.shapes.plane((0, 0, 0), (0, 0, 1)), stiffness=1e4, damping=30.0
    )
    scene = jaxrod.make_scene(rod, jaxrod.gravity(), ground)
    dt = float(jaxrod.stable_dt(scene).dt)
    states = jaxrod.rollout(scene, state, dt, 4000, 2000)
    times = jaxrod.rollout_times(dt, 4000, 2000)
    replay = Replay.from_states(scene, states, times, forces=True)
    weight = 9.81 * float(np.sum(rod.node_masses))
    (arrows,) = replay.arrows
    total = arrows.vectors[-1].sum(axis=0)
    np.testing.assert_allclose(total, [0, 0, weight], atol=1e-3 * weight)
    assert replay.floor == 0.0


@pytest.mark.slow
def test_forces_between_rods_and_a_body_are_those_that_slow_the_body(run):
    system, states, times = run
    alone = jaxrod.make_system(
        {
            "hairs": _without_ground(system.members["hairs"]),
            "ball": system.members["ball"],
        },
        jaxrod.systems.body_contact("hairs", "ball", stiffness=5e3, damping=5.0),
    )
    only = {k: states[k] for k in ("hairs", "ball")}
    shown = Replay.from_states(alone, only, times, forces=True)
    assert shown.arrows[0].largest > 0.1
    for frame in range(len(times)):
        at_frame = {k: _at(states[k], frame) for k in ("hairs", "ball")}
        seen, (prepared,) = seen_at_rest(alone, at_frame)
        on_ball = np.stack(prepared.loads(seen)["ball"].forces)[:, 0]
        # Arrows too short to be drawn in any frame are left out: 2 % of the longest.
        np.testing.assert_allclose(
            shown.arrows[0].vectors[frame].sum(axis=0),
            -on_ball,
            atol=0.05 * shown.arrows[0].largest,
        )


def _at(state, frame):
    return jax.tree.map(lambda leaf: leaf[frame], state)


def _without_ground(scene):
    return dataclasses.replace(scene, effects=())


@pytest.mark.slow
def test_fields_are_numbers_of_states_at_nodes(run, replay):
    _, states, _ = run
    rods = by_name(replay.rods)
    speed = np.linalg.norm(np.asarray(states["hairs"].velocities), axis=-2)
    np.testing.assert_allclose(rods["hairs"].fields["speed [m/s]"], speed)
    assert "share [1]" not in rods["hairs"].fields
    share = rods["arm"].fields["share [1]"][0, 0]
    np.testing.assert_allclose(share[[0, 1, -1]], [0, 1 / 18, 1])
    assert replay.field_range("share [1]") == (0.0, pytest.approx(1.0))


@pytest.mark.slow
def test_fields_follow_schedules():
    rod, state = jaxrod.straight_rod(
        4, length=1.0, radius=0.02, density=1000.0, youngs_modulus=1e6
    )
    load = jaxrod.end_load(
        jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), duration=1.0)
    )
    scene = jaxrod.make_scene(rod, load)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), state)
    replay = Replay.from_states(
        scene,
        states,
        [0.0, 0.5, 1.0],
        fields={"load [N]": lambda scene, state: scene.effects[0].force[2]},
    )
    np.testing.assert_allclose(
        replay.rods[0].fields["load [N]"][:, 0, 0], [0.0, 1.0, 2.0], atol=1e-12
    )


@pytest.mark.slow
def test_the_page_holds_bodies_arrows_and_fields(replay):
    page = unpack(html(replay, frames_per_second=1000.0))
    header = page.header
    assert header["nodes"] == [11, 7, 7, 7]
    assert header["floor"] == 0.0
    points = [r.positions.reshape(21, -1, 3) for r in replay.rods]
    points += [m.positions for m in replay.meshes] + [replay.arrows[0].origins]
    truth = np.concatenate(points, axis=1)
    step = np.array(header["scales"][0]["step"])
    assert np.all(np.abs(page.positions - truth) <= 0.5001 * step)
    turns = np.concatenate([m.orientations for m in replay.meshes], axis=1)
    np.testing.assert_allclose(page.turns, turns, atol=2e-5)
    # No jump from q to -q, between which the page would pass through nothing.
    assert np.all(np.sum(page.turns[1:] * page.turns[:-1], axis=-1) > 0.5)
    assert np.linalg.norm(page.arrows, axis=-1).max() == pytest.approx(
        np.linalg.norm(np.subtract(*replay.bounds())) / 7, rel=1e-3
    )
    first, second = page.fields
    low, high = header["fields"][0]["range"]
    speed = replay.rods[0].fields["speed [m/s]"][:, 0].T
    shown = low + (high - low) * first[:11] / 254
    assert np.all(np.abs(shown - np.clip(speed, low, high)) <= (high - low) / 500)
    assert np.all(second[11:] == 255)
    corners = page.meshes[0].reshape(-1, 6)
    assert len(corners) == header["meshes"][0]["corners"]
    np.testing.assert_allclose(np.linalg.norm(corners[:, 3:], axis=1), 1, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"fields": {"a": {"leg": 1.0}}},
            r"fields\['a'\] names \['leg'\], which are no",
        ),
        ({"fields": {"a": {"arm": np.ones(5)}}}, r"fields\['a'\] must broadcast to"),
        ({"colours": {"arm": "red"}}, "\"#rrggbb\", got 'red'"),
        ({"colours": {"leg": "#ff0000"}}, "no member 'leg'; there are 'arm'"),
        ({"up": "w"}, "up must be"),
        ({"floor": np.nan}, "floor must be finite"),
    ],
)
def test_impossible_requests_are_refused_in_words(run, change, message):
    system, states, times = run
    with pytest.raises(ValueError, match=message):
        Replay.from_states(system, states, times, **change)


@pytest.mark.slow
def test_what_is_no_scene_is_refused(run):
    system, states, times = run
    with pytest.raises(TypeError, match="must be a scene or a system, got dict"):
        Replay.from_states({}, states, times)
    with pytest.raises(ValueError, match="states must have the members"):
        Replay.from_states(system, {"arm": states["arm"]}, times)


NODES = np.zeros((3, 2, 3)) + np.array([[0, 0, 0], [1, 0, 0]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"meshes": [Mesh(np.ones((3, 2)), [[0, 1, 2]])]}, r"vertices must have shape"),
        ({"meshes": [Mesh(np.eye(3), [[0, 1, 3]])]}, "must name corners from 0 to 2"),
        (
            {"meshes": [Mesh(np.eye(3), [[0, 1, 2]], orientations=(0, 0, 0, 0.0))]},
            "must be unit quaternions, got a zero",
        ),
        (
            {"meshes": [Mesh(np.eye(3), [[0, 1, 2]], np.zeros((2, 3)))]},
            "must have 3 frames, got 2",
        ),
        ({"arrows": [Arrows(0.0, np.zeros((3, 3)))]}, "vectors must have shape"),
        ({"colour": "<script>"}, "colour must be"),
    ],
)
def test_impossible_bodies_and_arrows_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Replay.from_nodes(NODES, 0.1, [0.0, 1.0, 2.0], **change)


def test_replays_put_together_keep_what_each_has():
    one = Replay.from_nodes(NODES, 0.1, [0.0, 1.0, 2.0], name="a", title="both")
    two = Replay.from_nodes(NODES[:, [0, 1, 1]] + 1, 0.1, one.times, name="b")
    both = one.together(two)
    assert [rods.name for rods in both.rods] == ["a", "b"]
    assert both.title == "both" and both.num_rods == 2
    with pytest.raises(ValueError, match="rods of 2 kinds"):
        _ = both.positions
    late = Replay.from_nodes(NODES, 0.1, [0.0, 1.0, 3.0])
    with pytest.raises(ValueError, match="must have the same times"):
        one.together(late)


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_draws_the_bodies_and_colours_by_a_field(chromium, replay, tmp_path):
    path = tmp_path / "busy.html"
    save_html(replay, path)
    with Browser(chromium) as browser:
        browser.look(width=900, height=600, dark=False)
        browser.open(path.as_uri())
        before = browser.picture().astype(int)
        yellow = (before[..., 0] - before[..., 2] > 60) & (before[..., 1] > 120)
        assert yellow.sum() > 500  # the ring and the ball
        browser.press("End")
        after = browser.picture().astype(int)
        assert (np.abs(after - before).max(axis=-1) > 40).sum() > 1000
        browser.run(
            "const c = document.querySelector('#colour'); c.value = 'field 0'; "
            "c.dispatchEvent(new Event('change'))"
        )
        coloured = browser.picture().astype(int)
        assert (np.abs(coloured - after).max(axis=-1) > 40).sum() > 500
        legend = browser.run("document.querySelector('#legend').innerText")
        assert "speed [m/s] 0 – " in legend and "contact force [N]" in legend
        assert "hairs" not in legend
        assert browser.errors == []
        assert browser.requests == [path.as_uri()]


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [jaxrod.systems.rod_contact, jaxrod.systems.crossing_contact]
)
@pytest.mark.parametrize("lists", [None, jaxrod.systems.neighbour_lists()])
def test_contact_between_rods_is_shown_with_lists_and_without(law, lists):
    """The record of lists that a run leaves among its states is no member."""

    def rod(height):
        rod, state = jaxrod.straight_rod(
            4,
            length=0.4,
            radius=0.02,
            density=1000.0,
            youngs_modulus=1e6,
            start=(0.0, 0.0, 0.0) if height == 0 else (0.2, -0.2, height),
            direction=(1.0, 0.0, 0.0) if height == 0 else (0.0, 1.0, 0.0),
        )
        return jaxrod.make_scene(rod), state

    (one, of_one), (two, of_two) = rod(0.0), rod(0.036)
    state = {"one": of_one, "two": of_two}
    contact = law("one", "two", stiffness=1e3, lists=lists)
    system = jaxrod.make_system({"one": one, "two": two}, contact, state=state)
    states = jaxrod.rollout(system, state, 1e-6, 2)
    assert ("neighbours" in states) == (lists is not None)
    times = jaxrod.rollout_times(1e-6, 2)
    shown = Replay.from_states(system, states, times, forces=True)
    assert {rods.name for rods in shown.rods} == {"one", "two"}
    seen, (prepared,) = seen_at_rest(system, state)
    push = np.sum(np.stack(prepared.loads(seen)["two"].forces), axis=1)
    assert push[2] > 0.05
    (arrows,) = shown.arrows
    on_two = arrows.origins[0][:, 2] > 0.03
    up = arrows.vectors[0][on_two, 2]
    # The shortest arrows are left out.
    assert np.sum(up) == pytest.approx(push[2], rel=0.05)
