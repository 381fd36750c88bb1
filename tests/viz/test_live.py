"""The live page without a browser: it simulates as `advance` does."""

import json
import math
import re
import socket
import time
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import replace

import jax
import jax.numpy as jnp
import nbclient
import nbformat
import numpy as np
import pytest

import jaxrod
from jaxrod import extend, viz

N, LENGTH, RADIUS, YOUNG, DENSITY = 6, 0.3, 0.01, 1e6, 1000.0
POINT = (0.1, 0.02, 0.25)


@extend.pytree
class Rubber(extend.Effect):
    """A force k (p - x) on the tip."""

    stiffness: extend.Leaf
    point: extend.Leaf

    def loads(self, rod, motion):
        parts = zip(self.point, motion.position, strict=True)
        forces = [
            jnp.zeros_like(x).at[-1].set(self.stiffness * (p - x[-1])) for p, x in parts
        ]
        return extend.Loads(forces=tuple(forces))


def arm():
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNG,
        direction=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    load = jaxrod.end_load((0.0, 0.0, 0.0))
    effects = jaxrod.clamp(state), load, jaxrod.exponential_damping(4.0)
    return jaxrod.make_scene(rod, *effects), state


def towards(scene, state, values):
    """A law: a force along y as far as the goal is there, less where the arm is."""
    share = values["goal"][1] / (1 + state.tip[1] ** 2)
    force = jnp.zeros(3).at[1].set(0.05 * share)
    old = scene.effects[1]
    return replace(
        scene,
        effects=(
            scene.effects[0],
            replace(old, force=old.force + force),
            scene.effects[2],
        ),
    )


@pytest.fixture(scope="module")
def page():
    scene, state = arm()
    controls = {
        "load [N]": viz.Slider(lambda scene: scene.effects[1].force[0], -0.1, 0.1),
        "goal": viz.Target(None, 0.01, (0.1, 0.0, 0.2)),
    }
    with viz.live(scene, state, controls, law=towards, title="Arm") as page:
        yield page


def begun(page, **command):
    """Starts again with a command, and returns a picture some time later."""
    still = {"paused": True, "reset": True, "pull": None} | command
    number = page.do(still | {"set": {"load [N]": 0, "goal": [0.1, 0, 0.2]}})
    after(page, number)
    return after(page, page.do({"paused": False} | command), 0.1)


def after(page, command, elapsed=0.0):
    """The first picture that shows a command, and a simulated time."""
    picture = page.picture()
    while picture["heard"] < command or picture["time"] < elapsed:
        picture = page.picture(picture["number"])
    return picture


def same(picture, scene, state, dt):
    wanted = jaxrod.advance(scene, state, dt, round(picture["time"] / dt))
    np.testing.assert_allclose(
        picture["points"][: N + 1], wanted.positions.T, rtol=0, atol=2e-7
    )


def test_a_pull_is_the_force_of_a_spring_to_the_hand(page):
    scene, state = arm()
    picture = begun(page, pull={"node": N, "point": POINT})
    bending = YOUNG * math.pi * RADIUS**4 / 4
    weight = 9.81 * DENSITY * math.pi * RADIUS**2 * LENGTH
    stiffness = 10 * (3 * bending / LENGTH**3 + weight / LENGTH)
    rubber = Rubber(jnp.asarray(stiffness), jnp.asarray(POINT))
    same(picture, scene.with_effect(rubber), state, page.dt)
    moved = np.linalg.norm(picture["points"][N] - [0, 0, LENGTH])
    assert moved > 0.02
    gap = np.linalg.norm(picture["points"][N] - POINT)
    assert picture["force"] == pytest.approx(stiffness * gap, rel=1e-4)
    # Let go, it is free again.
    assert after(page, page.do({"pull": None}))["force"] == 0


def test_a_slider_sets_the_numbers_it_selects_and_no_others(page):
    scene, state = arm()
    picture = begun(page, set={"load [N]": 0.03})
    assert picture["values"].tolist() == [0.03, 0.1, 0.0, 0.2]
    load = jaxrod.end_load((0.03, 0.0, 0.0))
    loaded = jaxrod.make_scene(scene.rod, jaxrod.clamp(state), load, scene.effects[2])
    same(picture, loaded, state, page.dt)


def test_a_law_follows_the_target(page):
    begun(page)
    left = after(page, page.do({"reset": True, "set": {"goal": [0.1, 0.3, 0.2]}}), 0.1)
    right = after(page, page.do({"reset": True, "set": {"goal": [0, -0.3, 0]}}), 0.1)
    assert left["points"][N, 1] > 0.003
    assert right["points"][N, 1] < -0.003
    np.testing.assert_allclose(right["points"][N + 1], [0, -0.3, 0], atol=1e-7)


