"""Pictures drawn without a display."""

from __future__ import annotations

import numpy as np
import pytest

from jaxrod.viz import animation, frame, picture
from jaxrod.viz.colours import rod_colours, rod_legend
from jaxrod.viz.recording import Recording
from jaxrod.viz.rods import Rods
from missing import pretend_missing
from viz.swinging_arm import swinging_arm


def test_a_frame_is_a_picture_of_the_asked_size_that_shows_the_motion():
    replay = swinging_arm(num_frames=101)
    first = frame(replay, 0, width=320, height=240)
    later = frame(replay, 40, width=320, height=240)
    assert first.shape == (240, 320, 3)
    assert first.dtype == np.uint8
    part = first.astype(int)
    assert ((part[..., 2] - part[..., 0]) > 60).sum() > 300  # the blue arm
    assert ((part[..., 0] - part[..., 2]) > 60).sum() > 30  # the orange target
    assert (np.abs(later.astype(int) - part).max(axis=-1) > 60).sum() > 300


def test_the_last_frame_can_be_counted_from_the_end():
    replay = swinging_arm(num_frames=11)
    size = {"width": 160, "height": 120}
    np.testing.assert_array_equal(frame(replay, -1, **size), frame(replay, 10, **size))
    with pytest.raises(IndexError):
        frame(replay, 11)
    with pytest.raises(ValueError, match="width must be positive, got 0 pixels"):
        frame(replay, 0, width=0)
    for draw in (frame, lambda *given: picture(*given, "never.png")):
        with pytest.raises(TypeError, match="show returns it, got a dict"):
            draw({"arm": None}, 0)


def test_an_animation_has_one_picture_per_thinned_frame():
    replay = swinging_arm(num_frames=121, duration=2.0)
    player = animation(replay, frames_per_second=4, width=160, height=120).to_jshtml()
    assert player.count("data:image/png;base64") == 9


def test_without_matplotlib_a_sentence_says_what_to_install(monkeypatch):
    pretend_missing(monkeypatch, "matplotlib")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "jaxrod\[viz\]"'):
        frame(swinging_arm(num_frames=11), 0)


def group(count, name="", names=(), colour=""):
    """Rods of two elements, at two moments."""
    places = np.zeros((2, count, 3, 3)) + np.arange(3)[:, None]
    return Rods(places, np.full((count, 2), 0.1), name, names, colour)


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ([group(1)], ["rod"]),
        ([group(1, "arm")], ["arm"]),
        ([group(2, names=("left", "right"))], ["left", "right"]),
        ([group(3, "cilia", colour="#808080")], ["cilia × 3"]),
        ([group(9, "cilia")], ["cilia × 9"]),
        ([group(9)], ["9 rods"]),
        ([group(1, "arm"), group(3, "hair"), group(1)], ["arm", "hair × 3", "rod"]),
    ],
)
def test_the_legend_names_rods_and_groups_in_their_colours(groups, words):
    times = np.array([0.0, 1.0])
    replay = Recording(times=times, rods=tuple(groups))
    entries = rod_legend(replay)
    assert [text for _, text, _ in entries] == words
    firsts = np.cumsum([0, *(some.num_rods for some in groups[:-1])])
    colours = rod_colours(replay)
    if len(entries) == len(groups) and not entries[0][2]:
        assert [colour for colour, _, _ in entries] == [colours[k] for k in firsts]
