"""Random scenes, drawn from a seed, for the comparison with PyElastica."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyelastica.reference import Array, Loads, RodSpec


@dataclass(frozen=True)
class Scene:
    """Everything that one comparison needs; the fields are `simulate`'s arguments."""

    spec: RodSpec
    loads: Loads
    dt: float
    clamped: bool
    damping_rate: float
    deprecated_damping: float
    velocities: Array
    angular_velocities: Array


def rotation(vector: Array) -> Array:
    """The matrix exp(-[vector]x) that turns directors by an angle vector."""
    angle = np.linalg.norm(vector)
    axis = vector / angle if angle > 0 else np.zeros(3)
    cross = np.cross(np.eye(3), axis)  # the matrix [axis]x: its rows are e_i x axis
    return np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def curved_rod(
    rest_lengths: Array,
    curvatures: Array,
    radii: Array,
    *,
    density: Array | float = 1000.0,
    youngs_modulus: float = 1e7,
    shear_modulus: float = 1e7 / 3,
    start: Array | None = None,
    first_directors: Array | None = None,
) -> RodSpec:
    """A stress-free curved rod with given material curvatures at its joints.

    Args:
        rest_lengths: [m], shape (n,).
        curvatures: two bends and a twist [1/m], shape (3, n-1).
        radii: [m], shape (n,).
        density: [kg/m^3], one number or one for each element.
        youngs_modulus: E [Pa].
        shear_modulus: G [Pa].
        start: position of node 0 [m]; the origin by default.
        first_directors: directors of element 0; the identity by default.
    """
    n = len(rest_lengths)
    directors = np.empty((3, 3, n))
    directors[..., 0] = np.eye(3) if first_directors is None else first_directors
    for j in range(n - 1):
        angle = curvatures[:, j] * (rest_lengths[j] + rest_lengths[j + 1]) / 2
        directors[..., j + 1] = rotation(angle) @ directors[..., j]
    positions = np.zeros((3, n + 1))
    positions[:, 1:] = np.cumsum(directors[2] * rest_lengths, axis=1)
    if start is not None:
        positions += np.reshape(start, (3, 1))
    return RodSpec(positions, directors, radii, density, youngs_modulus, shear_modulus)


def safe_time_step(spec: RodSpec, safety: float = 0.4) -> float:
    """A fraction of the largest stable step of the shear-rotation mode [s]."""
    lengths = np.linalg.norm(np.diff(spec.positions, axis=1), axis=0)
    shear = 27 / 28 * spec.shear_modulus
    squared = (1 / spec.radii**2) + (1 + spec.youngs_modulus / shear) / lengths**2
    return float(safety * np.min(np.sqrt(spec.density / shear / squared)))


def random_scene(seed: int, n_elements: int | None = None) -> Scene:
    """Draws a tapered, pre-curved, loaded, damped, moving rod about 1 m long.

    Args:
        seed: of the random numbers; the same seed gives the same scene.
        n_elements: 2 to 60, drawn at random if None.
    """
    random = np.random.default_rng(seed)
    drawn = int(np.exp(random.uniform(np.log(2), np.log(61))))
    n = drawn if n_elements is None else n_elements
    lengths = random.uniform(0.8, 1.2, n)
    lengths /= lengths.sum()
    middle = np.cumsum(lengths) - lengths / 2
    radii = 0.05 - random.uniform(0.0, 0.03) * middle
    if len(radii) == 2:
        radii = np.full(2, np.mean(radii))
    waves = random.uniform(-1.5, 1.5, (3, 3)) * [[1.0], [1.0], [0.5]]
    joints = (middle[1:] + middle[:-1]) / 2
    shapes = np.stack([np.ones_like(joints), np.cos(3 * joints), np.sin(5 * joints)])
    youngs_modulus = 10 ** random.uniform(6.0, 7.0)
    spec = curved_rod(
        lengths,
        waves @ shapes,
        radii,
        density=random.uniform(900.0, 1100.0, n),
        youngs_modulus=youngs_modulus,
        shear_modulus=youngs_modulus / random.uniform(2.0, 3.0),
        start=random.uniform(-0.5, 0.5, 3),
        first_directors=rotation(random.uniform(-1.5, 1.5, 3)),
    )
    stiffness = youngs_modulus * np.pi * np.min(radii) ** 4 / 4  # EI [N m^2], L = 1 m
    loads = Loads(
        gravity=random.uniform(-10.0, 10.0, 3),
        end_force=random.uniform(-0.5, 0.5, 3) * stiffness,
        uniform_force=random.uniform(-0.5, 0.5, 3) * stiffness,
        end_couple=random.uniform(-0.5, 0.5, 3) * stiffness,
        element_couples=random.uniform(-0.5, 0.5, (3, n)) * stiffness / n,
    )
    deprecated = bool(random.integers(2))
    return Scene(
        spec=spec,
        loads=loads,
        dt=safe_time_step(spec),
        clamped=bool(random.integers(4)),
        damping_rate=0.0 if deprecated else random.uniform(0.1, 5.0),
        deprecated_damping=random.uniform(0.01, 0.1) if deprecated else 0.0,
        velocities=random.uniform(-0.3, 0.3, (3, n + 1)),
        angular_velocities=random.uniform(-1.0, 1.0, (3, n)),
    )