def test_time_is_real_and_stands_still_when_paused(page):
    begun(page)
    time.sleep(0.3)
    first, begin = page.picture(page.picture()["number"]), time.perf_counter()
    time.sleep(0.6)
    last = page.picture(page.picture()["number"])
    elapsed = time.perf_counter() - begin
    # What the page says of its pace is what it does, on a busy machine, too.
    assert (last["time"] - first["time"]) / elapsed == pytest.approx(
        last["pace"], abs=0.35
    )
    still = after(page, page.do({"paused": True}))
    later = page.picture(still["number"] + 5)
    assert later["time"] == still["time"]
    assert page.time == still["time"]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ({"pull": {"node": 7, "point": POINT}}, "node must be .*6"),
        ({"pull": {"node": 1.0, "point": POINT}}, "node must be an integer"),
        ({"pull": {"node": 1, "point": [0, 0]}}, "point must have shape"),
        ({"pull": {"node": 1, "point": [0, 0, 10**400]}}, "array of numbers"),
        ({"pull": {"node": 1, "point": [0, 0, math.nan]}}, "finite"),
        ({"pull": {"node": 1}}, "a dict of node and point"),
        ({"set": {"load [N]": 0.2}}, "from -0.1 to 0.1, got 0.2"),
        ({"set": {"tension": 1}}, "no control 'tension'; there are 'load"),
        ({"set": 3}, "dict of values by label"),
        ({"paused": 2}, "true or false"),
        ({"stop": True}, "got 'stop'"),
        ([], "must be a dict"),
    ],
)
def test_bad_commands_are_refused(page, command, words):
    with pytest.raises(ValueError, match=words):
        page.do(command)


def sent(page, path, body=None, **headers):
    request = urllib.request.Request(page.url + path, body, headers)
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read()


def test_the_server_gives_the_page_pictures_and_takes_commands(page):
    begun(page)
    kind = {"Content-Type": "application/json"}
    assert b"<title>Arm" in sent(page, "")
    number = json.loads(sent(page, "do", b'{"paused": true}', **kind))["number"]
    after(page, number)
    head = np.frombuffer(sent(page, "picture?after=0"), "<f8", 12)
    assert head[3] >= number and head[4] == 1
    for path, body, headers, words in (
        ("do", b'{"paused": 3}', kind, "true or false"),
        ("do", b"{", kind, "Expecting"),
        ("do", b"{}", {"Content-Type": "text/plain"}, "application/json"),
        ("do", b"{}", kind | {"Origin": "http://elsewhere.org"}, "this machine only"),
        ("do", bytes(70000), kind, "at most 65536 bytes"),
        ("picture?after=x", None, {}, "number of a picture"),
        ("", None, {"Host": "elsewhere.org"}, "this machine only"),
        ("", None, {"Host": "["}, "this machine only"),
        ("do", b"{}", kind | {"Origin": "http://["}, "this machine only"),
        ("do", b"[" * 60000, kind, "nested too deeply"),
        ("do", b"", kind | {"Content-Length": "9" * 5000}, "at most 65536 bytes"),
        ("picture?after=--1", None, {}, "number of a picture"),
        ("picture?after=" + "9" * 5000, None, {}, "number of a picture"),
        ("secrets", None, {}, "no such page"),
    ):
        with pytest.raises(urllib.error.HTTPError) as refused:
            sent(page, path, body, **headers)
        assert refused.value.code in (400, 403, 404)
        assert words in refused.value.read().decode()


@pytest.mark.parametrize(
    ("controls", "error", "words"),
    [
        ({"x": 3.0}, TypeError, r"controls\['x'\] must be"),
        ({"x": viz.Slider}, TypeError, r"controls\['x'\] must be .* <class .*Slider"),
        ([1], TypeError, "controls must be"),
        ({"x": viz.Slider(None, 2.0, 1.0)}, ValueError, "low < high, got 2 and 1"),
        ({"x": viz.Slider(None, 0, math.inf)}, ValueError, "high must be finite"),
        ({"x": viz.Slider(None, 0, 1, 3)}, ValueError, "from 0 to 1, got 3"),
        ({"x": viz.Target(None, 0.1)}, ValueError, "needs start"),
        ({"x": viz.Target(None, -1, (0, 0, 0))}, ValueError, "positive, got -1 m"),
        (
            {"x": viz.Target(lambda s: s.effects[1].force[:2], 0.1)},
            ValueError,
            "must select 3 numbers, got 2",
        ),
        (
            {"x": viz.Slider(lambda s: 2 * s.effects[1].force, 0, 1)},
            ValueError,
            "where failed: TypeError",
        ),
        ({"x": viz.Slider(lambda s: s.method, 0, 1)}, ValueError, "unchanged, got"),
        ({"x": viz.Slider(lambda s: s.effects[9], 0, 1)}, ValueError, "IndexError"),
    ],
)
def test_bad_handles_are_refused_before_anything_is_compiled(controls, error, words):
    with pytest.raises(error, match=words):
        viz.live(*arm(), controls)


