"""Pictures drawn without a display."""

from __future__ import annotations

import numpy as np
import pytest

from jaxrod.viz import animation, frame
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


def test_an_animation_has_one_picture_per_thinned_frame():
    replay = swinging_arm(num_frames=121, duration=2.0)
    player = animation(replay, frames_per_second=4, width=160, height=120).to_jshtml()
    assert player.count("data:image/png;base64") == 9


def test_without_matplotlib_a_sentence_says_what_to_install(monkeypatch):
    pretend_missing(monkeypatch, "matplotlib")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "jaxrod\[viz\]"'):
        frame(swinging_arm(num_frames=11), 0)
