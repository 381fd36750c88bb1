"""Volume and inertia of solids against integrals over their sections."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxrod

RADIUS, HALF = 0.3, 0.5


def width(shape, z):
    """Radius of the section at a height over the middle."""
    over = {"sphere": abs(z), "cylinder": 0.0, "capsule": max(abs(z) - HALF, 0.0)}
    return np.sqrt(RADIUS**2 - over[shape] ** 2)


SHAPES = {
    "sphere": (lambda a, b: jaxrod.shapes.sphere(0.5 * (a + b), RADIUS), RADIUS),
    "cylinder": (lambda a, b: jaxrod.shapes.cylinder(a, b, RADIUS), HALF),
    "capsule": (lambda a, b: jaxrod.shapes.capsule(a, b, RADIUS), HALF + RADIUS),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_solids_of_revolution_are_sums_of_discs(shape):
    make, top = SHAPES[shape]
    middle, way = np.array([0.2, -0.1, 0.4]), np.array([0.6, 0.0, 0.8])
    solid = make(middle - HALF * way, middle + HALF * way).solid()

    def integral(of_disc):
        def at(z):
            return of_disc(z, width(shape, z))

        ends = [-HALF, HALF] if shape == "capsule" else None
        return quad(at, -top, top, points=ends, epsrel=1e-10)[0]

    volume = integral(lambda z, r: np.pi * r**2)
    along = integral(lambda z, r: np.pi * r**4 / 2)
    across = integral(lambda z, r: np.pi * r**2 * (r**2 / 4 + z**2))
    assert float(solid.volume) == pytest.approx(volume, rel=1e-8)
    np.testing.assert_allclose(
        solid.gyration, np.array([across, across, along]) / volume, rtol=1e-8
    )
    np.testing.assert_allclose(solid.centre, middle, atol=1e-12)


def test_a_pipe_is_a_cylinder_without_its_bore():
    start, end = np.array([0.2, -0.1, 0.4]), np.array([0.6, 0.1, -0.8])
    pipe = jaxrod.shapes.pipe(start, end, 0.2, thickness=0.1).solid()
    outer, bore = (jaxrod.shapes.cylinder(start, end, r).solid() for r in (0.3, 0.2))
    volume = outer.volume - bore.volume
    inertia = outer.volume * outer.gyration - bore.volume * bore.gyration
    np.testing.assert_allclose(pipe.volume, volume, rtol=1e-6)
    np.testing.assert_allclose(pipe.gyration, inertia / volume, rtol=1e-5)
    np.testing.assert_allclose(pipe.centre, outer.centre)
    np.testing.assert_allclose(pipe.orientation, outer.orientation)


def test_a_box_is_its_sides():
    centre, sides = np.array([-0.1, 0.2, 0.3]), np.array([0.4, 0.3, 0.8])
    solid = jaxrod.shapes.box(tuple(centre), tuple(sides / 2)).solid()
    a, b, c = sides**2 / 12
    assert float(solid.volume) == pytest.approx(np.prod(sides))
    np.testing.assert_allclose(solid.gyration, [b + c, a + c, a + b], rtol=1e-6)
    np.testing.assert_allclose(solid.centre, centre, rtol=1e-6)
    assert jnp.all(solid.shape.centre == 0)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "shape",
    [
        lambda: jaxrod.shapes.sphere((0.1, 0.2, 0.3), 0.4),
        lambda: jaxrod.shapes.capsule((0.1, 0.2, 0.3), (0.4, -0.5, 0.2), 0.1),
        lambda: jaxrod.shapes.cylinder((0.1, 0.2, 0.3), (0.1, 0.2, -0.9), 0.1),
        lambda: jaxrod.shapes.pipe((0.1, 0.2, 0.3), (0.4, -0.5, 0.2), 0.2, 0.1),
        lambda: jaxrod.shapes.box(
            (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.8, 0.2, -0.4, 0.4)
        ),
    ],
    ids=["sphere", "capsule", "cylinder", "pipe", "box"],
)
def test_the_triangles_of_a_shape_have_their_corners_on_it_and_its_volume(shape):
    body = shape()
    corners, faces = body.mesh()
    distance, _ = body.surface(tuple(jnp.asarray(corners).T))
    np.testing.assert_allclose(distance, 0, atol=1e-6)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    volume = np.sum(a * np.cross(b, c)) / 6
    assert volume == pytest.approx(float(body.solid().volume), rel=0.02)


@pytest.mark.parametrize("length", [0.5, 0.1])
def test_the_row_of_balls_of_a_cylinder_touches_both_its_ends(length):
    """Or lies in the middle, if the cylinder is shorter than it is thick."""
    start, way, radius = np.array([0.1, -0.2, 0.3]), np.array([0.6, 0.0, 0.8]), 0.1
    body = jaxrod.shapes.cylinder(start, start + length * way, radius)
    first, last, found = body.row_of_balls
    inset = min(radius, 0.5 * length)
    np.testing.assert_allclose(first, start + inset * way, atol=1e-6)
    np.testing.assert_allclose(last, start + (length - inset) * way, atol=1e-6)
    assert float(found) == pytest.approx(radius)
