"""Laws of every sensor: units, frames, derivatives, batches, stations off the rod.

One arm is bent, moves and touches a ball; it has all that sensors measure.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import sensors
from jaxrod.extend import rotations

# The ball is too soft to carry the arm: it is there to be pushed into.
pytestmark = pytest.mark.filterwarnings("ignore::jaxrod.UnlikelyWarning")
N = 4
TURN = np.asarray([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])


def turned(vector, turn):
    """World vectors `(3, ...)` turned by a quaternion."""
    flat = np.asarray(vector, float).reshape(3, -1)
    frame = rotations.directors(tuple(turn))
    return np.stack(rotations.to_world(frame, tuple(flat))).reshape(np.shape(vector))


def arm(unit=1.0, turn=(1.0, 0.0, 0.0, 0.0)):
    """Scene, state and sensors, in another unit of length or turned as a whole.

    Args:
        unit: Number of units of length in a metre.
        turn: Quaternion by which the world is turned.
    """
    way = lambda vector: tuple(unit * turned(vector, turn))
    rod, straight = jaxrod.straight_rod(
        N,
        length=unit,
        radius=0.03 * unit,
        density=1e3 / unit**3,
        youngs_modulus=1e6 / unit,
        direction=turned((0.0, 0.0, 1.0), turn),
        normal=turned((1.0, 0.0, 0.0), turn),
    )
    s = np.linspace(0, 1, N + 1)
    nodes = 1.02 * np.stack([0.3 * s**2, 0.1 * s**3, s - 0.1 * s**2])
    lean = np.stack([0.1 * s[1:], 0.25 * s[1:], 0.2 - 0.3 * s[1:]])
    lean = turned(lean, turn)
    tilt = jnp.stack(rotations.rotation_exp(tuple(jnp.asarray(lean))))
    orientations = rotations.multiply_quaternions(
        tuple(tilt), tuple(straight.orientations)
    )
    state = replace(
        straight,
        positions=jnp.asarray(unit * turned(nodes, turn)),
        orientations=jnp.stack(orientations),
        velocities=jnp.asarray(unit * turned(nodes[[1, 2, 0]] * s, turn)),
    )
    spins = np.stack([np.cos(s[1:]), s[1:], 0.5 + s[1:] ** 2])
    state = jaxrod.with_angular_velocities(rod, state, spins)
    ball = jaxrod.shapes.sphere(way((0.38, 0.01, 0.5)), 0.3 * unit)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(straight),
        jaxrod.gravity(way((0.0, 1.0, -9.81))),
        jaxrod.actuation.tendon(
            rod,
            [(0.02 * unit, 0.0), (0.0, 0.01 * unit)],
            length=0.6 * unit,
            stiffness=30.0,
        ),
        jaxrod.actuation.chamber(
            rod, 1e3 / unit, 1e-4 * unit**2, offsets=(0.01 * unit, 0.0)
        ),
        jaxrod.contact(ball, stiffness=20.0 / unit),
    )
    eye = sensors.camera(
        way((0.2, -1.5, 0.6)),
        way((0.2, 0.0, 0.5)),
        focal_length=20.0,
        principal_point=(8.0, 10.0),
        up=turned((0.0, 0.0, 1.0), turn),
    )
    stations = unit * np.asarray([0.05, 0.4, 1.0])
    beside = unit * np.asarray([[0.02, 0.0], [0.0, 0.03], [-0.01, 0.01]])
    mounting = (0.8, 0.1, -0.2, 0.5)
    kinds = [
        sensors.strain_gauge(stations, beside),
        sensors.section_curvature(stations),
        sensors.section_force(stations),
        sensors.section_moment(stations),
        sensors.accelerometer(stations, beside, orientation=mounting),
        sensors.gyroscope(stations, orientation=mounting),
        sensors.support_force(),
        sensors.support_couple(),
        sensors.tendon_length(2),
        sensors.tendon_tension(2),
        sensors.chamber_pressure(3),
        sensors.contact_force(),
        sensors.contact_force(per_node=True),
        sensors.markers(stations, beside),
        sensors.image_markers(eye, stations, beside),
        sensors.depth_image(eye, 20, 16, max_range=5.0 * unit),
    ]
    return scene, state, kinds


@jax.jit
def read(scene, state, kinds):
    return [sensor.read(scene, state) for sensor in kinds]


def close(found, wanted, rtol):
    """Equal but for rounding, in proportion to the largest number of a reading."""
    assert found.shape == wanted.shape
    size = np.max(np.abs(wanted))
    assert size > 0
    np.testing.assert_allclose(found, wanted, rtol=0, atol=rtol * size)


POWERS = {
    "1": 0,
    "1/m": -1,
    "m": 1,
    "m/s^2": 1,
    "rad/s": 0,
    "N": 1,
    "N m": 2,
    "Pa": -1,
    "pixel": 0,
}
"""Powers of the unit of length in readings, with mass and time as they are."""


@pytest.mark.slow
def test_every_sensor_is_here_and_says_its_shape():
    scene, _, kinds = arm()
    listed = {type(sensor).__name__ for sensor in kinds}
    public = {n for n in sensors.__all__ if n[0].isupper()}
    assert listed == public - {"Sensor", "Camera"}
    shapes = [sensor.shape(scene) for sensor in kinds]
    each, vector = (3, 3), (3,)
    assert shapes == [
        *((3,), each, each, each, each, each),
        *(vector, vector, (2,), (2,), (1,), vector, (3, N + 1)),
        *(each, (2, 3), (20, 16)),
    ]
    assert all(sensor.name and sensor.unit in POWERS for sensor in kinds)


@pytest.mark.slow
def test_readings_in_millimetres_are_those_in_metres():
    scene, state, kinds = arm()
    for sensor, one, other in zip(
        kinds, read(scene, state, kinds), read(*arm(1e3)), strict=True
    ):
        close(other, 1e3 ** POWERS[sensor.unit] * one, 1e-9)


@pytest.mark.slow
def test_readings_turn_with_the_world_or_stay_as_they_are():
    scene, state, kinds = arm()
    in_world = ("SupportForce", "SupportCouple", "ContactForce", "Markers")
    for sensor, one, other in zip(
        kinds, read(scene, state, kinds), read(*arm(turn=TURN)), strict=True
    ):
        wanted = turned(one, TURN) if type(sensor).__name__ in in_world else one
        close(other, np.asarray(wanted), 1e-9)


@pytest.mark.slow
def test_derivatives_in_both_modes_are_central_differences():
    scene, state, kinds = arm()
    key = jax.random.split(jax.random.key(0), len(jax.tree.leaves(state)))
    leaves, tree = jax.tree.flatten(state)
    way = tree.unflatten(
        [jax.random.normal(k, leaf.shape) for k, leaf in zip(key, leaves, strict=True)]
    )
    # Angular momenta are small: a rod's elements hardly turn by themselves.
    way = replace(way, angular_momenta=1e-4 * way.angular_momenta)
    of_state = lambda given: read(scene, given, kinds)
    step = 1e-6
    moved = lambda size: jax.tree.map(lambda a, b: a + size * b, state, way)
    ahead, behind = of_state(moved(step)), of_state(moved(-step))
    finite = [(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
    slopes = jax.jit(lambda: jax.jvp(of_state, (state,), (way,))[1])()
    for slope, wanted, reading in zip(slopes, finite, ahead, strict=True):
        if np.any(wanted):
            close(slope, wanted, 2e-6 if reading.ndim < 2 else 1e-5)
        else:
            np.testing.assert_array_equal(slope, 0)
    still = [
        sensor.name for sensor, s in zip(kinds, slopes, strict=True) if not s.any()
    ]
    assert still == ["chamber pressure"]
    weights = [jnp.cos(1.0 + jnp.arange(s.size)).reshape(s.shape) for s in slopes]
    back = jax.jit(lambda: jax.vjp(of_state, state)[1](weights)[0])()
    pair = lambda a, b: sum(
        jnp.sum(x * y)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )
    np.testing.assert_allclose(pair(back, way), pair(weights, slopes), rtol=1e-9)


@pytest.mark.slow
def test_a_batch_is_a_loop_and_a_straight_rod_has_finite_derivatives():
    scene, state, kinds = arm()
    rod = scene.rod
    _, straight = jaxrod.straight_rod(
        N, length=1.0, radius=0.03, density=1e3, youngs_modulus=1e6, normal=(1, 0, 0)
    )
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, straight)
    of_one = lambda given: read(scene, given, kinds)
    batch = jax.jit(jax.vmap(of_one))(both)
    for number, one in enumerate((state, straight)):
        for together, alone in zip(batch, of_one(one), strict=True):
            size = np.max(np.abs(alone))
            np.testing.assert_allclose(
                together[number], alone, rtol=0, atol=1e-9 * size + 1e-12
            )
    total = lambda given: sum(jnp.sum(reading) for reading in of_one(given))
    slope = jax.jit(jax.grad(total))(straight)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))
    assert rod.n_elements == N


def test_stations_off_the_rod_are_refused_or_nan():
    scene, state, _ = arm()
    for make in (sensors.strain_gauge, sensors.markers, sensors.gyroscope):
        with pytest.raises(ValueError, match=r"at most the rod's length, 1 m, got 1.2"):
            make([0.5, 1.2]).read(scene, state)
        with pytest.raises(ValueError, match="arc_length must be non-negative"):
            make(-0.1)
    gauge = sensors.strain_gauge([0.5, 1.2])
    found = jax.jit(lambda given: given.measure(scene, state))(gauge)
    np.testing.assert_array_equal(np.isnan(found), [False, True])


def test_a_rod_of_two_elements_has_one_curvature():
    rod, state = jaxrod.straight_rod(
        2, length=1.0, radius=0.03, density=1e3, youngs_modulus=1e6
    )
    half = np.asarray([-0.1, 0.1])
    bent = jnp.asarray(np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half]))
    identity = replace(state, orientations=bent)
    found = sensors.section_curvature([0.0, 0.3, 1.0]).read(
        jaxrod.make_scene(rod), identity
    )
    np.testing.assert_allclose(
        found, np.outer([0, 0.8, 0], np.ones(3)), rtol=1e-12, atol=1e-14
    )
