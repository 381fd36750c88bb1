"""Resampling of a rod, its scene and its state to another number of elements."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    normalise,
    rotation_exp,
    split_quaternion,
)
from jaxrod.model import Model, check_model
from jaxrod.rods.elasticity import joint_rotations
from jaxrod.rods.factories import MOST_ELEMENTS
from jaxrod.rods.rod import Rod, RodState, interpolated, neighbours
from jaxrod.scene import Scene
from jaxrod.validation import check_count, is_traced

AnyModel = TypeVar("AnyModel", bound=Model)


@overload
def resample(
    scene: Scene, state: RodState, n_elements: int
) -> tuple[Scene, RodState]: ...


@overload
def resample(
    scene: AnyModel, state: Any, n_elements: int | Mapping[str, int]
) -> tuple[AnyModel, Any]: ...


def resample(scene: Any, state: Any, n_elements: Any) -> tuple[Any, Any]:
    """Converts a scene and a state to another number of equally long elements.

    Interpolation is in rest arc length. Logarithms of properties are interpolated
    linearly between element midpoints, rest curvatures between joints, positions
    and velocities between nodes, and orientations along the rotation from each element
    to the next. Effects define their counterparts on the new rod (`Effect.resampled`).
    Couplings of a system stay at the same points of their rods, and neighbour lists are
    sized again.

    The result is exact for uniform straight rods; otherwise its error is second order
    in the element length. It cannot be traced: it is computed on the host.

    Args:
        scene: The scene, or a system.
        state: State of its rods and bodies.
        n_elements: Number of elements of the new rod, at least 2. For a system, that of
            all rods, or of the named ones: `{"arm": 20}`.

    Returns:
        The new scene and state; the given ones if no number changes.

    Raises:
        ValueError: If `n_elements` is out of range, an argument is traced, an effect
            has memory, a schedule of numbers along the rod that cannot be interpolated,
            or belongs to certain elements (a tendon), or a coupling is at a point where
            the new rod has no node or belongs to certain elements (glue).
        TypeError: If `scene` or `state` has the wrong type.

    Example:
        >>> finer, its_state = jaxrod.resample(scene, state, 40)
        >>> finer.rod.n_elements, its_state.positions.shape
        (40, (3, 41))
    """
    check_model(scene)
    scene.check_state(state)
    if scene.remembers:
        raise ValueError("resample needs a scene whose effects have no memory")
    members = scene.interfaces()
    asked = _asked(n_elements, [k for k, own in members.items() if own.rod is not None])
    if is_traced(scene, state):
        raise ValueError(
            "resample needs numbers that are known, not traced by jax.jit, grad or vmap"
        )
    states = scene.states_by_name(state)
    changed, moved = {}, {}
    for name, n in asked.items():
        if members[name].rod.n_elements != n:
            rods = members[name].one_by_one(states[name])
            pairs = [_resampled_scene(one, own, n) for one, own in rods]
            changed[name], moved[name] = jax.tree.map(
                lambda *leaves, own=states[name]: (
                    jnp.stack(leaves) if own.layout.is_stacked else leaves[0]
                ),
                *pairs,
            )
    if not changed:
        return scene, state
    after = scene.with_states(state, moved)
    return scene.with_members(changed).regridded(scene, after), after


def _asked(n_elements: Any, rods: Sequence[str]) -> dict[str, int]:
    """Number of elements that each named rod is to have."""
    if not isinstance(n_elements, Mapping):
        n = check_count("n_elements", n_elements, 2, MOST_ELEMENTS)
        return dict.fromkeys(rods, n)
    for name in n_elements:
        if name not in rods:
            raise ValueError(
                f"n_elements: no rod is called {name!r}; there are "
                + ", ".join(map(repr, rods))
            )
    return {
        name: check_count(f"n_elements of {name!r}", n, 2, MOST_ELEMENTS)
        for name, n in n_elements.items()
    }


def _resampled_scene(scene: Any, state: RodState, n: int) -> tuple[Any, RodState]:
    """One rod, its effects and its state with `n` elements."""
    rod = scene.rod
    new = _resampled_rod(rod, n)
    effects = tuple(effect.resampled(rod, new) for effect in scene.effects)
    return (
        dataclasses.replace(scene, rod=new, effects=effects),
        _resampled_state(rod, state, new),
    )


def _resampled_rod(rod: Rod, n: int) -> Rod:
    length = float(np.sum(np.asarray(rod.rest_lengths)))
    dtype = rod.rest_lengths.dtype
    nodes, middles = _places(rod)
    new_middles = length * (np.arange(n) + 0.5) / n
    new_joints = length * np.arange(1, n) / n

    def along(values: Array, old: np.ndarray, new: np.ndarray) -> Array:
        return jnp.asarray(interpolated(np.asarray(values), old, new), dtype)

    def positive(values: Array) -> Array:
        # By logarithms, so that values of tapered rods stay positive at the ends.
        logarithms = np.log(np.asarray(values, np.float64))
        new = interpolated(logarithms, middles, new_middles)
        return jnp.asarray(np.exp(new), dtype)

    return Rod(
        rest_lengths=jnp.full(n, length / n, dtype),
        radii=positive(rod.radii),
        linear_density=positive(rod.linear_density),
        rotary_inertia=positive(rod.rotary_inertia),
        shear_stretch_stiffness=positive(rod.shear_stretch_stiffness),
        bend_twist_stiffness=positive(rod.bend_twist_stiffness),
        rest_strains=along(rod.rest_strains, middles, new_middles),
        rest_curvatures=along(rod.rest_curvatures, nodes[1:-1], new_joints),
        joint_mean=rod.joint_mean,
        mass_matrix=rod.mass_matrix,
    )


def _places(rod: Rod) -> tuple[np.ndarray, np.ndarray]:
    """Rest arc lengths of nodes and of element midpoints [m]."""
    lengths = np.asarray(rod.rest_lengths, np.float64)
    nodes = np.concatenate([[0.0], np.cumsum(lengths)])
    return nodes, np.asarray(rod.arc_length_midpoints, np.float64)


def _resampled_state(rod: Rod, state: RodState, new: Rod) -> RodState:
    dtype = state.positions.dtype
    (nodes, middles), (new_nodes, new_middles) = _places(rod), _places(new)
    # Momentum per length varies smoothly along the rod.
    lengths, new_lengths = (
        np.asarray(one.rest_lengths, np.float64) for one in (rod, new)
    )
    momenta = np.asarray(state.angular_momenta, np.float64) / lengths
    momenta = interpolated(momenta, middles, new_middles) * new_lengths

    def along(values: Array) -> Array:
        return jnp.asarray(interpolated(np.asarray(values), nodes, new_nodes), dtype)

    return RodState(
        positions=along(state.positions),
        orientations=_turned_along(state.orientations, middles, new_middles),
        velocities=along(state.velocities),
        angular_momenta=jnp.asarray(momenta, dtype),
        remainders=None
        if state.remainders is None
        else jnp.zeros((3, new_nodes.size), dtype),
    )


def _turned_along(
    orientations: Array, middles: np.ndarray, new_middles: np.ndarray
) -> Array:
    """Interpolates orientations of elements to arc lengths `new_middles` [m].

    Between elements they turn along the rotation vector from one to the next.
    """
    before, share = neighbours(middles, new_middles)
    turns, _ = joint_rotations(split_quaternion(orientations))
    start = split_quaternion(orientations[:, before])
    turn = vectors.split(vectors.join(turns)[:, before])
    part = vectors.scale(jnp.asarray(share, orientations.dtype), turn)
    return join_quaternion(normalise(multiply_quaternions(start, rotation_exp(part))))
