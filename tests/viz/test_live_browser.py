"""The live page in a real browser: one pulls with the mouse, a slider, a gamepad."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import actuation, viz
from viz.browser import Browser

pytestmark = [pytest.mark.browser, pytest.mark.slow]
N = 20
PAD = """
window.pad = {axes: [0, 0, 0, 0], buttons: [0, 1].map(() => ({pressed: false}))};
navigator.getGamepads = () => [null, window.pad];
"""


@pytest.fixture(scope="module")
def page():
    rod, state = jaxrod.straight_rod(
        N,
        length=0.25,
        radius=0.008,
        density=1100.0,
        youngs_modulus=1e6,
        direction=(0.0, 0.0, 1.0),
        normal=(1.0, 0.0, 0.0),
    )
    tendon = actuation.tendon(rod, (0.007, 0.0), tension=0.0)
    effects = jaxrod.clamp(state), tendon, jaxrod.exponential_damping(12.0)
    controls = {
        "tension [N]": viz.Slider(lambda scene: scene.effects[1].tension, 0.0, 4.0),
        "goal": viz.Target(None, 0.01, (0.1, 0.0, 0.2)),
    }
    scene = jaxrod.make_scene(rod, *effects)
    with viz.live(scene, state, controls, title="Tendon arm", floor=0.0) as page:
        yield page


@pytest.fixture
def opened(page, chromium):
    page.do({"reset": True, "pull": None, "paused": False, "set": {"tension [N]": 0}})
    with Browser(chromium) as browser:
        browser.look(width=1000, height=700, dark=False)
        browser.open(page.url)
        browser.wait("window.live?.news.number > 0 && window.live.news.time > 0.2")
        yield browser
        assert browser.errors == []


def mouse(browser, kind, x, y):
    common = {"button": "left", "buttons": 1, "clickCount": 1}
    browser.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **common)


def tip(page):
    return page.picture(page.picture()["number"])["points"][N]


def test_the_mouse_pulls_on_the_tip_and_lets_go(opened, page):
    before = opened.picture()
    x, y = opened.run(f"window.live.onScreen({N})")
    azimuth = opened.run("window.live.camera.azimuth")
    mouse(opened, "mousePressed", x, y)
    for k in range(1, 11):
        mouse(opened, "mouseMoved", x - 12 * k, y + 6 * k)
    opened.wait("window.live.news.force > 0.1")
    opened.wait("document.querySelector('#force').textContent.startsWith('pull')")
    pulled = opened.picture()
    assert (np.abs(pulled.astype(int) - before).max(axis=-1) > 40).sum() > 500
    assert np.linalg.norm(tip(page)[:2]) > 0.03
    mouse(opened, "mouseReleased", x - 120, y + 60)
    opened.wait("window.live.news.held < 0 && window.live.news.force === 0")
    # The view has not turned with it, as it does beside the arm.
    assert opened.run("window.live.camera.azimuth") == azimuth
    opened.drag((300, 500), (380, 500))
    assert opened.run("window.live.camera.azimuth") != azimuth


def test_the_slider_bends_the_arm_and_the_ball_is_dragged(opened, page):
    opened.run(
        "const s = document.querySelector('#handles input'); s.value = 2.5; "
        "s.dispatchEvent(new Event('input'))"
    )
    opened.wait("window.live.recording.point(20, 0, 0)[0] > 0.05")
    assert page.values["tension [N]"] == pytest.approx(2.5)
    x, y = opened.run("window.live.onScreen(window.live.recording.firstSphere)")
    opened.drag((x, y), (x + 60, y))
    opened.wait("window.live.news.number > 0 && !window.live.asking")
    opened.settle()
    goal = page.picture(page.picture()["number"])["values"][1:]
    assert np.linalg.norm(goal - [0.1, 0.0, 0.2]) > 0.01
    shown = opened.run("[...document.querySelectorAll('#handles output')].length")
    assert shown == 4


def test_space_pauses_and_r_starts_again(opened, page):
    opened.press(" ")
    opened.wait("document.querySelector('#pace').textContent.startsWith('paused')")
    assert page.picture()["paused"]
    opened.press("r")
    opened.wait("window.live.news.time === 0")
    opened.press(" ")
    opened.wait("window.live.news.time > 0.1")


def test_a_gamepad_pulls_slides_and_pauses(opened, page):
    opened.run(PAD)
    opened.run("window.pad.axes[0] = -1")
    opened.wait("window.live.news.force > 0.1")
    opened.run("window.pad.axes[0] = 0.05")
    opened.wait("window.live.news.held < 0")
    opened.run("window.pad.axes[2] = 1")
    opened.wait("window.live.rows[0].value > 1")
    opened.run("window.pad.axes[2] = 0; window.pad.buttons[0].pressed = true")
    opened.wait("window.live.news.paused")
    opened.run("window.pad.buttons[0].pressed = false")


def test_a_lost_simulation_is_said(chromium):
    rod, state = jaxrod.straight_rod(
        4, length=0.2, radius=0.01, density=1e3, youngs_modulus=jnp.float32(1e6)
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    with Browser(chromium) as browser:
        with viz.live(scene, state) as page:
            browser.look(width=390, height=760, dark=True)
            browser.open(page.url)
            browser.wait("window.live?.news.number > 0")
        # The browser itself reports the refused connections.
        browser.wait("document.querySelector('#message').textContent.includes('ended')")
