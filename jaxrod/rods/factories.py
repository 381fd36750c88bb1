"""Factories of rods: they run on the host, check their arguments and take SI units."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.geometry.material_frames import (
    check_frames,
    module_for,
    quaternions,
    straight_frame,
    transported_frames,
    unit_vector,
)
from jaxrod.geometry.rotations import split_quaternion
from jaxrod.geometry.vectors import inner_difference, join, split
from jaxrod.rods.elasticity import joint_rotations, shear_stretch
from jaxrod.rods.rod import JointMean, MassMatrix, Rod, RodState, check_state
from jaxrod.rods.sections import Section, rod_of_section
from jaxrod.validation import (
    Numbers,
    check_array,
    check_count,
    check_dtype,
    is_traced,
    numeric,
)

MOST_ELEMENTS = 1_000_000
"""Largest number of elements; a larger number must be a mistake."""
ROUNDED = 0.01
"""Largest allowed spacing of floating-point node positions, divided by the element
length [1]."""


def straight_rod(
    n_elements: int,
    *,
    length: Numbers,
    radius: Numbers | None = None,
    section: Section | None = None,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None = None,
    poisson_ratio: Numbers = 0.5,
    shear_correction: Numbers | None = None,
    joint_mean: JointMean = "arithmetic",
    mass_matrix: MassMatrix = "lumped",
    start: Numbers = (0.0, 0.0, 0.0),
    direction: Numbers = (0.0, 0.0, 1.0),
    normal: Numbers | None = None,
    dtype: Any = None,
) -> tuple[Rod, RodState]:
    """A straight, unstressed rod at rest.

    Args:
        n_elements: Number of elements, at least 2.
        length: Rest length [m].
        radius: Radius [m]: one number, one per element `(n,)`, or the pair `(2,)` of
            base and tip radius, between which it varies linearly along the rod. With
            2 elements a pair would be ambiguous, so only one number is allowed.
        section: Shape of the sections instead of a radius: `circle`, `tube`,
            `rectangle` or `ellipse`.
        density: Mass density [kg/m^3], one number or one per element.
        youngs_modulus: Young's modulus [Pa], one number or one per element.
        shear_modulus: Shear modulus [Pa]; by default
            `youngs_modulus / (2 (1 + poisson_ratio))`.
        poisson_ratio: Poisson's ratio [1], used if no shear modulus is given.
        shear_correction: Timoshenko's shear correction factor [1]; by default that of
            the section, 27/28 for a circle.
        joint_mean: Mean of two elements' stiffnesses at their joint: "arithmetic", as
            in PyElastica; or "series", that of springs in series, which is better
            if materials change by more than a few times.
        mass_matrix: "lumped", masses at the nodes; or "higher_order", coupled along
            elements, with smaller errors of swings and of waves of stretch.
        start: Position of the first node [m].
        direction: Direction from first to last node; any length but zero.
        normal: Direction of d1; its component along `direction` is removed. By default
            the world axis that is most nearly perpendicular to `direction`.
        dtype: float32 or float64; by default JAX's default.

    Returns:
        The rod and its state.

    Raises:
        ValueError: If an argument is out of range or has the wrong shape, or if the
            dtype cannot represent it or derived numbers (masses and stiffnesses of
            elements).

    Example:
        >>> arm, start = jaxrod.straight_rod(
        ...     20, length=0.5, radius=(0.02, 0.01), density=1000.0, youngs_modulus=1e6
        ... )
        >>> arm.n_elements, start.tip.round(3).tolist()
        (20, [0.0, 0.0, 0.5])
        >>> bool(arm.radii[0] > arm.radii[-1])  # it tapers
        True
    """
    n = check_count("n_elements", n_elements, 2, MOST_ELEMENTS)
    dtype = check_dtype(dtype)
    extent = check_array("length", length, [()], "m", positive=True, dtype=dtype)
    origin = check_array("start", start, [(3,)], "m", dtype=dtype)
    axis = unit_vector("direction", direction)
    frame = straight_frame(axis, normal)
    fractions = np.linspace(0.0, 1.0, n + 1)
    along = extent * axis[:, None] * fractions[None, :]
    return _build(
        "start",
        origin[:, None] + along,
        module_for(frame).repeat(quaternions(frame[:, :, None]), n, axis=1),
        rest_lengths=extent * np.full(n, 1 / n),
        radius=radius,
        section=section,
        joint_mean=joint_mean,
        mass_matrix=mass_matrix,
        density=density,
        youngs_modulus=youngs_modulus,
        shear_modulus=shear_modulus,
        poisson_ratio=poisson_ratio,
        shear_correction=shear_correction,
        dtype=dtype,
        straight=True,
    )


def rod_along(
    positions: Numbers,
    *,
    radius: Numbers | None = None,
    section: Section | None = None,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None = None,
    poisson_ratio: Numbers = 0.5,
    shear_correction: Numbers | None = None,
    joint_mean: JointMean = "arithmetic",
    mass_matrix: MassMatrix = "lumped",
    normal: Numbers | None = None,
    directors: Numbers | None = None,
    dtype: Any = None,
) -> tuple[Rod, RodState]:
    """A rod whose unstressed shape follows a given polyline, at rest.

    The material frames are carried along the curve without twist (parallel
    transport) unless they are given. Curvature, twist and shear of this shape become
    the rod's rest values: the rod is pre-curved, not bent.

    Args:
        positions: Nodes of the rest shape `(3, n + 1)` [m], n at least 2.
        radius: Radius, as in `straight_rod`.
        section: Shape of the sections, as in `straight_rod`.
        density: Mass density, as in `straight_rod`.
        youngs_modulus: Young's modulus, as in `straight_rod`.
        shear_modulus: Shear modulus, as in `straight_rod`.
        poisson_ratio: Poisson's ratio, as in `straight_rod`.
        shear_correction: Shear correction factor, as in `straight_rod`.
        joint_mean: Mean of stiffnesses at joints, as in `straight_rod`.
        mass_matrix: Masses at nodes alone or coupled, as in `straight_rod`.
        normal: Direction of d1 of the first element; see `straight_rod`.
        directors: Material frames `(3, 3, n)`, instead of `normal`. Entry `[i, j]` is
            world component j of director i. They are orthonormal and right-handed, with
            d3 within 10 degrees of the rod's direction.
        dtype: float32 or float64; by default JAX's default.

    Returns:
        The rod and its state.

    Raises:
        ValueError: If an argument is out of range or has the wrong shape, or if the
            dtype cannot represent it or derived numbers (masses and stiffnesses of
            elements).

    Example:
        >>> angle = jnp.linspace(0.0, jnp.pi, 11)
        >>> arc = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle])
        >>> hook, start = jaxrod.rod_along(
        ...     arc, radius=0.02, density=1000.0, youngs_modulus=1e6
        ... )
        >>> bool(jaxrod.stored_energy(hook, start) < 1e-9)
        True
    """
    nodes = numeric("positions", positions, "m")
    if nodes.ndim != 2 or nodes.shape[0] != 3 or nodes.shape[1] < 3:
        raise ValueError(
            "positions must have shape (3, n + 1) with n >= 2, in metres, "
            f"got {nodes.shape}"
        )
    dtype = check_dtype(dtype)
    check_array("positions", nodes, [nodes.shape], "m", dtype=dtype)
    n = check_count("n_elements", nodes.shape[1] - 1, 2, MOST_ELEMENTS)
    xp = module_for(nodes)
    with np.errstate(over="ignore"):
        edges = nodes[:, 1:] - nodes[:, :-1]
        lengths = xp.sqrt(xp.sum(edges * edges, axis=0))
    distances = "distance between neighbouring nodes"
    check_array(distances, lengths, [(n,)], "m", positive=True, dtype=dtype)
    tangents = edges / lengths[None, :]
    if directors is None:
        frames = transported_frames(tangents, normal)
    else:
        frames = check_frames(directors, tangents)
    return _build(
        "positions",
        nodes,
        quaternions(frames),
        rest_lengths=lengths,
        radius=radius,
        section=section,
        joint_mean=joint_mean,
        mass_matrix=mass_matrix,
        density=density,
        youngs_modulus=youngs_modulus,
        shear_modulus=shear_modulus,
        poisson_ratio=poisson_ratio,
        shear_correction=shear_correction,
        dtype=dtype,
        straight=False,
    )


def _build(
    placed_by: str,
    positions: Any,
    orientations: Any,
    *,
    rest_lengths: Any,
    radius: Numbers | None,
    section: Section | None,
    joint_mean: JointMean,
    mass_matrix: MassMatrix,
    density: Numbers,
    youngs_modulus: Numbers,
    shear_modulus: Numbers | None,
    poisson_ratio: Numbers,
    shear_correction: Numbers | None,
    dtype: Any,
    straight: bool,
) -> tuple[Rod, RodState]:
    n = orientations.shape[1]
    if (radius is None) == (section is None):
        raise ValueError("give either a radius or a section, such as jaxrod.tube")
    if joint_mean not in ("arithmetic", "series"):
        raise ValueError(
            f'joint_mean must be "arithmetic" or "series", got {joint_mean!r}'
        )
    rod = rod_of_section(
        n,
        rest_lengths=rest_lengths,
        middles=_middles(n if straight else rest_lengths),
        radius=radius,
        section=section,
        density=density,
        youngs_modulus=youngs_modulus,
        shear_modulus=shear_modulus,
        poisson_ratio=poisson_ratio,
        shear_correction=shear_correction,
        dtype=dtype,
    )
    if mass_matrix not in ("lumped", "higher_order"):
        raise ValueError(
            f'mass_matrix must be "lumped" or "higher_order", got {mass_matrix!r}'
        )
    rod = dataclasses.replace(rod, joint_mean=joint_mean, mass_matrix=mass_matrix)
    if not is_traced(positions, rest_lengths):
        _check_resolved(placed_by, positions, rest_lengths, dtype)
    state = RodState(
        positions=jnp.asarray(positions, dtype),
        orientations=jnp.asarray(orientations, dtype),
        velocities=jnp.asarray(np.zeros((3, n + 1), dtype)),
        angular_momenta=jnp.asarray(np.zeros((3, n), dtype)),
    )
    return (rod if straight else unstressed(rod, state)), state


def _middles(elements: Any) -> Any:
    """Arc-length positions of element midpoints, divided by the rod's length [1].

    Args:
        elements: Number of elements of equal length, or lengths of elements [m].

    Returns:
        The positions, one per element `(n,)`.
    """
    if isinstance(elements, int):
        return (np.arange(elements) + 0.5) / elements
    xp = module_for(elements)
    ends = xp.cumsum(elements)
    return (ends - 0.5 * elements) / ends[-1]


def _check_resolved(
    name: str, positions: np.ndarray, rest_lengths: np.ndarray, dtype: Any
) -> None:
    """Raises if elements are not much longer than the round-off of node positions.

    `name` is the name of the argument in the message.
    """
    farthest = np.max(np.abs(positions)).astype(dtype)
    shortest, apart = np.min(rest_lengths), np.spacing(farthest)
    if apart > ROUNDED * shortest:
        raise ValueError(
            f"{name} must be nearer to the origin: {farthest:.3g} m from it, positions "
            f"in {np.dtype(dtype)} are {apart:.2g} m apart, and elements are "
            f"{shortest:.2g} m long"
        )


def unstressed(rod: Rod, state: RodState) -> Rod:
    """Copy of the rod for which the given state is free of stress.

    Sets rest strains and rest curvatures, but not rest lengths, to those of the state.

    Raises:
        TypeError: If the arguments are not a rod and a state.
        ValueError: If the state does not match that rod.

    Example:
        >>> longer = replace(state, positions=1.01 * state.positions)
        >>> round(float(jaxrod.stored_energy(rod, longer)), 3)
        0.063
        >>> relaxed = jaxrod.unstressed(rod, longer)
        >>> round(float(jaxrod.stored_energy(relaxed, longer)), 3)
        0.0
    """
    check_state(rod, state)
    return _as_it_is(rod, state)


@jax.jit
def _as_it_is(rod: Rod, state: RodState) -> Rod:
    orientation = split_quaternion(state.orientations)
    edges = inner_difference(split(state.positions))
    strains = shear_stretch(edges, orientation, 1 / rod.rest_lengths)
    bends, _ = joint_rotations(orientation)
    return dataclasses.replace(
        rod,
        rest_strains=join(strains),
        rest_curvatures=join(bends) / rod.joint_lengths[None, :],
    )
