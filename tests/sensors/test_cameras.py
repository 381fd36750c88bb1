"""Markers, pin-hole projection and depth images, against geometry by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import sensors
from sensors.rods import LENGTH, RADIUS, straight

EYE = sensors.camera(
    (0.0, -2.0, 0.0), (0.0, 0.0, 0.0), focal_length=100.0, principal_point=(50.0, 40.0)
)
ALONG_X = {"direction": (1.0, 0.0, 0.0), "normal": (0.0, 0.0, 1.0)}


def test_a_pin_hole_projects_by_similar_triangles():
    # 2 m ahead, 0.5 m to the right, 0.25 m up; then twice as far.
    points = np.asarray([[0.5, 0.5], [0.0, 2.0], [0.25, 0.25]])
    np.testing.assert_allclose(
        EYE.project(jnp.asarray(points)), [[75, 62.5], [27.5, 33.75]], rtol=1e-12
    )


@pytest.mark.slow
def test_markers_turn_with_their_section():
    rod, state = straight(**ALONG_X)
    scene = jaxrod.make_scene(rod)
    # d1 is up, and d2 = d3 x d1 points to -y.
    found = sensors.markers([0.5, 1.0], [(0.01, 0.0), (0.0, 0.02)]).read(scene, state)
    np.testing.assert_allclose(
        found, [[0.5, 1.0], [0.0, -0.02], [0.01, 0.0]], atol=1e-14
    )
    ahead = sensors.markers([0.5, 1.0], [(0.01, 0.0, 0.0), (0.0, 0.02, 0.03)])
    np.testing.assert_allclose(
        ahead.read(scene, state), [[0.5, 1.03], [0.0, -0.02], [0.01, 0.0]], atol=1e-14
    )
    seen = sensors.image_markers(EYE, [0.5, 1.0]).read(scene, state)
    np.testing.assert_allclose(seen, [[75, 100], [40, 40]], rtol=1e-12)


def test_points_behind_the_camera_are_flagged_and_have_no_derivative():
    eye = sensors.Camera(
        position=jnp.zeros(3),
        orientation=jnp.asarray([1.0, 0.0, 0.0, 0.0]),
        focal_length=jnp.asarray(100.0),
        principal_point=jnp.asarray([50.0, 40.0]),
    )
    points = jnp.asarray([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [-1.0, 0.0, 2.0]])
    np.testing.assert_array_equal(eye.in_front(points), [False, False, True])
    image, slopes = jax.vjp(eye.project, points)
    np.testing.assert_array_equal(np.isnan(image), [[True, True, False]] * 2)
    (slope,) = slopes(jnp.ones_like(image))
    np.testing.assert_array_equal(slope[:, :2], 0)
    np.testing.assert_allclose(slope[:, 2], [50, 50, -100 * 0.3 / 4], rtol=1e-12)


def test_a_ray_that_grazes_the_rod_misses_it_and_has_no_derivative():
    """Depth has a vertical slope at the outline. All numbers here are exact."""
    rod, state = jaxrod.straight_rod(
        2,
        length=1.0,
        radius=0.5,
        density=1e3,
        youngs_modulus=1e6,
        start=(0.5, -0.5, 4.0),
        direction=(0.0, 1.0, 0.0),
    )
    scene = jaxrod.make_scene(rod)
    eye = sensors.Camera(
        position=jnp.zeros(3),
        orientation=jnp.asarray([1.0, 0.0, 0.0, 0.0]),
        focal_length=jnp.asarray(1.0),
        principal_point=jnp.asarray([0.5, 0.5]),
    )
    image = sensors.depth_image(eye, 1, 1, max_range=9.0)
    depth, slope = jax.value_and_grad(lambda state: image.read(scene, state)[0, 0])(
        state
    )
    assert depth == 9.0
    np.testing.assert_array_equal(slope.positions, 0)


def depths(eye, state, scene, **more):
    image = sensors.depth_image(eye, 16, 24, **more)
    return np.asarray(image.read(scene, state))


def entry(distance, square, radius):
    """Depth at which a ray enters a ball or cylinder straight ahead, or infinity.

    The ray's direction has the square across the axis of what it hits.
    """
    left = distance**2 - square * (distance**2 - radius**2)
    depth = (distance - np.sqrt(np.maximum(left, 0))) / square
    return np.where(left > 0, depth, np.inf)


def test_depth_is_that_of_cylinders_and_balls():
    rod, state = straight(**ALONG_X)
    scene = jaxrod.make_scene(rod)
    lens = {"focal_length": 60.0, "principal_point": (12.0, 8.0)}
    # Halfway along the rod, from the side.
    beside = sensors.camera((0.5, -0.2, 0.0), (0.5, 0.0, 0.0), **lens)
    x, y = np.meshgrid((np.arange(24) - 11.5) / 60, (np.arange(16) - 7.5) / 60)
    side = depths(beside, state, scene)
    np.testing.assert_allclose(side, entry(0.2, 1 + y**2, RADIUS), rtol=1e-12)
    assert 0.3 < np.mean(np.isfinite(side)) < 0.9
    # From beyond the tip, along the axis: the cylinder hides behind its ball.
    ahead = sensors.camera((LENGTH + 0.2, 0.0, 0.0), (0.0, 0.0, 0.0), **lens)
    front = depths(ahead, state, scene, max_range=0.5)
    ball = np.minimum(entry(0.2, 1 + x**2 + y**2, RADIUS), 0.5)
    np.testing.assert_allclose(front, ball, rtol=1e-12)
    assert 0.1 < np.mean(front < 0.5) < 0.9
    # Looking away.
    away = sensors.camera((0.5, -0.2, 0.0), (0.5, -1.0, 0.0), **lens)
    assert np.all(depths(away, state, scene) == np.inf)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"target": (0.0, -2.0, 0.0)}, "from position to target"),
        ({"target": (0.0, -2.0, 1.0)}, "up must not be parallel"),
        ({"focal_length": 0.0}, "focal_length must be positive"),
    ],
)
def test_cameras_that_see_nothing_are_refused(arguments, words):
    good = {
        "position": (0.0, -2.0, 0.0),
        "target": (0.0, 0.0, 0.0),
        "focal_length": 100.0,
        "principal_point": (50.0, 40.0),
    }
    with pytest.raises(ValueError, match=words):
        sensors.camera(**good | arguments)
