"""Strain, curvature, and what sections transmit, against closed forms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import sensors
from sensors.rods import (
    AREA,
    LENGTH,
    MODULUS,
    MOMENT_OF_AREA,
    PER_LENGTH,
    arc,
    hanging,
    straight,
)

STATIONS = [0.0, 0.03, 0.5, 0.77, 1.0]


@pytest.mark.parametrize("kappa", [0.7, -1.3])
def test_a_bent_rod_strains_its_fibres_by_minus_curvature_times_offset(kappa):
    rod, _ = straight(direction=(0.0, 0.0, 1.0))
    scene, state = jaxrod.make_scene(rod), arc(rod, kappa)
    gauge = sensors.strain_gauge(STATIONS, (0.015, 0.01))
    np.testing.assert_allclose(gauge.read(scene, state), -kappa * 0.015, rtol=1e-11)
    found = sensors.section_curvature(STATIONS).read(scene, state)
    np.testing.assert_allclose(found, np.outer([0, kappa, 0], np.ones(5)), atol=1e-12)
    moment = sensors.section_moment(STATIONS).read(scene, state)
    bent = MODULUS * MOMENT_OF_AREA * kappa
    np.testing.assert_allclose(moment, np.outer([0, bent, 0], np.ones(5)), atol=1e-12)


def test_a_fibre_of_a_twisted_rod_is_a_helix():
    rod, state = straight(4, direction=(0.0, 0.0, 1.0))
    angle = 2.0 * np.asarray(rod.arc_length_midpoints)
    turned = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)])
    state = replace(state, orientations=jnp.asarray(turned))
    gauge = sensors.strain_gauge(STATIONS, (0.0, 0.02))
    helix = np.sqrt(1 + (2.0 * 0.02) ** 2) - 1
    np.testing.assert_allclose(
        gauge.read(jaxrod.make_scene(rod), state), helix, rtol=1e-9
    )


def test_a_rod_that_is_curved_at_rest_has_no_strain_there():
    angle = np.linspace(0, 1, 5)
    shape = np.stack([1 - np.cos(angle), 0 * angle, np.sin(angle)])
    rod, state = jaxrod.rod_along(
        shape, radius=0.02, density=1e3, youngs_modulus=1e6, normal=(1.0, 0.0, 0.0)
    )
    scene = jaxrod.make_scene(rod)
    stations = float(rod.length) * np.asarray([0.0, 0.4, 1.0])
    gauge = sensors.strain_gauge(stations, (0.01, 0.01))
    np.testing.assert_allclose(gauge.read(scene, state), 0, atol=1e-14)
    # Straightened, the inner fibre is longer.
    straightened = jaxrod.straight_rod(
        4, length=float(rod.length), radius=0.02, density=1e3, youngs_modulus=1e6
    )[1]
    longer = 1 / (1 - 0.01 * float(rod.rest_curvatures[1, 0])) - 1
    found = sensors.strain_gauge(0.5, (0.01, 0.0)).read(scene, straightened)
    np.testing.assert_allclose(found, longer, rtol=1e-3)


def test_tension_of_a_hanging_rod_is_what_hangs_below():
    rod, state = straight()
    state = hanging(rod, state)
    scene = jaxrod.make_scene(
        rod, jaxrod.pin_support(state), jaxrod.gravity((0.0, 0.0, -9.81))
    )
    below = PER_LENGTH * 9.81 * (LENGTH - np.asarray(STATIONS))
    tension = sensors.section_force(STATIONS).read(scene, state)[2]
    np.testing.assert_allclose(tension, below, rtol=1e-9, atol=1e-11)
    held = sensors.support_force().read(scene, state)
    np.testing.assert_allclose(held, [0, 0, PER_LENGTH * 9.81 * LENGTH], atol=1e-11)
    strain = sensors.strain_gauge(STATIONS, (0.01, -0.01)).read(scene, state)
    np.testing.assert_allclose(strain, below / (MODULUS * AREA), atol=1e-12)


def curve(arc_length):
    """Place and angle of a curve in the xz plane, and its curvature, to round-off."""
    angle = lambda s: 0.8 * s - 0.25 * s**2 + 0.5 * s**3
    points, weights = np.polynomial.legendre.leggauss(20)
    along = 0.5 * arc_length[:, None] * (1 + points)
    slopes = np.stack([np.sin(angle(along)), 0 * along, np.cos(angle(along))])
    place = 0.5 * arc_length * np.sum(weights * slopes, axis=-1)
    return place, angle(arc_length), 0.8 - 0.5 * arc_length + 1.5 * arc_length**2


def on_curve(n):
    """A scene of a rod of unequal elements, and its state on the curve."""
    share = np.linspace(0, 1, n + 1)
    nodes = share + 0.1 * np.sin(np.pi * share) ** 2
    rod, state = straight(n, direction=(0.0, 0.0, 1.0))
    rod = replace(rod, rest_lengths=jnp.asarray(np.diff(nodes)))
    half = 0.5 * curve(0.5 * (nodes[1:] + nodes[:-1]))[1]
    turned = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half])
    state = replace(
        state,
        positions=jnp.asarray(curve(nodes)[0]),
        orientations=jnp.asarray(turned),
    )
    return jaxrod.make_scene(rod), state


@pytest.mark.slow
def test_interpolation_along_the_rod_is_second_order():
    stations, offset = np.linspace(0, 1, 40), 0.02
    place, angle, kappa = curve(stations)
    across = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)])
    kinds = (
        sensors.section_curvature(stations),
        sensors.strain_gauge(stations, (offset, 0.0)),
        sensors.markers(stations, (offset, 0.0)),
    )
    read = jax.jit(lambda *case: [sensor.read(*case) for sensor in kinds])
    errors = []
    for n in (12, 24):
        bent, fibre, marks = map(np.asarray, read(*on_curve(n)))
        wrong = bent[1] - kappa, fibre + offset * kappa, marks - place - offset * across
        errors.append([np.linalg.norm(part) for part in wrong])
    orders = np.log2(np.divide(*errors))
    assert np.all((orders > 1.8) & (orders < 2.3)), orders
