"""A workload: a scene that can be built at any resolution, and its controls."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

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
from jaxrod.loaded_rod import check_scene_and_state
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.laws import Law
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.rods.along_rod import interpolated, neighbours
from jaxrod.rods.elasticity import joint_rotations
from jaxrod.rods.factories import MOST_ELEMENTS
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Scene
from jaxrod.validation import check_array, check_count, is_traced

Build = Callable[[int, Law], tuple[Scene, RodState]]
Act = Callable[[Scene], Callable[[jax.Array], Scene]]


def _unchanged(scene: Scene) -> Callable[[jax.Array], Scene]:
    return lambda control: scene


@dataclasses.dataclass(frozen=True, eq=False)
class Workload:
    """Simulation on which the error and the cost of settings are measured.

    Time is divided into control periods. In each period the scene is the one that `act`
    returns, and at its end the tip is recorded. A period is a whole number of steps.
    """

    name: str
    """Name of the workload."""
    build: Build
    """Function from the number of elements and the law to the scene and its initial
    state, in float64."""
    period: float
    """Length of a control period [s]."""
    controls: np.ndarray
    """Controls of each period `(periods, controls)`; without columns if nothing
    changes."""
    act: Act = _unchanged
    """Function of the scene, called once; it returns a function from a period's
    controls to the scene during that period."""
    plane: PlaneName | None = None
    """Plane of all motion and loads; `None` if the motion is spatial."""

    @property
    def duration(self) -> float:
        """Simulated time [s]."""
        return self.period * len(self.controls)


def workload_of(
    scene: Scene,
    state: RodState,
    *,
    duration: float = 1.0,
    periods: int = 50,
    name: str = "scene",
) -> Workload:
    """Workload of a scene that moves without controls.

    Args:
        scene: The scene; it is resampled to other numbers of elements, so numbers
            that vary along the rod are interpolated.
        state: Its initial state.
        duration: Simulated time [s].
        periods: Number of records of the tip; no step is longer than the time between.
        name: Name of the workload.

    Raises:
        ValueError: If `duration` is not positive, `scene` is not of the consistent law,
            `state` is not of its rod or not finite, or something leaves the plane of
            a planar scene.
        TypeError: If `scene` is not a scene or `state` not a state.
    """
    check_scene_and_state(scene, state)
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state)):
        raise ValueError("state must be finite")
    check_array("duration", duration, [()], "s", positive=True)
    if not scene.method.has_energy:
        raise ValueError(
            "a scene of PyElastica's law has no setting to choose: its clamp and its "
            "law are wrong by more than its steps are"
        )
    scene.method.check_state(scene, state)
    with jax.enable_x64(True):
        scene, state = jax.tree.map(_double, (scene, state))
        plain = dataclasses.replace(scene, method=Consistent())

    def build(n_elements: int, law: Law) -> tuple[Scene, RodState]:
        if law != "consistent":
            raise ValueError("a scene of one's own is tuned with the consistent law")
        return resampled(plain, state, n_elements)

    controls = np.zeros((periods, 0))
    plane = getattr(scene.method, "plane", None)
    return Workload(name, build, duration / periods, controls, plane=plane)


def _double(leaf: jax.Array) -> jax.Array:
    return jax.numpy.asarray(np.asarray(leaf, np.float64))


def resampled(scene: Scene, state: RodState, n_elements: int) -> tuple[Scene, RodState]:
    """A scene and its state with another number of equally long elements.

    Interpolation is in rest arc length. Logarithms of properties are interpolated
    linearly between the middles of elements, rest curvatures between joints, positions
    and velocities between nodes, and orientations along the rotation from each element
    to the next. Effects define their counterparts on the new rod (`Effect.resampled`).

    The result is exact for uniform straight rods; otherwise it is second order in the
    element length. Not for tracing: the result is computed on the host.

    Args:
        scene: The scene.
        state: Its state.
        n_elements: Number of elements of the new rod, at least 2.

    Returns:
        The new scene and state; the given ones if the number does not change.

    Raises:
        ValueError: If `n_elements` is out of range, or anything is traced.
        TypeError: If `scene` or `state` is of another type.
    """
    check_scene_and_state(scene, state)
    scene.check_moment()
    if scene.remembers:
        raise ValueError("resampled needs a scene whose effects remember nothing")
    n = check_count("n_elements", n_elements, 2, MOST_ELEMENTS)
    if is_traced(scene, state):
        raise ValueError(
            "resampled needs numbers that are known, not traced by jax.jit, grad or "
            "vmap"
        )
    rod = scene.rod
    if n == rod.n_elements:
        return scene, state
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
        # Logarithms suit powers of a tapering radius: values stay positive at the ends.
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
    )


def _places(rod: Rod) -> tuple[np.ndarray, np.ndarray]:
    """Rest arc lengths of nodes and of the middles of elements [m]."""
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
    """Orientations between elements, along the rotation from one to the next."""
    before, share = neighbours(middles, new_middles)
    turns, _ = joint_rotations(split_quaternion(orientations))
    start = split_quaternion(orientations[:, before])
    turn = vectors.split(vectors.join(turns)[:, before])
    part = vectors.scale(jnp.asarray(share, orientations.dtype), turn)
    return join_quaternion(normalise(multiply_quaternions(start, rotation_exp(part))))
