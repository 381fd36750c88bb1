"""Stills and films: what is in front, what is lit, what the files hold."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jaxrod
from jaxrod.geometry import surfaces
from jaxrod.viz import Arrows, Mesh, Replay, Sphere, film, picture
from jaxrod.viz.geometry import Shapes, refined
from jaxrod.viz.light import _Lamp, nearest, shares_at, view_of
from jaxrod.viz.recorded import leaning_plane
from jaxrod.viz.shapes import shaded
from viz.swinging_arm import swinging_arm

SMALL = {"width": 120, "height": 90}


def test_a_leaning_plane_is_its_part_of_a_box_counterclockwise_from_outside():
    """Across the diagonal of a cube: a regular hexagon."""
    normal = np.ones(3) / np.sqrt(3)
    plane = jaxrod.shapes.plane((1.0, 2.0, 3.0), tuple(normal))
    mesh = leaning_plane(plane, np.array([0.5, 1.5, 2.5]), np.array([1.5, 2.5, 3.5]))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    areas = 0.5 * np.cross(b - a, c - a) @ normal
    assert np.all(areas > 0)
    assert areas.sum() == pytest.approx(3 * np.sqrt(3) / 4, rel=1e-6)
    np.testing.assert_allclose(mesh.vertices @ normal, 6 / np.sqrt(3), rtol=1e-6)
    far = plane.point + jnp.asarray([9.0, 9.0, 9.0])
    assert (
        leaning_plane(jaxrod.shapes.plane(far, normal), np.zeros(3), np.ones(3)) is None
    )


def test_the_nearest_triangle_is_found_at_every_pixel():
    rng = np.random.default_rng(3)
    width, height = 40, 30
    middles = rng.uniform((0, 0, 0), (width, height, 1), (60, 3))
    sizes = rng.uniform(1, 20, (60, 1, 1)) * np.array([1, 1, 0.02])
    corners = middles[:, None] + rng.normal(size=(60, 3, 3)) * sizes
    front, depth = nearest(corners, width, height)
    for pixel in range(0, width * height, 7):
        place = np.array([pixel % width + 0.5, pixel // width + 0.5])
        best, found = np.inf, -1
        for k, (a, b, c) in enumerate(corners):
            shares = np.linalg.solve(
                np.array([[*a[:2], 1], [*b[:2], 1], [*c[:2], 1]]).T, [*place, 1]
            )
            deep = shares @ [a[2], b[2], c[2]]
            if shares.min() > 0 and deep < best:
                best, found = deep, k
        assert front[pixel] == found
        if found >= 0:
            assert depth[pixel] == pytest.approx(best, abs=1e-4)
            shares = shares_at(corners[[found]], place[None])[0]
            np.testing.assert_allclose(
                shares @ corners[found][:, :2], place, atol=1e-3 * width
            )


def test_a_view_holds_what_it_is_made_for_and_no_more():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(200, 3)) * [3.0, 1.0, 0.2]
    for up in range(3):
        view = view_of(points, up, 40.0, 25.0, (1.2, 0.9), 1.0)
        assert view.above[up] > 0
        np.testing.assert_allclose(view.frame @ view.frame.T, np.eye(3), atol=1e-12)
        right, above, ahead = view.seen(points).T
        tangent = np.tan(np.radians(14.0))
        wide, tall = np.abs(right / ahead) / tangent, np.abs(above / ahead) / tangent
        assert wide.max() <= 1.2 * 1.01 and tall.max() <= 0.9 * 1.01
        assert max(wide.max() / 1.2, tall.max() / 0.9) > 0.9


def test_finer_lines_pass_through_all_nodes():
    nodes = np.random.default_rng(0).normal(size=(6, 5))
    fine = refined(nodes, 4)
    np.testing.assert_allclose(fine[::4], nodes, atol=1e-12)
    line = np.linspace(0, 1, 5)[:, None] * np.ones(4)
    np.testing.assert_allclose(refined(line, 3)[:, 0], np.linspace(0, 1, 13))


def still(replay, frame, path, **more):
    picture(replay, frame, path, **{**SMALL, "captions": False, **more})
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def arm(**more):
    nodes = np.zeros((3, 5, 3)) + np.linspace(0, 1, 5)[:, None] * [1.0, 0, 0]
    nodes += np.arange(3)[:, None, None] * [0, 0.5, 0] + [0, 0, 0.3]
    return Replay.from_nodes(nodes, 0.08, [0.0, 0.5, 1.0], floor=0.0, **more)


def test_a_picture_has_the_rod_its_shadow_and_the_ground(tmp_path):
    seen = still(arm(), 0, tmp_path / "arm.png", elevation=30)
    assert seen.shape == (90, 120, 3)
    blue = seen[..., 2] - seen[..., 0] > 60
    assert 200 < blue.sum() < 4000
    bright = seen.sum(axis=-1)
    shadow = ~blue & (bright < bright[-1].max() - 90)
    assert shadow.sum() > 60


def test_a_field_colours_from_one_end_of_the_ramp_to_the_other(tmp_path):
    replay = arm(fields={"share [1]": np.linspace(0, 1, 5)})
    plain = still(replay, 0, tmp_path / "a.png", azimuth=-90)
    ramp = still(replay, 0, tmp_path / "b.png", azimuth=-90, field="share [1]")
    rod = plain[..., 2] - plain[..., 0] > 60
    columns = np.flatnonzero(rod.sum(axis=0) > 3)
    left, right = (ramp[:, some][rod[:, some]] for some in (columns[:8], columns[-8:]))
    ends = [left.mean(axis=0), right.mean(axis=0)]
    redness = sorted(colour[0] - colour[2] for colour in ends)
    assert redness[0] < -40 and redness[1] > 60
    with pytest.raises(ValueError, match=r"field must be one of \['share \[1\]'\]"):
        picture(replay, 0, tmp_path / "c.png", field="speed [m/s]")


def test_of_several_frames_the_last_is_in_full(tmp_path):
    seen = still(arm(), (0, 2), tmp_path / "two.png", azimuth=-90, elevation=60)
    strength = seen[..., 2] - seen[..., 0]
    assert (strength > 100).sum() > 100  # the last
    assert ((strength > 25) & (strength < 80)).sum() > 100  # the first, paler


def test_a_small_file_looks_nearly_the_same(tmp_path):
    seen = still(arm(), 0, tmp_path / "arm.png")
    small = still(arm(), 0, tmp_path / "small.png", small=True)
    assert np.abs(small - seen).mean() < 2
    sizes = [(tmp_path / name).stat().st_size for name in ("arm.png", "small.png")]
    assert sizes[1] < 0.7 * sizes[0]


def test_bodies_and_arrows_are_part_of_a_frame():
    block = Mesh(*surfaces.box(np.array([0.1, 0.2, 0.3])), positions=(0.0, 0.0, 2.0))
    force = np.zeros((3, 2, 3)) + np.array([[0, 0, 5.0], [0, 0, 0]])
    replay = arm(
        meshes=[block], arrows=[Arrows(np.zeros((1, 2, 3)), force, length=1.0)]
    )
    bare = Shapes(arm()).at(1).corners
    whole = Shapes(replay).at(1).corners
    others = whole[len(bare) :].reshape(-1, 3)
    on_block = others[: 12 * 3] - [0, 0, 2]
    np.testing.assert_allclose(np.abs(on_block), [[0.1, 0.2, 0.3]] * 36)
    arrow = others[12 * 3 :]
    assert arrow[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert arrow[:, 2].max() == pytest.approx(1.0)
    assert replay.bounds()[1][2] == pytest.approx(2.3)


def test_a_film_holds_its_frames(tmp_path):
    replay = swinging_arm(num_frames=41, duration=2.0)
    path = tmp_path / "arm.gif"
    film(replay, path, frames_per_second=3, **SMALL)
    with Image.open(path) as gif:
        assert gif.n_frames == 7
        assert gif.size == (120, 90)
        assert gif.info["duration"] == pytest.approx(2000 / 6, abs=10)
    with pytest.raises(ValueError, match=r"must end in .gif or .mp4, got"):
        film(replay, tmp_path / "arm.avi")
    with pytest.raises(ValueError, match="speed must be positive"):
        film(replay, path, speed=0.0)


def test_a_film_as_mp4_needs_ffmpeg(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    replay = swinging_arm(num_frames=3, duration=0.1)
    with pytest.raises(FileNotFoundError, match="needs ffmpeg"):
        film(replay, tmp_path / "arm.mp4", **SMALL)


def test_a_small_thing_keeps_its_colour_in_a_film(tmp_path):
    """A GIF has few colours; those of most pixels alone leave out a small target."""
    along = np.linspace(0, 1, 21)
    nodes = np.stack([along * 0, along, along * 0], 1)
    replay = Replay.from_nodes(
        np.stack([nodes, nodes]),
        0.05,
        [0.0, 1.0],
        spheres=[Sphere((-0.3, 0.8, 0.1), 0.03)],
        up="y",
    )
    size = {"width": 480, "height": 360}
    film(replay, tmp_path / "arm.gif", frames_per_second=2, captions=False, **size)
    picture(replay, -1, tmp_path / "arm.png", captions=False, **size)
    with (
        Image.open(tmp_path / "arm.gif") as gif,
        Image.open(tmp_path / "arm.png") as png,
    ):
        gif.seek(gif.n_frames - 1)
        shown, drawn = (
            np.asarray(picture.convert("RGB"), int) for picture in (gif, png)
        )
    warm, expected = (
        np.count_nonzero(picture[..., 0] - picture[..., 2] > 40)
        for picture in (shown, drawn)
    )
    assert expected > 100
    assert warm == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize(("texels", "share"), [(1.5, 1), (3.5, 0), (20, 0)])
def test_a_shadow_begins_a_few_texels_below_what_casts_it(texels, share):
    """So surfaces do not shade themselves, and what lies on the floor shades it."""
    side, texel = 100, 0.01
    size = 0.86 * side * texel
    floor = size * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    plate = 0.25 * floor + [0.3 * size, 0.3 * size, texels * texel]
    corners = np.concatenate([quad[[[0, 1, 2], [0, 2, 3]]] for quad in (floor, plate)])
    lamp = _Lamp(corners, SimpleNamespace(lamp=np.array([0.0, 0.0, 1.0])), side)
    places = np.array([plate.mean(axis=0) * [1, 1, 0], [0.8 * size, 0.8 * size, 0]])
    lit = lamp.reaches(places.astype(np.float32), 2 * texel)
    np.testing.assert_allclose(lit, [share, 1])


def test_normals_do_not_depend_on_how_a_face_is_cut_into_triangles():
    """A flat roof of four faces, one of them cut in two: its top points upwards."""
    rim = [[1.0, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    vertices = np.array([*rim, [0, 0, 0.1]])
    faces = np.array([[k, (k + 1) % 5, 5] for k in range(5)])
    corners, normals = shaded(Mesh(vertices, faces))
    at_top = np.isclose(corners[..., 2], 0.1)
    np.testing.assert_allclose(normals[at_top], [[0, 0, 1]] * 5, atol=1e-12)
