r"""Natural frequencies of small motions about a configuration: the highest, and all.

With $z$ a small displacement of nodes and rotation of elements, loads change by $-Kz$,
and $\omega^2$ are the eigenvalues of $M^{-1}K$. The largest is found from the action of
$K$ alone, a forward-mode derivative of the loads. A Krylov space is built from a random
motion, and the largest eigenvalue in it is taken. (Arnoldi's method is used instead of
Lanczos', because PyElastica's loads have no potential.) The only dense matrix is the
small one of that space. All loads on the rod are included: the scene's elastic law at
this deformation, walls, user-defined effects.

All frequencies of a rod at rest come from the dense eigenvalue problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import multiply_quaternions, rotation_exp
from jaxrod.loaded_rod import (
    LoadedRod,
    MassCoupling,
    free_velocity_mask,
    scene_of,
)
from jaxrod.model import Model, check_model
from jaxrod.rods.motion import Motion, motion_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.statics.degrees_of_freedom import degrees_of_freedom
from jaxrod.structure import pytree
from jaxrod.validation import check_count, is_traced, knows_constants

InertiaFactors = tuple[Array, Array]
"""Factors that multiply node masses `(n + 1,)` and rotary inertias `(n,)`, for a bound
that includes damping."""

KRYLOV_SIZE = 32
MOST_VECTORS = 10_000
"""Largest size of the Krylov space; a larger one must be a mistake."""
_SQUARINGS = 12


@pytree
class Vibration:
    """The fastest small motion about a configuration."""

    angular_frequency: Float[Array, ""]
    """Angular frequency [rad/s]."""
    displacements: Float[Array, "3 n+1"]
    """Displacements of the nodes times the square roots of their masses, world frame.
    Their squares are fractions of the kinetic energy [1]."""
    turns: Float[Array, "3 n"]
    """Rotations of the elements times the square roots of their inertias, material
    frame. Their squares are fractions of the kinetic energy [1]."""


def highest_frequency(
    scene: LoadedRod, state: RodState, *, size: int = KRYLOV_SIZE
) -> Float[Array, ""]:
    """Highest angular frequency of small undamped motions about a state.

    An explicit step `h` is stable if `h * highest_frequency < 2`. Velocities and
    damping do not enter. It costs about as much as `size` steps and works inside jit
    and vmap. `stable_dt(scene, state=state)` uses it and adds the effect of damping.

    Args:
        scene: The scene.
        state: The configuration, deformed or not, in equilibrium or not.
        size: Dimension of the Krylov space, at least 2. With the default the error is
            below one per cent.

    Returns:
        The angular frequency [rad/s].

    Raises:
        ValueError: If `size` is less than 2, or the state does not match the scene's
            rod.

    Example:
        >>> fastest = jaxrod.highest_frequency(scene, state)
        >>> bool(fastest <= jaxrod.stable_dt(scene).angular_frequency)  # the bound
        True
    """
    scene = scene_of(scene, state)
    size = check_count("size", size, 2, MOST_VECTORS)
    return _measure(scene, state, size).angular_frequency


@knows_constants
def natural_frequencies(
    scene: Model, state: Any, n_modes: int | None = None
) -> np.ndarray:
    """Angular frequencies of small undamped motions about a state at rest.

    They come from the dense eigenvalue problem of all degrees of freedom (`6 n + 3` for
    a rod), without those that constraints hold, without twist in a scene of
    `torsion_free()`, and without motions out of the plane of `planar()`. Use it to
    examine a rod or a system, not inside a loop. A straight rod of round section bends
    in the same way in two planes and has its bending frequencies twice. The frequencies
    of a free rod start with the six zeros of rigid motions.

    Args:
        scene: The scene, with the consistent law (any method but `pyelastica()`), or
            the system.
        state: The configuration, in equilibrium.
        n_modes: Number of modes, the lowest ones; by default all.

    Returns:
        Angular frequencies, increasing `(n_modes,)` [rad/s]; zero for motions without
        (or with negative) stiffness.

    Raises:
        ValueError: If the scene's loads have no potential, there are fewer than
            `n_modes` modes, or anything is traced.
        TypeError: If `scene` or `state` has the wrong type.

    Example:
        >>> first = jaxrod.natural_frequencies(scene, state, 3)  # [rad/s]
        >>> first.shape, bool(abs(first[0] / first[1] - 1) < 1e-3)  # two planes
        ((3,), True)
    """
    check_model(scene)
    if n_modes is not None:
        n_modes = check_count("n_modes", n_modes, 1)
    if is_traced(scene, state):
        raise ValueError(
            "natural_frequencies needs numbers that are known, not traced by jax.jit, "
            "grad or vmap; highest_frequency works inside them"
        )
    frequencies = np.sqrt(np.maximum(scene.squared_frequencies(state), 0))
    if n_modes is None:
        return frequencies
    if n_modes > frequencies.size:
        raise ValueError(
            f"n_modes must be at most {frequencies.size}, the free motions of this "
            f"scene, got {n_modes}"
        )
    return frequencies[:n_modes]


def squared_frequencies(scene: LoadedRod, state: RodState) -> np.ndarray:
    """Squares of all angular frequencies of a rod, increasing [rad^2/s^2]."""
    scene = scene_of(scene, state).without_slip
    if not scene.method.has_energy:
        raise ValueError(
            f"natural_frequencies needs the consistent law, got {scene.method!r}: "
            "PyElastica's loads are not the gradient of an energy"
        )
    matrix = np.asarray(_stiffness(scene, state), np.float64)
    free = np.asarray(free_motions(scene, state))
    matrix = matrix[np.ix_(free, free)]
    if scene.method.normal_axis is not None:
        basis = _motions_in_plane(scene, state, scene.method.normal_axis)[free]
        # Motions that are held have nothing left.
        sizes = np.sqrt(np.sum(basis**2, axis=0))
        basis = basis[:, sizes > 0] / sizes[sizes > 0]
        matrix = basis.T @ matrix @ basis
    squares: np.ndarray
    if scene.rod.mass_matrix == "higher_order":
        # Scaled by lumped masses the matrix is similar to a symmetric one.
        squares = np.sort(np.linalg.eigvals(matrix).real)
    else:
        squares = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    return squares


def _motions_in_plane(scene: LoadedRod, state: RodState, normal: int) -> np.ndarray:
    """Motions in a plane, a column each: displacements, and rotations about the normal.

    Coordinates are those of `linearised`, scaled by the square root of inertia.
    """
    n = scene.rod.n_elements
    across = np.repeat(np.arange(3) == normal, n + 1)
    nodes = np.eye(6 * n + 3)[:, : 3 * n + 3][:, ~across]
    about = np.asarray(state.directors, np.float64)[:, normal]
    about = about * np.sqrt(np.asarray(scene.rod.principal_inertias, np.float64))
    turns = np.zeros((6 * n + 3, n))
    for axis in range(3):
        turns[3 * n + 3 + axis * n + np.arange(n), np.arange(n)] = about[axis]
    return np.concatenate([nodes, turns], axis=1)


@jax.jit(static_argnames="size")
def _measure(scene: LoadedRod, state: RodState, size: int) -> Vibration:
    return fastest_vibration(scene, state, no_damping(scene.rod), size)


def no_damping(rod: Rod) -> InertiaFactors:
    """Inertia factors without damping: one for every node and every element."""
    return jnp.ones_like(rod.node_masses), jnp.ones_like(rod.rest_lengths)


def fastest_vibration(
    scene: LoadedRod,
    state: RodState,
    inertia_factors: InertiaFactors,
    size: int = KRYLOV_SIZE,
) -> Vibration:
    """Fastest motion with inertias multiplied by the given factors.

    Args:
        scene: The scene.
        state: The configuration.
        inertia_factors: Factors of node masses `(n + 1,)` and rotary inertias `(n,)`.
        size: Dimension of the Krylov space.
    """
    n = scene.rod.n_elements
    apply = linearised(scene, state, inertia_factors)
    start = jax.random.normal(jax.random.key(0), (6 * n + 3,), state.positions.dtype)
    basis, projected = krylov(apply, start, size)
    largest, weights = largest_eigenvalue(projected)
    motion = jnp.sum(weights[:, None] * basis, axis=0)
    motion = motion / jnp.sqrt(jnp.sum(motion**2))
    nodes, elements = motion[: 3 * n + 3], motion[3 * n + 3 :]
    return Vibration(
        angular_frequency=jnp.sqrt(largest),
        displacements=nodes.reshape(3, n + 1),
        turns=elements.reshape(3, n),
    )


def linearised(
    scene: LoadedRod,
    state: RodState,
    inertia_factors: InertiaFactors,
) -> Callable[[Array], Array]:
    """Linear map of small motions, M^(-1/2) K M^(-1/2): minus their accelerations.

    Coordinates are node displacements, then rotations, scaled by the square root of
    inertia. In them the map is symmetric if the loads have a potential and masses are
    lumped.
    """
    rod = scene.rod
    n = rod.n_elements
    masses = inertia_factors[0] * rod.node_masses
    inertia = inertia_factors[1][None, :] * rod.principal_inertias
    root = jnp.sqrt(jnp.concatenate([masses, masses, masses, jnp.ravel(inertia)]))
    still = motion_of(state).at_rest
    coupling = MassCoupling.of(rod)
    free_nodes, _ = free_velocity_mask(scene, still)

    def take_apart(flat: Array) -> tuple[vectors.Vec3, vectors.Vec3]:
        nodes = flat[: 3 * n + 3].reshape(3, n + 1)
        elements = flat[3 * n + 3 :].reshape(3, n)
        return vectors.split(nodes), vectors.split(elements)

    def loads_after(flat: Array) -> Array:
        displacement, turn = take_apart(flat)
        orientation = multiply_quaternions(still.orientation, rotation_exp(turn))
        moved = replace(
            still,
            position=vectors.add(still.position, displacement),
            orientation=orientation,
        )
        loads = scene.method.loads(scene, moved)
        assert loads.forces is not None and loads.couples is not None
        forces, couples = loads.forces, loads.couples
        if coupling is not None:
            sped = vectors.scale(coupling.inverse_masses, forces)
            forces = coupling.added(forces, vectors.multiply(free_nodes, sped))
        if scene.method.has_energy:
            # Change of the couples due to rotating frames, symmetrised.
            fixed = vectors.split(lax.stop_gradient(vectors.join(couples)))
            half = vectors.scale(0.5, vectors.cross(turn, fixed))
            couples = vectors.add(couples, half)
        return jnp.concatenate([*forces, *couples])

    _, change = jax.linearize(loads_after, jnp.zeros_like(root))

    free = _flags(scene, still) / root

    def apply(motion: Array) -> Array:
        # Barriers: without them XLA's CPU compiler takes minutes to fuse the map with
        # the surrounding code.
        motion = lax.optimization_barrier(free * lax.optimization_barrier(motion))
        return -free * lax.optimization_barrier(change(motion))

    return apply


def krylov(
    apply: Callable[[Array], Array], start: Array, size: int
) -> tuple[Float[Array, "size motions"], Float[Array, "size size"]]:
    """Orthonormal basis of `start, A start, A A start, ...`, and A within it.

    A is the linear map `apply`. Once the space is exhausted the remaining vectors are
    zero.
    """
    # Below this fraction of a vector its remainder is round-off.
    negligible = 100 * jnp.finfo(start.dtype).eps

    def extend(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        basis, projected = carry
        image = apply(basis[k])
        whole = _norm(image)
        column = jnp.zeros_like(projected[:, 0])
        # Orthogonalised twice, which suffices for full precision.
        for _ in range(2):
            overlaps = jnp.sum(basis * image[None, :], axis=1)
            image = image - jnp.sum(overlaps[:, None] * basis, axis=0)
            column = column + overlaps
        left = _norm(image)
        more = left > negligible * whole
        following = jnp.where(more, image / jnp.where(more, left, 1), 0)
        column = column.at[k + 1].set(jnp.where(more, left, 0), mode="drop")
        basis = basis.at[k + 1].set(following, mode="drop")
        return basis, projected.at[:, k].set(column)

    basis = jnp.zeros((size, start.size), start.dtype).at[0].set(start / _norm(start))
    return lax.fori_loop(0, size, extend, (basis, jnp.zeros((size, size), start.dtype)))


def largest_eigenvalue(matrix: Array) -> tuple[Array, Array]:
    """Largest modulus of an eigenvalue of a small matrix, and its eigenvector.

    It is computed by repeated squaring, which works for any matrix on any device.
    """

    def square(k: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        power, logarithm = carry
        power = jnp.sum(power[:, :, None] * power[None, :, :], axis=1)
        size = _norm(power)
        return power / size, logarithm + jnp.log(size) * 0.5 ** (k + 1.0)

    size = _norm(matrix)
    power, logarithm = lax.fori_loop(
        0, _SQUARINGS, square, (matrix / size, jnp.zeros_like(size))
    )
    # A high power of the matrix maps everything onto the eigenvector.
    column = jnp.argmax(jnp.sum(power**2, axis=0))
    return size * jnp.exp(logarithm), power[:, column]


def _norm(a: Array) -> Array:
    # In units of the largest entry: for small, stiff rods the squares of squared
    # frequencies overflow float32.
    unit = lax.stop_gradient(jnp.max(jnp.abs(a)))
    unit = jnp.where(unit > 0, unit, 1)
    return unit * jnp.sqrt(jnp.sum((a / unit) ** 2))


@jax.jit
def _stiffness(scene: LoadedRod, state: RodState) -> jax.Array:
    """Matrix M^(-1/2) K M^(-1/2) of all degrees of freedom [rad^2/s^2]."""
    apply = linearised(scene, state, no_damping(scene.rod))
    size = state.positions.size + state.angular_momenta.size
    return jax.vmap(apply)(jnp.eye(size, dtype=state.positions.dtype))


@jax.jit
def free_motions(scene: LoadedRod, state: RodState) -> jax.Array:
    """Flags of degrees of freedom: true if free; node displacements, then rotations."""
    return _flags(scene, motion_of(state)) != 0


def _flags(scene: LoadedRod, motion: Motion) -> Array:
    """Flags of all degrees of freedom: 1 if free, 0 if held.

    Twist counts as held if the method has none.
    """
    # Constraints hold some degrees of freedom completely and leave the others.
    nodes, (x, y, z) = degrees_of_freedom(scene, motion)
    about_axis = z if scene.method.twist else jnp.zeros_like(z)
    return jnp.concatenate([*nodes, x, y, about_axis])