def test_other_bad_arguments_are_refused():
    scene, state = arm()
    with pytest.raises(TypeError, match="scene must be"):
        viz.live(state, scene)
    with pytest.raises(TypeError, match="state must be"):
        viz.live(scene, None)
    with pytest.raises(ValueError, match="frames_per_second must be positive"):
        viz.live(scene, state, frames_per_second=0.0)
    for port in (70000, 8000.0, True):
        with pytest.raises(ValueError, match="port must be an integer"):
            viz.live(scene, state, port=port)
    with pytest.raises(ValueError, match="frames_per_second must be at least"):
        viz.live(scene, state, frames_per_second=1e-320)
    with pytest.raises(ValueError, match="dt must be positive, got -1 s"):
        viz.live(scene, state, dt=-1.0)
    with pytest.raises(ValueError, match=r"no member 'arm'.* there are 'rod'"):
        viz.live(scene, state, colours={"arm": "#ff0000"})
    with pytest.raises(TypeError, match=r"law must be a function.*got 3"):
        viz.live(scene, state, law=3)
    for law, words in (
        (lambda scene, state, values: None, "return a scene or a system, got NoneType"),
        (lambda scene, state, values: state, "got RodState"),
    ):
        with pytest.raises(TypeError, match=words):
            viz.live(scene, state, law=law, port=None)


def test_a_taken_port_is_found_before_anything_is_compiled(page):
    compiled = []
    listen = lambda event, *_, **__: compiled.append(event)
    port = urllib.parse.urlsplit(page.url).port
    jax.monitoring.register_event_duration_secs_listener(listen)
    with pytest.raises(OSError, match=f"port {port} .* port=0 takes one that is free"):
        viz.live(*arm(), port=port, frames_per_second=33.0)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert not [event for event in compiled if "backend_compile" in event]


def test_a_port_is_free_again_after_a_bad_law():
    with socket.create_server(("127.0.0.1", 0)) as some:
        port = some.getsockname()[1]
    with pytest.raises(TypeError, match="law must return"):
        viz.live(*arm(), law=lambda *_: None, port=port)
    socket.create_server(("127.0.0.1", port)).close()


def test_a_page_that_has_ended_says_so(monkeypatch):
    # A client that waits for a rare picture is somebody who looks.
    monkeypatch.setattr("jaxrod.viz.interactive._UNWATCHED", 0.05)
    scene, state = arm()
    with viz.live(scene, state, port=None, frames_per_second=5.0) as page:
        first = page.picture()
        assert page.picture(first["number"], patience=2.0)["time"] > first["time"]
        assert "<iframe" not in page._repr_html_()
    page.stop()
    with pytest.raises(RuntimeError, match="the page has ended"):
        page.picture(10**6)
    with pytest.raises(RuntimeError, match="the page has ended"):
        page.do({"paused": True})


@pytest.mark.slow
def test_a_slow_machine_is_not_hidden():
    with viz.live(*arm(), dt=1e-7, port=None) as page:
        picture = page.picture()
        begin, first = time.perf_counter(), picture["time"]
        while time.perf_counter() < begin + 1.5:
            picture = page.picture(picture["number"])
        done = (picture["time"] - first) / (time.perf_counter() - begin)
    assert done < 0.5
    assert picture["pace"] == pytest.approx(done, rel=0.5)
    # Pictures come nevertheless.
    assert picture["rate"] > 20


@pytest.mark.slow
def test_a_simulation_that_breaks_down_says_so_and_starts_again():
    scene, state = arm()
    with viz.live(scene, state, dt=2e-2, port=None) as page:
        pull = {"node": N, "point": POINT}
        picture = after(page, page.do({"pull": pull}))
        while not picture["failed"]:
            picture = page.picture(picture["number"])
        assert np.isfinite(picture["points"]).all()
        again = after(page, page.do({"reset": True, "paused": True, "pull": None}))
        assert not again["failed"] and again["time"] == 0


