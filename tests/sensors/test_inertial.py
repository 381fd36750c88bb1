"""Accelerometers and gyroscopes against rigid motion, paths and second differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import sensors
from sensors.rods import about_y, hanging, straight

G = jaxrod.gravity((0.0, 0.0, -9.81))
STATIONS = [0.0, 0.3, 1.0]


@pytest.mark.slow
def test_a_rod_in_free_fall_feels_nothing():
    rod, state = straight()
    found = sensors.accelerometer(STATIONS, (0.01, 0.02)).read(
        jaxrod.make_scene(rod, G), state
    )
    np.testing.assert_allclose(found, 0, atol=1e-10)


@pytest.mark.slow
def test_a_pendulum_feels_centripetal_acceleration_and_gravity():
    rod, state = straight()
    spin = 3.0
    state = hanging(rod, state, spin)
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state), G)
    down = -sensors.markers(STATIONS).read(scene, state)[2]
    # d3 points down and d1 along x; the sensors are beside the axis, along d1.
    found = sensors.accelerometer(STATIONS, (0.015, 0.0)).read(scene, state)
    expected = [[-(spin**2) * 0.015] * 3, [0] * 3, -(9.81 + spin**2 * down)]
    np.testing.assert_allclose(found, np.asarray(expected), atol=1e-8)
    about_d2 = float(state.directors[1, 1, 0])
    turning = sensors.gyroscope(STATIONS).read(scene, state)
    np.testing.assert_allclose(
        turning, np.outer([0, spin * about_d2, 0], np.ones(3)), atol=1e-12
    )


def test_a_mounting_turns_the_readings():
    rod, state = straight()
    state = hanging(rod, state, 3.0)
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state), G)
    # The sensor's x axis is along d3, its z axis against d1.
    turned = (1.0, 0.0, -1.0, 0.0)
    for make in (sensors.accelerometer, sensors.gyroscope):
        plain = make(STATIONS).read(scene, state)
        mounted = make(STATIONS, orientation=turned).read(scene, state)
        expected = [plain[2], plain[1], -plain[0]]
        np.testing.assert_allclose(mounted, expected, atol=1e-12)


@pytest.mark.slow
def test_a_clamped_rod_at_rest_feels_gravity_upwards():
    rod, state = straight(direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), G)
    found = sensors.accelerometer(STATIONS).read(scene, state)[:, 0]
    np.testing.assert_allclose(found, [9.81, 0, 0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "holds_element", [True, pytest.param(False, marks=pytest.mark.slow)]
)
def test_a_driven_end_has_the_acceleration_of_its_path(holds_element):
    rod, state = straight()
    size, period, time, arm = 0.05, 0.4, 0.13, 0.02
    rate = 2 * np.pi / period
    wall = jaxrod.driven(
        state,
        displacement=jaxrod.schedules.sine((size, 0, 0), period, mean=(0.0, 0, 0)),
        axis=(0.0, 1.0, 0.0),
        angle=jaxrod.schedules.sine(0.3, period),
        holds_element=holds_element,
    )
    scene = jaxrod.make_scene(rod, wall).at(time)
    angle, spin = 0.3 * np.sin(rate * time), 0.3 * rate * np.cos(rate * time)
    # All elements turn with the wall, as a rigid body.
    turn = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0)
    q = tuple(np.asarray(state.orientations)[:, 0])
    turned = np.stack(jaxrod.extend.rotations.multiply_quaternions(turn, q))
    state = replace(state, orientations=jnp.asarray(np.outer(turned, np.ones(4))))
    state = jaxrod.with_angular_velocities(rod, state, about_y(rod, state, spin))
    frame = np.asarray(state.directors)[:, :, 0]

    def felt(*place):
        force = np.asarray(sensors.accelerometer(*place).read(scene, state))
        return np.sum(frame * force[:, None], axis=0)

    path = [-(rate**2) * size * np.sin(rate * time), 0, 0]
    np.testing.assert_allclose(felt(0.0), path, atol=1e-9)
    if not holds_element:
        return
    # In the middle of the held element an arm along d1 turns with it about y.
    d1 = frame[0] * arm
    turning = felt(0.125, (arm, 0.0)) - felt(0.125)
    faster = -(rate**2) * angle * np.asarray([d1[2], 0, -d1[0]])
    np.testing.assert_allclose(turning, faster - spin**2 * d1, atol=1e-9)


@pytest.mark.parametrize(
    ("damping", "dt", "rtol"),
    [
        pytest.param((3.0, 1.0), 1e-6, 1e-4, id="by rates"),
        # Its steps are of first order in the step.
        pytest.param(2e-3, 1e-7, 1e-3, id="internal"),
    ],
)
@pytest.mark.slow
def test_the_reading_is_the_second_difference_of_a_marker(damping, dt, rtol):
    """An arm far from balance, along two short steps."""
    inside = isinstance(damping, float)
    rod, state = straight(4, direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        G,
        jaxrod.end_load((0.0, 0.05, 0.02), (0.002, 0.0, 0.001)),
        jaxrod.internal_damping(damping)
        if inside
        else jaxrod.exponential_damping(*damping),
    )
    place = np.asarray(rod.arc_length_midpoints)
    state = jaxrod.with_angular_velocities(
        rod, state, 3 * np.stack([np.sin(place), place, place**2])
    )
    nodes = np.linspace(0, 1, 5)
    moving = np.stack([0 * nodes, np.sin(nodes), nodes**2])
    state = replace(state, velocities=jnp.asarray(moving))
    states = jaxrod.rollout(scene, state, dt, 2, every=1)
    marker = sensors.markers(0.8, (0.01, -0.015))
    path = np.asarray(jax.vmap(marker.read, (None, 0))(scene, states))
    second = (path[2] - 2 * path[1] + path[0]) / dt**2
    middle = jax.tree.map(lambda leaf: leaf[1], states)
    sensor = sensors.accelerometer(marker.arc_length, (0.01, -0.015))
    force = np.asarray(sensor.read(scene, middle))
    # All elements have turned by less than 1e-5.
    frame = np.asarray(middle.directors)[:, :, 3]
    felt = np.sum(frame * (second + np.asarray([0, 0, 9.81]))[None], axis=1)
    np.testing.assert_allclose(force, felt, rtol=rtol, atol=2e-3 if inside else 1e-4)


def test_methods_without_an_acceleration_of_their_own_are_refused():
    rod, state = straight(3)
    for method in (jaxrod.pyelastica(), jaxrod.torsion_free()):
        scene = jaxrod.make_scene(rod, G, method=method)
        for sensor in (sensors.accelerometer(0.5), sensors.gyroscope(0.5)):
            with pytest.raises(ValueError, match="consistent law with twist"):
                sensor.read(scene, state)
