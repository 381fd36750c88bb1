"""Labels and frames of cameras: found whatever the order and the frame."""

import numpy as np
import pytest

from jaxrod import twin
from twin.made_up import a_camera

POINTS = np.array([
    [0.02, 0.01, -0.1], [-0.03, 0.02, -0.17], [0.05, 0.02, -0.22], [0.09, 0.0, -0.28],
])  # fmt: skip


def seen(points, camera, order, noise, rng, labelled=False):
    """A recording of points in the arm's frame, from a camera's."""
    turn, shift = camera
    recorded = np.sum((points - shift)[..., None] * turn, axis=-2)
    recorded = recorded + noise * rng.standard_normal(recorded.shape)
    frames = len(points)
    times, inputs = np.arange(frames) / 50, np.zeros((frames, 0))
    return twin.Recording("made up", times, inputs, recorded[:, order], labelled)


def shapes(rng, count=4, spread=0.04):
    """Predicted points of several recordings of three frames."""
    return [
        POINTS + spread * rng.standard_normal(POINTS.shape) + np.zeros((3, 1, 1))
        for _ in range(count)
    ]


@pytest.mark.parametrize("seed", range(5))
def test_any_order_in_any_frame_is_found(seed):
    rng = np.random.default_rng(seed)
    camera, made = a_camera(rng), shapes(rng)
    orders = [rng.permutation(4) for _ in made]
    recorded = [
        seen(p, camera, o, 1e-3, rng) for p, o in zip(made, orders, strict=True)
    ]
    found = twin.register(recorded, made)
    assert [list(o) for o in found.orders] == [list(np.argsort(o)) for o in orders]
    assert np.abs(found.rotation - camera[0]).max() < 0.05
    assert found.distance < 3e-3 and found.margin > 3
    for k, (recording, points) in enumerate(zip(recorded, made, strict=True)):
        assert np.abs(found.apply(recording, k).points - points).max() < 8e-3


def test_without_noise_points_come_back_to_rounding():
    rng = np.random.default_rng(3)
    camera, made = a_camera(rng), shapes(rng)
    recorded = [seen(p, camera, rng.permutation(4), 0, rng) for p in made]
    found = twin.register(recorded, made)
    for k, (recording, points) in enumerate(zip(recorded, made, strict=True)):
        assert np.abs(found.apply(recording, k).points - points).max() < 1e-12


def test_a_known_frame_is_kept():
    rng = np.random.default_rng(4)
    camera, made = a_camera(rng), shapes(rng)
    orders = [rng.permutation(4) for _ in made]
    recorded = [
        seen(p, camera, o, 1e-3, rng) for p, o in zip(made, orders, strict=True)
    ]
    found = twin.register(recorded, made, axes=camera[0], shift=camera[1])
    assert np.array_equal(found.rotation, camera[0])
    assert np.array_equal(found.shifts, np.broadcast_to(camera[1], (4, 3)))
    assert [list(o) for o in found.orders] == [list(np.argsort(o)) for o in orders]


def test_a_marker_at_the_origin_gives_each_recording_its_shift():
    rng = np.random.default_rng(5)
    (turn, shift), made = a_camera(rng), shapes(rng)
    for points in made:
        points[:, 0] = POINTS[0]
    moved = [(turn, shift + 0.1 * rng.standard_normal(3)) for _ in made]
    orders = [rng.permutation(4) for _ in made]
    recorded = [
        seen(p, c, o, 0, rng) for p, c, o in zip(made, moved, orders, strict=True)
    ]
    found = twin.register(recorded, made, axes=turn, origin=0)
    assert [list(o) for o in found.orders] == [list(np.argsort(o)) for o in orders]
    assert np.abs(found.shifts - [c[1] for c in moved]).max() < 1e-12
    # One shift for all would be some 10 cm off.
    assert twin.register(recorded, made, axes=turn).distance > 0.03


def test_axes_are_found_from_recordings_that_each_have_an_origin():
    """Between recordings, the camera was moved but not turned."""
    rng = np.random.default_rng(9)
    (turn, shift), made = a_camera(rng), shapes(rng)
    for points in made:
        points[:, 0] = POINTS[0]
    moved = [(turn, shift + rng.standard_normal(3)) for _ in made]
    orders = [rng.permutation(4) for _ in made]
    recorded = [
        seen(p, c, o, 0, rng) for p, c, o in zip(made, moved, orders, strict=True)
    ]
    found = twin.register(recorded, made, origin=0)
    assert [list(o) for o in found.orders] == [list(np.argsort(o)) for o in orders]
    assert np.abs(found.rotation - turn).max() < 1e-9
    assert np.abs(found.shifts - [c[1] for c in moved]).max() < 1e-9


def test_markers_on_a_line_show_no_axes():
    rng = np.random.default_rng(10)
    camera, order = a_camera(rng), np.arange(4)
    made = [np.linspace(0, 0.3, 4)[:, None] * np.ones((3, 1, 3))]
    recorded = [seen(made[0], camera, order, 1e-6, rng, labelled=True)]
    for origin in (None, 0):
        with pytest.raises(ValueError, match="on a line, so the frame of the camera"):
            twin.register(recorded, made, origin=origin)


def test_labels_that_are_known_are_kept():
    rng = np.random.default_rng(6)
    camera, made = a_camera(rng), shapes(rng)
    recorded = [seen(p, camera, np.arange(4), 1e-3, rng, labelled=True) for p in made]
    found = twin.register(recorded, made)
    assert np.array_equal(found.orders, np.broadcast_to(np.arange(4), (4, 4)))
    assert found.margin == np.inf


def test_frames_with_a_missing_marker_are_left_out():
    rng = np.random.default_rng(7)
    camera, made = a_camera(rng), shapes(rng)
    recorded = [seen(p, camera, rng.permutation(4), 0, rng) for p in made]
    for recording in recorded:
        recording.points[1, 2] = np.nan
    found = twin.register(recorded, made)
    assert found.distance < 1e-7
    recorded[0].points[:, 1] = np.nan
    with pytest.raises(ValueError, match="no frame has all 4 markers"):
        twin.register(recorded, made)


@pytest.mark.parametrize("origin", [None, 0])
def test_a_marker_that_is_never_seen_is_left_out_where_labels_are_known(origin):
    rng = np.random.default_rng(8)
    (turn, shift), made = a_camera(rng), shapes(rng)
    recorded = [
        seen(p, (turn, shift), np.arange(4), 0, rng, labelled=True) for p in made
    ]
    recorded[1].points[:, 2] = np.nan
    known = {"shift": shift} if origin is None else {"origin": 0}
    found = twin.register(recorded, made, axes=turn, **known)
    assert np.abs(found.shifts - shift).max() < 1e-12 and found.distance < 1e-12
    assert np.isfinite(recorded[1].averaged().points).sum() == 9
    assert recorded[1].is_at_rest(0.3)
    recorded[1].points[:, 0] = np.nan
    if origin is not None:
        with pytest.raises(ValueError, match="at the origin was never seen"):
            twin.register(recorded, made, axes=turn, **known)


def test_too_many_markers_need_names():
    points = np.zeros((2, 8, 3))
    recording = twin.Recording("x", np.arange(2.0), np.zeros((2, 0)), points, False)
    with pytest.raises(ValueError, match="labels of at most 7 markers"):
        twin.register([recording], [points])