@pytest.mark.slow
def test_equal_rods_and_bodies_of_a_system_are_pulled_each_alone():
    def one(x):
        rod, state = jaxrod.straight_rod(
            4,
            length=0.2,
            radius=0.01,
            density=1000.0,
            youngs_modulus=1e5,
            start=jnp.stack([x, 0.0 * x, 0.0 * x]),
            direction=(0.0, 0.0, 1.0),
        )
        return jaxrod.make_scene(rod, jaxrod.clamp(state)), state

    pair, of_pair = jax.vmap(one)(jnp.asarray([0.0, 0.1]))
    ball, of_ball = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.3, 0, 0), 0.02), density=500.0
    )
    state = {"ball": of_ball, "pair": of_pair}
    system = jaxrod.make_system({"ball": ball, "pair": pair})
    goal = viz.Target(None, 0.01, (0, 0.2, 0))
    with viz.live(system, state, {"goal": goal}, port=None) as page:
        start = page.picture()["points"]
        # Nodes of both rods, the target, the ball.
        np.testing.assert_allclose(start[:, 0], [0.0] * 5 + [0.1] * 5 + [0, 0.3])
        for node, shown in ((9, 9), (10, 11)):
            pull = {"node": node, "point": (start[shown] + [0, 0.03, 0]).tolist()}
            picture = after(page, page.do({"reset": True, "pull": pull}), 0.3)
            moved = np.abs(picture["points"] - start).max(axis=1) > 1e-4
            assert moved[shown]
            others = np.ones(12, bool)
            others[5:10] = shown != 9
            others[shown] = False
            assert not moved[others].any()


@pytest.mark.slow
def test_a_system_that_evolves_keeps_its_time():
    rod, state = jaxrod.straight_rod(
        4, length=0.3, radius=0.01, density=1e3, youngs_modulus=1e6
    )
    push = jaxrod.schedules.sine((0.1, 0.0, 0.0), period=0.2)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.end_load(push))
    with viz.live(scene, state, port=None) as page:
        picture = after(page, 0, 0.3)
        wanted = jaxrod.advance(scene, state, page.dt, round(picture["time"] / page.dt))
        np.testing.assert_allclose(picture["points"], wanted.positions.T, atol=1e-5)


@pytest.mark.slow
def test_two_pages_at_once_are_independent_and_states_with_memory_are_kept():
    scene, state = arm()
    yields = jaxrod.materials.plastic_bending(scene.rod, yield_moment=1e-3)
    push = jaxrod.schedules.sine((1.0, 0.0, 0.0), period=0.1)
    moved = scene.effects[0], jaxrod.end_load(push), scene.effects[2]
    bent = jaxrod.make_scene(scene.rod, *moved, yields)
    with viz.live(scene, state) as still, viz.live(bent, state) as page:
        assert still.url != page.url
        pull = after(still, still.do({"pull": {"node": N, "point": POINT}}), 0.005)
        assert pull["force"] > 0
        picture = after(page, 0, 0.03)
        assert picture["force"] == 0
        begun = bent.with_memory(state)
        wanted = jaxrod.advance(bent, begun, page.dt, round(picture["time"] / page.dt))
        elastic = jaxrod.make_scene(scene.rod, *moved)
        other = jaxrod.advance(
            elastic, state, page.dt, round(picture["time"] / page.dt)
        )
        np.testing.assert_allclose(picture["points"], wanted.positions.T, atol=1e-6)
        assert np.abs(wanted.positions - other.positions).max() > 1e-4


@pytest.mark.slow
def test_a_notebook_shows_the_page_and_can_end_it():
    """The kernel's own threads and the page's do not get into each other's way."""
    lines = """
import jaxrod
from jaxrod import viz
rod, state = jaxrod.straight_rod(
    4, length=0.3, radius=0.01, density=1e3, youngs_modulus=1e6
)
page = viz.live(jaxrod.make_scene(rod, jaxrod.clamp(state)), state)
page
"""
    ends = "first = page.picture()\nlast = page.picture(first['number'])\npage.stop()\n"
    ends += "last['time'] > first['time'], page.url"
    cells = [nbformat.v4.new_code_cell(text) for text in (lines, ends)]
    ran = nbclient.execute(nbformat.v4.new_notebook(cells=cells), timeout=300)
    shown, ended = (cell.outputs[-1].data for cell in ran.cells)
    assert re.search(r'<iframe src="http://127.0.0.1:\d+/"', shown["text/html"])
    assert ended["text/plain"] == "(True, None)"
