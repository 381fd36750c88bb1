"""The replay page in a real browser."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from jaxrod.viz import Replay, save_html
from viz.browser import Browser
from viz.swinging_arm import swinging_arm

pytestmark = pytest.mark.browser

DESKTOP = {"width": 900, "height": 600}
PHONE = {"width": 390, "height": 760}


@pytest.fixture(scope="module")
def browser(chromium):
    with Browser(chromium) as browser:
        yield browser


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "arm.html"
    save_html(swinging_arm(), path)
    return path.as_uri()


@pytest.fixture
def opened(browser, page):
    browser.errors.clear()
    browser.requests.clear()
    browser.look(**DESKTOP, dark=False)
    browser.open(page)
    yield browser
    assert browser.errors == []
    assert browser.requests == [page]


def stage(picture):
    """The part of the picture between the heading and the controls."""
    wide = picture.shape[1] > 560
    return picture[100 if wide else 170 : -130, 210 if wide else 0 :].astype(int)


def coloured(picture):
    """Number of pixels with the colour of the rod: clearly more blue than red."""
    part = stage(picture)
    return int(((part[..., 2] - part[..., 0]) > 60).sum())


def seconds(browser):
    return float(browser.run("document.querySelector('#clock b').textContent"))


def test_the_arm_the_target_and_the_floor_are_drawn(opened):
    opened.press("End")
    picture = opened.picture()
    part = stage(picture)
    orange = (part[..., 0] - part[..., 2]) > 80
    assert coloured(picture) > 1500
    assert orange.sum() > 200
    assert len(np.unique(part.reshape(-1, 3), axis=0)) > 500


def test_play_moves_the_arm_and_the_clock_and_pause_stops_them(opened):
    before = opened.picture()
    assert seconds(opened) == 0
    opened.run("document.querySelector('#play').click()")
    opened.wait("parseFloat(document.querySelector('#clock b').textContent) > 0.4")
    opened.press(" ")
    assert opened.run("document.querySelector('#play').ariaLabel") == "Play"
    after, stopped = opened.picture(), seconds(opened)
    assert (np.abs(stage(after) - stage(before)).max(axis=-1) > 40).sum() > 300
    opened.settle()
    assert seconds(opened) == stopped


def test_arrows_step_frames_and_the_scrubber_seeks(opened):
    opened.press("ArrowRight")
    opened.press("ArrowRight")
    assert seconds(opened) == pytest.approx(0.03, abs=0.006)
    opened.press("ArrowLeft")
    assert seconds(opened) == pytest.approx(0.02, abs=0.006)
    opened.press("End")
    assert seconds(opened) == pytest.approx(10.0)
    opened.run(
        "const s = document.querySelector('#scrubber'); s.value = 300; "
        "s.dispatchEvent(new Event('input'))"
    )
    assert seconds(opened) == pytest.approx(5.0)
    value = opened.run("document.querySelector('#scrubber').ariaValueText")
    assert value == "5.00 seconds"


def test_dragging_and_presets_turn_the_view(opened):
    first = stage(opened.picture())
    opened.drag((450, 300), (600, 330))
    turned = stage(opened.picture())
    opened.press("4")
    opened.wait("document.querySelector('[data-preset=top]').ariaPressed == 'true'")
    top = stage(opened.picture())
    for other in (turned, top):
        assert (np.abs(other - first).max(axis=-1) > 30).mean() > 0.02
    assert "y [m]" not in opened.run("document.querySelector('#labels').innerText")


def test_axes_are_labelled_in_metres_and_time_in_seconds(opened):
    opened.settle()
    labels = opened.run(
        "[...document.querySelectorAll('#labels span:not([hidden])')]"
        ".map(s => s.textContent)"
    )
    assert {"x [m]", "y [m]", "z [m]", "0.8"} <= set(labels)
    assert opened.run("document.querySelector('#clock').innerText").endswith(" s")


def test_the_view_comes_back_when_the_browser_takes_the_graphics_away(opened):
    before = coloured(opened.picture())
    opened.run(
        "const canvas = document.querySelector('#view');"
        "const lever = canvas.getContext('webgl2').getExtension('WEBGL_lose_context');"
        "new Promise(r => {"
        "canvas.addEventListener('webglcontextrestored', () => r(true));"
        "lever.loseContext(); setTimeout(() => lever.restoreContext(), 100); })"
    )
    assert coloured(opened.picture()) == before
    opened.errors[:] = [e for e in opened.errors if "CONTEXT_LOST_WEBGL" not in e]


def test_every_control_has_a_name(opened):
    nodes = opened.send("Accessibility.getFullAXTree")["nodes"]
    roles = {"button", "slider", "combobox", "checkbox", "img", "toolbar"}
    controls = [n for n in nodes if n.get("role", {}).get("value") in roles]
    names = [n.get("name", {}).get("value", "") for n in controls]
    assert len(controls) >= 10
    assert all(names)
    assert {"Play", "Time", "Speed", "Colour", "Trails", "Top"} <= set(names)


def test_curvature_colouring_shows_its_scale(opened):
    plain = coloured(opened.picture())
    opened.run(
        "const c = document.querySelector('#colour'); c.value = 'curvature'; "
        "c.dispatchEvent(new Event('change')); "
        "document.querySelector('#trails').click()"
    )
    assert coloured(opened.picture()) != plain
    assert "/m" in opened.run("document.querySelector('#legend').innerText")


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_the_page_follows_colour_scheme_and_size(browser, page, size, dark):
    browser.look(**size, dark=dark)
    browser.open(page)
    picture = browser.picture()
    assert (picture[-1, 0].mean() < 80) == dark
    assert coloured(picture) > 500
    overflow = browser.run(
        "[...document.querySelectorAll('button, select, input, h1')]"
        ".filter(e => e.offsetParent && (e.getBoundingClientRect().right > innerWidth"
        " || e.getBoundingClientRect().left < 0)).length"
    )
    assert overflow == 0


def test_a_page_around_it_chooses_the_theme_without_loading_it_again(browser, page):
    browser.look(**DESKTOP, dark=False)
    browser.open(f"{page}#dark")
    browser.run("window.kept = true")
    assert browser.picture()[-1, 0].mean() < 80
    for theme, dark in (("light", False), ("dark", True), ("", False)):
        browser.run(f"location.replace('#{theme}')")
        browser.settle()
        assert (browser.picture()[-1, 0].mean() < 80) == dark
    assert browser.run("window.kept")


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_long_names_are_shown_whole(browser, tmp_path, size):
    name = "a_name_" * 9
    replay = swinging_arm(num_frames=5)
    rods = tuple(dataclasses.replace(rods, name=name) for rods in replay.rods)
    numbers = {"distance to target [m]": np.ones(5), name: np.full(5, 1e-9)}
    replay = dataclasses.replace(replay, title=name, rods=rods, readouts=numbers)
    save_html(replay, tmp_path / "page.html")
    browser.look(**size, dark=False)
    browser.open((tmp_path / "page.html").as_uri())
    assert (
        browser.run(
            "[...document.querySelectorAll('h1, #legend li, #readouts dt')]"
            ".filter(e => e.scrollWidth > e.clientWidth + 1 || "
            "e.getBoundingClientRect().right > innerWidth).map(e => e.textContent)"
        )
        == []
    )


def test_a_page_scrolls_over_a_player_until_it_is_clicked(browser, page):
    browser.look(**DESKTOP, dark=False)
    browser.open(page)
    zooms = (
        "(() => { const e = new WheelEvent('wheel', {deltaY: 9, cancelable: true});"
        "document.querySelector('#view').dispatchEvent(e); "
        "return e.defaultPrevented })()"
    )
    assert browser.run(zooms)
    inside = f"Object.defineProperty(window, 'parent', {{value: {{}}}}); {zooms}"
    assert not browser.run(inside)
    browser.run("document.querySelector('#view').focus()")
    assert browser.run(zooms)


def test_it_starts_by_itself_unless_the_reader_wants_stillness(browser, page):
    browser.look(**DESKTOP, dark=False, still=False)
    browser.open(page)
    browser.wait("parseFloat(document.querySelector('#clock b').textContent) > 0.1")
    browser.look(**DESKTOP, dark=False, still=True)
    browser.open(page)
    browser.settle()
    assert seconds(browser) == 0


@pytest.mark.parametrize("kind", ["one frame", "straight and still", "many rods"])
def test_unusual_replays_open_without_errors(browser, tmp_path, kind):
    if kind == "many rods":
        replay = swinging_arm(num_frames=30, num_rods=150)
    else:
        nodes = np.zeros((1 if kind == "one frame" else 5, 2, 3))
        nodes[:, 1, 2] = 1e-3
        replay = Replay.from_nodes(nodes, 1e-5, np.arange(len(nodes)) * 1e-3)
    path = tmp_path / "page.html"
    save_html(replay, path)
    browser.errors.clear()
    browser.look(**DESKTOP, dark=False)
    browser.open(path.as_uri())
    assert coloured(browser.picture()) > 100
    assert browser.run("document.querySelector('#message').hidden")
    assert browser.errors == []


def test_a_notebook_frame_shows_the_player(browser, tmp_path):
    browser.errors.clear()
    replay = swinging_arm(num_frames=20, duration=1.0)
    path = tmp_path / "notebook.html"
    path.write_text(f"<!DOCTYPE html><body>{replay._repr_html_()}</body>")
    browser.look(**DESKTOP, dark=False)
    browser.send("Page.navigate", url=path.as_uri())
    browser.wait(
        "document.querySelector('iframe')?.contentDocument"
        "?.querySelector('#clock')?.textContent.length > 0"
    )
    assert coloured(browser.picture()) > 500
    assert browser.errors == []
