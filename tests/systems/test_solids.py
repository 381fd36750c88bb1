"""Volume and inertia of solids against integrals over their sections."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxrod
from jaxrod.systems.members.solids import solid_of

RADIUS, HALF = 0.3, 0.5


def width(shape, z):
    """Radius of the section at a height over the middle."""
    over = {"sphere": abs(z), "cylinder": 0.0, "capsule": max(abs(z) - HALF, 0.0)}
    return np.sqrt(RADIUS**2 - over[shape] ** 2)


SHAPES = {
    "sphere": (lambda a, b: jaxrod.sphere(0.5 * (a + b), RADIUS), RADIUS),
    "cylinder": (lambda a, b: jaxrod.cylinder(a, b, RADIUS), HALF),
    "capsule": (lambda a, b: jaxrod.capsule(a, b, RADIUS), HALF + RADIUS),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_solids_of_revolution_are_sums_of_discs(shape):
    make, top = SHAPES[shape]
    middle, way = np.array([0.2, -0.1, 0.4]), np.array([0.6, 0.0, 0.8])
    solid = solid_of(make(middle - HALF * way, middle + HALF * way))

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


def test_a_box_is_its_sides():
    centre, sides = np.array([-0.1, 0.2, 0.3]), np.array([0.4, 0.3, 0.8])
    solid = solid_of(jaxrod.box(tuple(centre), tuple(sides / 2)))
    a, b, c = sides**2 / 12
    assert float(solid.volume) == pytest.approx(np.prod(sides))
    np.testing.assert_allclose(solid.gyration, [b + c, a + c, a + b], rtol=1e-6)
    np.testing.assert_allclose(solid.centre, centre, rtol=1e-6)
    assert jnp.all(solid.shape.centre == 0)
