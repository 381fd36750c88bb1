"""A made-up arm with two tendons, and recordings of it that a camera might make."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod import twin
from jaxrod.geometry import rotations, vectors
from jaxrod.twin.identification import _evaluated, _prepared, _problem

MARKERS = {"one": (0.1, 0.02), "two": (0.17, -0.015), "three": (0.24, 0.018)}


def drawing(axes=tuple(map(tuple, np.eye(3))), **unknown):
    """A tapered arm of 30 cm with two tendons and four markers."""
    pulls = [(30.0, "left"), (150.0, "right")]
    return twin.Arm(
        elements=8,
        length=0.3,
        radius=[[0.0, 0.015], [0.3, 0.008]],
        density=1100.0,
        youngs_modulus=4e5,
        poisson_ratio=0.45,
        direction=(0.0, 0.0, -1.0),
        normal=(0.0, 1.0, 0.0),
        gravity=(0.0, 0.0, -9.81),
        damping=4.0,
        tendons=tuple(
            twin.TendonDrawing(name, np.radians(angle), [[0.0, 0.012], [0.3, 0.006]])
            for angle, name in pulls
        ),
        markers=(
            *(twin.Marker(n, at, (0.0, off, 0.0)) for n, (at, off) in MARKERS.items()),
            twin.Marker("tip", 0.3, (0.004, 0.0, 0.01)),
        ),
        unknown=unknown,
        frame=twin.Frame(axes, None if axes is None else (0.0, 0.0, 0.0)),
    )


def drawn_values(arm, rng, **given):
    """Values of the unknowns, drawn as the drawing says, except for those given."""
    values = arm.start
    for name, sd in arm.unknown.items():
        away = sd * rng.standard_normal(np.shape(values[name]))
        log = name in twin.arm.LOGARITHMIC
        values[name] = values[name] * np.exp(away) if log else values[name] + away
    return values | {name: jnp.asarray(value) for name, value in given.items()}


def pose(pull_left, pull_right, frames=40):
    """A recording at rest, without its markers."""
    inputs = np.broadcast_to(np.array([pull_left, pull_right]), (frames, 2))
    points = np.zeros((frames, 4, 3))
    return twin.Recording("pose", np.arange(frames) / 100, inputs, points)


def swing(frames=60, rate=60.0):
    """A recording of a pull that rises and falls in a second, without its markers."""
    times = np.arange(frames) / rate
    inputs = np.stack([1.5 * np.sin(3 * times) ** 2, 1.0 * (times > 0.4)], axis=1)
    return twin.Recording("swing", times, inputs, np.zeros((frames, 4, 3)))


def filmed(arm, values, recording, *, noise=0.0, missing=0.0, camera=None, rng=None):
    """The recording with the markers of an arm, as a camera sees them.

    `values` are those of `arm.start` but for its unknowns. `camera` is the rotation and
    the shift from its frame to the arm's.
    """
    frames = len(recording.times)
    still = np.all(recording.inputs == recording.inputs[:1])
    short = recording.averaged() if still else recording
    point = _problem(arm, ()).parameters.searched(values)
    points = _evaluated(arm, point, _prepared(arm, short))[0]
    assert np.all(np.isfinite(points))
    points = np.array(np.broadcast_to(points, (frames, *points.shape[1:])))
    if rng is None:
        return replace(recording, points=points)
    points = points + noise * rng.standard_normal(points.shape)
    points[rng.random(points.shape[:2]) < missing] = np.nan
    turn, shift = camera
    points = np.sum((points - shift)[..., None] * turn, axis=-2)
    order = rng.permutation(points.shape[1])
    return replace(recording, points=points[:, order], labelled=False), order


def a_camera(rng):
    """A rotation from a camera's frame to the arm's, drawn from all, and a shift."""
    turn = rng.standard_normal(3)
    turn = turn / np.linalg.norm(turn) * rng.uniform(0, np.pi)
    with jax.enable_x64(True):
        quaternion = rotations.rotation_exp(vectors.split(jnp.asarray(turn)))
        axes = rotations.directors(quaternion)
        return np.array(axes).T, rng.uniform(-1, 1, 3)
