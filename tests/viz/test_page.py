"""The replay page as a file: what it holds, and how much."""

from __future__ import annotations

import base64
import json
import os
import re
import zlib
from typing import NamedTuple

import numpy as np
import pytest

from jaxrod.viz import html, save_html
from viz.swinging_arm import swinging_arm


def unpack(page):
    """Reads the recording back out of a page, following the documented layout."""
    header = json.loads(re.search(r'id="header">(.*?)</script>', page, re.DOTALL)[1])
    packed = re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1]
    data = zlib.decompress(base64.b64decode(packed))
    frames, total = header["frames"], sum(header["nodes"])
    corners = [mesh["corners"] for mesh in header["meshes"]]
    sizes = [frames, total] + [frames] * len(header["readouts"])
    sizes += [6 * count for count in corners]
    floats = np.frombuffer(data, "<f4", sum(sizes))
    times, radii, *others = np.split(floats, np.cumsum(sizes)[:-1])
    bodies = sum(mesh["count"] for mesh in header["meshes"])
    arrows = sum(some["count"] for some in header["arrows"])
    blocks = [(header["points"], 3), (bodies, 4), (arrows, 3)]
    series = sum(count * width for count, width in blocks)
    start = 4 * sum(sizes)
    low, high = np.frombuffer(data, np.uint8, 2 * series * frames, start).reshape(2, -1)
    zigzag = low.astype(np.int64) + 256 * high.astype(np.int64)
    change = np.where(zigzag % 2, -(zigzag + 1) // 2, zigzag // 2)
    levels = np.cumsum(change.reshape(series, frames), axis=-1) % 65536
    moving, first = [], 0
    for (count, width), scale in zip(blocks, header["scales"], strict=True):
        own = levels[first : first + count * width].reshape(count, width, frames)
        moving.append(scale["low"] + np.array(scale["step"]) * own.transpose(2, 0, 1))
        first += count * width
    changes = np.frombuffer(data, np.uint8, offset=start + 2 * series * frames)
    fields = np.cumsum(changes.reshape(-1, total, frames), axis=-1) % 256
    count = len(header["readouts"])
    return Unpacked(
        header, times, radii, others[:count], others[count:], *moving, fields
    )


class Unpacked(NamedTuple):
    header: dict
    times: np.ndarray
    radii: np.ndarray
    readouts: list
    meshes: list
    positions: np.ndarray
    turns: np.ndarray
    arrows: np.ndarray
    fields: np.ndarray


def test_the_recording_survives_to_half_a_rounding_step():
    replay = swinging_arm(num_rods=2)
    header, times, radii, readouts, _, positions, *_ = unpack(html(replay))
    truth = np.concatenate(
        [replay.positions.reshape(601, -1, 3), replay.spheres[0].positions[:, None]], 1
    )
    span = truth.max(axis=(0, 1)) - truth.min(axis=(0, 1))
    np.testing.assert_allclose(header["scales"][0]["step"], span / 65535)
    assert np.all(np.abs(positions - truth) <= span / 131070 * (1 + 1e-6))
    np.testing.assert_array_equal(times, replay.times.astype("f4"))
    np.testing.assert_allclose(
        radii.reshape(2, 21)[:, [0, -1]], replay.radii[:, [0, -1]]
    )
    for found, expected in zip(readouts, replay.readouts.values(), strict=True):
        np.testing.assert_array_equal(found, expected.astype("f4"))


def test_ten_seconds_of_one_arm_take_little_room():
    assert len(html(swinging_arm())) < 200_000


def test_the_page_asks_for_nothing_from_outside():
    page = html(swinging_arm(num_frames=5))
    assert "://" not in page
    assert not re.search(r"<(script|img|iframe)[^>]*\ssrc=|@import|url\(", page)
    assert "default-src 'none'" in page
    assert "%%" not in page


def test_words_of_the_user_wrap_and_are_never_cut():
    style = re.search(r"<style>(.*?)</style>", html(swinging_arm(num_frames=5)), re.S)[
        1
    ]
    rules = re.findall(r"([^{}/]+)\{([^{}]*)\}", style)
    for place in ("h1", "#legend li", "#readouts dt"):
        applied = " ".join(
            body for names, body in rules if place in map(str.strip, names.split(","))
        )
        assert "overflow-wrap: anywhere" in applied
        assert not re.search(r"ellipsis|nowrap|overflow: hidden", applied)
    # A column of a grid is else as wide as its longest word.
    assert "grid-template-columns: minmax(0, 1fr) auto" in style


def test_text_from_the_user_cannot_break_the_page():
    # After "<!--<script" the page's own "</script>" would not end the element.
    hostile = "<!--<script></script><script>%%DATA%%&\"'"
    replay = swinging_arm(num_frames=5)
    object.__setattr__(replay, "title", hostile)
    object.__setattr__(replay.rods[0], "name", hostile)
    object.__setattr__(replay.rods[0], "fields", {hostile: np.ones((5, 1, 21))})
    page = html(replay)
    assert page.count("</script>") == 3
    assert "<!--<script" not in page
    header = unpack(page).header
    assert header["title"] == header["fields"][0]["label"] == hostile
    assert header["rodLegend"][0][1] == hostile


def test_fast_recordings_are_thinned_to_the_frame_rate():
    replay = swinging_arm(num_frames=7143)
    thin = replay.thinned(60.0)
    assert 600 <= thin.num_frames <= 602
    assert thin.times[0] == replay.times[0]
    assert thin.times[-1] == replay.times[-1]
    assert np.all(np.abs(np.diff(thin.times)[:-1] - 1 / 60) < 2e-3)
    assert replay.thinned(1000.0) is replay
    assert unpack(html(replay, frames_per_second=30))[0]["frames"] <= 302
    with pytest.raises(ValueError, match="frames_per_second must be positive, got 0"):
        html(replay, frames_per_second=0)


def test_a_failed_write_leaves_the_old_page(tmp_path, monkeypatch):
    path = tmp_path / "replay.html"
    save_html(swinging_arm(num_frames=5), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_html(swinging_arm(num_frames=9), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
