"""Natural frequencies of a scene: all of them, from the linearised motion."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.analysis.frequency import linearised, no_damping
from jaxrod.loaded_rod import LoadedRod, scene_of
from jaxrod.rods.motion import motion_of
from jaxrod.rods.rod import RodState
from jaxrod.statics.freedoms import freedoms
from jaxrod.validation import check_count, is_traced, knows_constants


@knows_constants
def natural_frequencies(
    scene: LoadedRod, state: RodState, n_modes: int | None = None
) -> np.ndarray:
    """Angular frequencies of small undamped motions about a state at rest.

    They come from the dense eigenvalue problem of the `6 n + 3` degrees of freedom,
    without those that constraints hold. It is for looking at a rod, not for the inside
    of a loop. A straight rod of round section bends in the same way in two planes and
    has its bending frequencies twice. A free one starts with the six zeros of rigid
    motions.

    Args:
        scene: The scene, in consistent mode.
        state: The configuration, in equilibrium.
        n_modes: Number of modes, the lowest ones; by default all.

    Returns:
        Angular frequencies, increasing `(n_modes,)` [rad/s]; zero for motions without
        (or with negative) stiffness.

    Raises:
        ValueError: If the scene's loads have no potential, there are fewer modes, or
            anything is traced.
        TypeError: If `scene` or `state` is of another type.
    """
    scene = scene_of(scene, state)
    if n_modes is not None:
        n_modes = check_count("n_modes", n_modes, 1)
    if not scene.method.has_energy:
        raise ValueError(
            f"natural_frequencies needs the consistent law, got {scene.method!r}: "
            "PyElastica's loads are not the gradient of an energy"
        )
    stiffness = _stiffness(scene, state)
    if is_traced(stiffness):
        raise ValueError(
            "natural_frequencies needs numbers that are known, not traced by jax.jit, "
            "grad or vmap; highest_frequency works inside them"
        )
    matrix = np.asarray(stiffness, np.float64)
    free = np.asarray(_free(scene, state))
    matrix = matrix[np.ix_(free, free)]
    squares = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    frequencies = np.sqrt(np.maximum(squares, 0))
    if n_modes is None:
        return frequencies
    if n_modes > frequencies.size:
        raise ValueError(
            f"n_modes must be at most {frequencies.size}, the free motions of this "
            f"scene, got {n_modes}"
        )
    return frequencies[:n_modes]


@jax.jit
def _stiffness(scene: LoadedRod, state: RodState) -> jax.Array:
    """Stiffness over inertia, in coordinates in which it is symmetric [rad^2/s^2]."""
    apply = linearised(scene, state, no_damping(scene.rod))
    size = state.positions.size + state.angular_momenta.size
    return jax.vmap(apply)(jnp.eye(size, dtype=state.positions.dtype))


@jax.jit
def _free(scene: LoadedRod, state: RodState) -> jax.Array:
    """Flags of degrees of freedom that are free; node displacements, then rotations."""
    nodes, elements = freedoms(scene, motion_of(state))
    return jnp.concatenate([*nodes, *elements]) != 0
