"""Parameters and state of a rod, and quantities derived from them.

A rod of `n` elements has `n + 1` nodes with positions, velocities and masses. Its `n`
elements are the segments between nodes; they have orientations, angular momenta and
shear-stretch strains. Its `n - 1` joints between elements have curvature and twist. The
component axis of arrays comes first: `(3, n + 1)`, `(4, n)`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import module_for
from jaxrod.geometry.rotations import directors_from_orientations
from jaxrod.rods import mass_matrix
from jaxrod.rods.repr import repr_or_class_name, rod_repr, state_repr
from jaxrod.structure import Hinted, pytree, static
from jaxrod.validation import Numbers, check_kind, numeric

JointMean = Literal["arithmetic", "series"]
MassMatrix = Literal["lumped", "higher_order"]

_GUESSES_OF_RODS = {
    **dict.fromkeys(
        ("position", "position_collection", "positions", "tip", "x", "xpos"),
        "it is state.positions, because a rod has no state of its own",
    ),
    **dict.fromkeys(
        ("v", "velocities", "velocity", "velocity_collection"),
        "it is state.velocities, because a rod has no state of its own",
    ),
    **dict.fromkeys(
        ("curvature", "kappa", "sigma", "strains"), "it is jaxrod.strains(rod, state)"
    ),
    **dict.fromkeys(("mass", "masses"), "it is rod.node_masses"),
    "density": "it is rod.linear_density, the mass per length",
    "director_collection": "it is state.directors",
    "n_elems": "it is rod.n_elements",
    "omega_collection": "it is jaxrod.angular_velocities(rod, state)",
    "radius": "it is rod.radii",
}
"""Hints at what a `Rod` has, or its state, by the guess."""

_GUESSES_OF_STATES = {
    **dict.fromkeys(
        ("pos", "position", "position_collection", "q", "qpos", "x", "xpos"),
        "it is state.positions",
    ),
    **dict.fromkeys(
        ("qd", "qvel", "v", "vel", "velocity", "velocity_collection"),
        "it is state.velocities",
    ),
    **dict.fromkeys(
        ("orientation", "quat", "quaternions", "rot", "xquat"),
        "it is state.orientations",
    ),
    **dict.fromkeys(
        ("ang", "angular_velocities", "omega", "omega_collection"),
        "it is jaxrod.angular_velocities(rod, state)",
    ),
    **dict.fromkeys(
        ("curvature", "kappa", "sigma", "strains"), "it is jaxrod.strains(rod, state)"
    ),
    **dict.fromkeys(
        ("t", "time"), "jaxrod.rollout_times computes the times of a rollout"
    ),
    "director_collection": "it is state.directors",
}
"""Hints at what a `RodState` has, or a function computes, by the guess."""


@pytree
class Rod(Hinted):
    """Parameters of one rod. All numbers are traced leaves.

    `vmap` over a rod is domain randomisation; `grad` over it is system identification.
    Mass and inertia per length, and the stiffness of the section, do not change when
    the discretisation does.

    For stacked rods, such as those that `vmap` over a factory makes, derived quantities
    have the same leading axes.

    Example:
        >>> rod.n_elements, rod.node_masses.shape
        (10, (11,))
        >>> round(float(rod.element_masses.sum()), 3)  # density times volume [kg]
        1.257
        >>> softer = replace(rod, bend_twist_stiffness=0.5 * rod.bend_twist_stiffness)
        >>> round(float(softer.bend_twist_stiffness[0, 0]), 4)  # E I / 2 [N m^2]
        0.0628
    """

    _hints = _GUESSES_OF_RODS

    rest_lengths: Float[Array, " n"]
    """Unstressed element lengths [m]."""
    radii: Float[Array, " n"]
    """Element radii [m]. Contact, fluids, health and drawing use them, elasticity and
    inertia do not."""
    linear_density: Float[Array, " n"]
    """Mass per rest length [kg/m]."""
    rotary_inertia: Float[Array, "2 n"] | Float[Array, "3 n"]
    """Rotary inertia per rest length [kg m]. For sections with equal inertia about d1
    and d2: transverse and polar (d3). For others: about d1, d2 and d3."""
    shear_stretch_stiffness: Float[Array, "3 n"]
    """Shear stiffness along d1 and d2, and axial stiffness along d3 [N]."""
    bend_twist_stiffness: Float[Array, "3 n"]
    """Bending stiffness about d1 and d2, and twisting stiffness about d3 [N m^2]."""
    rest_strains: Float[Array, "3 n"]
    """Shear-stretch strain of the unstressed shape, material frame [1]."""
    rest_curvatures: Float[Array, "3 n-1"]
    """Curvature and twist of the unstressed shape, material frame [1/m]."""
    joint_mean: JointMean = static(default="arithmetic")
    """Mean of two elements' bend-twist stiffnesses at their joint: weighted by length
    ("arithmetic"), or of springs in series ("series")."""
    mass_matrix: MassMatrix = static(default="lumped")
    """Masses at the nodes alone ("lumped"), or coupled along elements, with smaller
    errors of swings and of waves of stretch ("higher_order")."""

    def __repr__(self) -> str:
        """One line with elements, sizes and material; ranges for numbers that vary."""
        return repr_or_class_name(rod_repr, self)

    @property
    def n_elements(self) -> int:
        """Number of elements.

        Example:
            >>> rod.n_elements
            10
        """
        return self.rest_lengths.shape[-1]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of stacked rods; empty for a single rod."""
        return jnp.shape(self.rest_lengths)[:-1]

    @property
    def length(self) -> Float[Array, "*batch"]:
        """Rest length of the rod [m].

        Example:
            >>> round(float(rod.length), 3)
            1.0
        """
        return jnp.sum(self.rest_lengths, axis=-1)

    @property
    def joint_lengths(self) -> Float[Array, "*batch n-1"]:
        """Rest arc length belonging to each joint (Voronoi length) [m]."""
        return 0.5 * (self.rest_lengths[..., 1:] + self.rest_lengths[..., :-1])

    @property
    def element_masses(self) -> Float[Array, "*batch n"]:
        """Mass of each element [kg].

        Example:
            >>> rod.element_masses.shape, round(float(rod.element_masses.sum()), 3)
            ((10,), 1.257)
        """
        return self.linear_density * self.rest_lengths

    @property
    def node_masses(self) -> Float[Array, "*batch n+1"]:
        """Mass of each node [kg]: half of each neighbouring element's.

        With `mass_matrix="higher_order"` 1/24 of the mass of an end element is moved
        inwards from its end node.

        Example:
            >>> print(rod.node_masses[:3].round(4))  # half an element at an end
            [0.0628 0.1257 0.1257]
        """
        if self.mass_matrix == "higher_order":
            return mass_matrix.node_masses(self.element_masses, self.rest_lengths)
        half = 0.5 * self.element_masses
        return vectors.pad(half, 0, 1) + vectors.pad(half, 1, 0)

    @property
    def is_round(self) -> bool:
        """Whether inertia is the same about d1 and d2, by the array shape alone."""
        return self.rotary_inertia.shape[-2] == 2

    @property
    def inertias(self) -> Float[Array, "*batch 2 n"]:
        """Rotary inertia of each element, transverse and polar [kg m^2].

        If it differs between d1 and d2, the transverse inertia is the smaller of the
        two, for use in bounds.
        """
        inertias = self.rotary_inertia * self.rest_lengths[..., None, :]
        if self.is_round:
            return inertias
        first, second, polar = (inertias[..., axis, :] for axis in range(3))
        return jnp.stack([jnp.minimum(first, second), polar], axis=-2)

    @property
    def principal_inertias(self) -> Float[Array, "*batch 3 n"]:
        """Rotary inertia of each element about d1, d2, d3 [kg m^2]."""
        inertias = self.rotary_inertia * self.rest_lengths[..., None, :]
        if not self.is_round:
            return inertias
        transverse, polar = inertias[..., 0, :], inertias[..., 1, :]
        return jnp.stack([transverse, transverse, polar], axis=-2)

    @property
    def joint_stiffness(self) -> Float[Array, "*batch 3 n-1"]:
        """Bend-twist stiffness of each joint about d1, d2, d3 [N m^2].

        It is the length-weighted mean of the neighbouring elements, as in PyElastica;
        with `joint_mean="series"` it is that of springs in series.

        Example:
            >>> rod.joint_stiffness.shape
            (3, 9)
            >>> bend, _, twist = rod.joint_stiffness[:, 0]
            >>> round(float(bend), 4), round(float(twist), 4)
            (0.1257, 0.0838)
        """
        if self.joint_mean == "series":
            compliance = self.rest_lengths[..., None, :] / self.bend_twist_stiffness
            lengths = self.rest_lengths[..., 1:] + self.rest_lengths[..., :-1]
            return lengths[..., None, :] / (compliance[..., 1:] + compliance[..., :-1])
        weighted = self.bend_twist_stiffness * self.rest_lengths[..., None, :]
        total = weighted[..., 1:] + weighted[..., :-1]
        lengths = self.rest_lengths[..., 1:] + self.rest_lengths[..., :-1]
        return total / lengths[..., None, :]

    @property
    def arc_length_midpoints(self) -> Float[Array, "*batch n"]:
        """Rest arc length from the base to the middle of each element [m].

        Example:
            >>> print(rod.arc_length_midpoints[:3].round(3))
            [0.05 0.15 0.25]
        """
        return jnp.cumsum(self.rest_lengths, axis=-1) - 0.5 * self.rest_lengths

    def kinetic_energy(self, state: RodState) -> Float[Array, ""]:
        """Kinetic energy of nodes and elements, $m v^2 / 2$ and $I w^2 / 2$ [J].

        With `mass_matrix="higher_order"` supports count as well, so that
        `Scene.kinetic_energy` is needed if there are any.

        Example:
            >>> moving = replace(state, velocities=2.0 * jnp.ones((3, 11)))
            >>> round(float(rod.kinetic_energy(moving)), 3)
            7.54
        """
        check_state(self, state)
        return kinetic_energy(self, state)

    def momentum(self, state: RodState) -> Float[Array, "3"]:
        """Linear momentum, the sum of $m v$ over the nodes, world frame [kg m/s].

        Example:
            >>> moving = replace(state, velocities=2.0 * jnp.ones((3, 11)))
            >>> print(rod.momentum(moving).round(3))
            [2.513 2.513 2.513]
        """
        check_state(self, state)
        return _momentum(self, state)

    def angular_momentum(self, state: RodState) -> Float[Array, "3"]:
        """Angular momentum about the origin, world frame [kg m^2/s].

        Example:
            >>> lifting = jnp.zeros((3, 11)).at[2].set(1.0)  # along z [m/s]
            >>> moving = replace(state, velocities=lifting)
            >>> print(rod.angular_momentum(moving).round(3))
            [ 0.    -0.628  0.   ]
        """
        check_state(self, state)
        return angular_momentum(self, state)


# Compiled: outside of `jit` each of their operations would be a program of its own.
@jax.jit
def kinetic_energy(rod: Rod, state: RodState, free: Array | None = None) -> Array:
    """Kinetic energy [J]; `free` is 1 for velocities that no support holds, else 0."""
    if rod.mass_matrix == "lumped":
        translation = 0.5 * jnp.sum(rod.node_masses[None, :] * state.velocities**2)
    else:
        products = _momentum_velocities(rod, state, free) * state.velocities
        translation = 0.5 * jnp.sum(rod.node_masses[None, :] * products)
    spin = _angular_velocities(rod, state)
    return translation + 0.5 * jnp.sum(rod.principal_inertias * spin**2)


@jax.jit
def _momentum(rod: Rod, state: RodState) -> Array:
    return jnp.sum(rod.node_masses[None, :] * state.velocities, axis=1)


def _momentum_velocities(rod: Rod, state: RodState, free: Array | None) -> Array:
    """Momenta of the nodes divided by their masses [m/s]."""
    if rod.mass_matrix == "lumped":
        return state.velocities
    return mass_matrix.momentum_velocities(
        rod.element_masses, rod.rest_lengths, state.velocities, free
    )


@jax.jit
def angular_momentum(rod: Rod, state: RodState, free: Array | None = None) -> Array:
    """Angular momentum about the origin [kg m^2/s]; `free` as in `kinetic_energy`."""
    position = vectors.split(state.positions)
    velocity = vectors.split(_momentum_velocities(rod, state, free))
    orbital = vectors.join(vectors.cross(position, velocity))
    return jnp.sum(rod.node_masses[None, :] * orbital, axis=1) + jnp.sum(
        state.angular_momenta, axis=1
    )


@jax.jit
def _angular_momenta(rod: Rod, state: RodState, velocities: Array) -> Array:
    material = velocities * rod.principal_inertias
    return jnp.sum(state.directors * material[:, None], axis=0)


@jax.jit
def _angular_velocities(rod: Rod, state: RodState) -> Array:
    frame = state.directors
    material = jnp.sum(frame * state.angular_momenta[None], axis=1)
    return material / rod.principal_inertias


@dataclass(frozen=True)
class Layout:
    """Numbers of nodes and elements of a member of a system, as its state has them.

    Example:
        >>> state.layout
        Layout(count=1, n_elements=10, is_rod=True, is_stacked=False)
        >>> extend.Layout(count=1)  # of a point mass, a member of your own
        Layout(count=1, n_elements=1, is_rod=False, is_stacked=False)
    """

    count: int
    """Number of rods, bodies or points."""
    n_elements: int = 1
    """Elements of each rod; 1 for bodies and points, whose nodes are also elements."""
    is_rod: bool = False
    """Whether the member consists of rods, with one more node than elements."""
    is_stacked: bool = False
    """Whether arrays have a leading axis for several equal rods."""

    def row(self, field: Any) -> Any:
        """Array `(3, nodes)`, or `(k, 3, nodes)` if stacked, as one `(3, k nodes)`."""
        if not self.is_stacked:
            return field
        return field.transpose(1, 0, 2).reshape(field.shape[1], -1)


@pytree
class RodState(Hinted):
    """State of a rod: everything that changes in time, without derived quantities.

    Example:
        >>> state.positions.shape, state.orientations.shape
        ((3, 11), (4, 10))
        >>> state.tip.round(3).tolist()
        [1.0, 0.0, 0.0]
        >>> moving = replace(state, velocities=jnp.ones_like(state.velocities))
        >>> round(float(rod.kinetic_energy(moving)), 3)  # m v^2 / 2 [J]
        1.885
    """

    _hints = _GUESSES_OF_STATES

    positions: Float[Array, "3 n+1"]
    """Node positions, world frame [m]."""
    orientations: Float[Array, "4 n"]
    """Unit quaternions (w, x, y, z), material to world; d3 points along the rod."""
    velocities: Float[Array, "3 n+1"]
    """Node velocities, world frame [m/s]."""
    angular_momenta: Float[Array, "3 n"]
    """Angular momentum of each element about its centre, world frame [kg m^2/s]."""
    remainders: Float[Array, "3 n+1"] | None = None
    """Accumulated round-off of the positions (Kahan) [m]; `None` unless `compensated`
    has been applied."""
    memory: tuple[dict[str, Any], ...] | None = None
    """Memory of the effects of a scene, see `jaxrod.extend.memory`. `None` if no effect
    has memory, or if it is the initial memory of the scene."""

    def __repr__(self) -> str:
        """One line with elements, tip position and largest speed."""
        return repr_or_class_name(state_repr, self)

    @property
    def layout(self) -> Layout:
        """Numbers of rods and of their elements."""
        *leading, _, n = self.orientations.shape
        count = leading[0] if leading else 1
        return Layout(count, n, is_rod=True, is_stacked=bool(leading))

    @property
    def rates(self) -> tuple[Array, Array]:
        """Velocities of nodes [m/s] and angular momenta of elements [kg m^2/s]."""
        return self.velocities, self.angular_momenta

    def with_rates(self, velocities: Array, spins: Array) -> RodState:
        """Copy of the state with other velocities and angular momenta (`spins`)."""
        return replace(self, velocities=velocities, angular_momenta=spins)

    @property
    def directors(self) -> Float[Array, "*batch 3 3 n"]:
        """Material axes: `[..., i, j, :]` is world component j of director i.

        Example:
            >>> state.directors[:, :, 0].tolist()  # d3 is the tangent, along x
            [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
        """
        return directors_from_orientations(self.orientations)

    @property
    def tip(self) -> Float[Array, "*batch 3"]:
        """Position of the last node [m]; for a rollout, at every record.

        Example:
            >>> state.tip.round(3).tolist()
            [1.0, 0.0, 0.0]
        """
        return self.positions[..., -1]


def angular_velocities(rod: Rod, state: RodState) -> Float[Array, "3 n"]:
    """Angular velocity of each element in its material frame `(3, n)` [rad/s].

    Raises:
        ValueError: If the state does not match that rod.
        TypeError: If `rod` or `state` has the wrong type.

    Example:
        >>> turning = jaxrod.with_angular_velocities(rod, state, jnp.full((3, 10), 2.0))
        >>> jaxrod.angular_velocities(rod, turning)[:, 0].round(3).tolist()
        [2.0, 2.0, 2.0]
    """
    check_state(rod, state)
    return _angular_velocities(rod, state)


def with_angular_velocities(
    rod: Rod, state: RodState, angular_velocities: Numbers
) -> RodState:
    """Copy of the state with the given angular velocities.

    Args:
        rod: The rod, for its inertias.
        state: The state to change.
        angular_velocities: Material-frame angular velocity per element `(3, n)`
            [rad/s].

    Raises:
        ValueError: If their shape does not match the rod.
        TypeError: If `rod` or `state` has the wrong type.

    Example:
        >>> spin = jnp.zeros((3, 10)).at[2].set(4.0)  # about the rod's own axis [rad/s]
        >>> turning = jaxrod.with_angular_velocities(rod, state, spin)
        >>> round(float(rod.angular_momentum(turning)[0]), 6)
        0.001005
    """
    check_state(rod, state)
    given = numeric("angular_velocities", angular_velocities, "rad/s")
    if given.shape != (3, rod.n_elements):
        raise ValueError(
            f"angular_velocities must have shape {(3, rod.n_elements)}, got "
            f"{given.shape}"
        )
    given = jnp.asarray(given, rod.rest_lengths.dtype)
    return replace(state, angular_momenta=_angular_momenta(rod, state, given))


def compensated(state: RodState) -> RodState:
    """Copy of a state for which later steps sum positions with Kahan's compensation.

    Every step adds small displacements to large positions. In float32 the round-off of
    these sums dominates the errors of axial forces. Kahan's summation removes it: the
    round-off is kept in `remainders` and used in the next step and in the strains. That
    costs six operations per node and component. It is meant for float32; in float64
    round-off is far below the discretisation error.

    Angular momentum is not improved: its drift in a free rod is round-off of the loads
    themselves, about `u sqrt(steps)` of the sum of `m |x| |v|` over the nodes, with `u`
    the unit round-off, 6e-8 in float32 (`tests/extremes/test_precision.py`).

    Raises:
        TypeError: If `state` is not a `RodState`.

    Example:
        >>> precise = jaxrod.compensated(state)
        >>> precise.remainders.shape, state.remainders is None
        ((3, 11), True)
    """
    check_kind("state", state, RodState)
    return replace(state, remainders=jnp.zeros_like(state.positions))


def check_state(rod: Rod, state: RodState) -> None:
    """Raises unless the arguments are a single rod and a single state that matches it.

    Raises:
        TypeError: If either has the wrong type.
        ValueError: If their numbers of elements or nodes differ, or either is a batch.
    """
    check_kind("rod", rod, Rod)
    check_kind("state", state, RodState)
    check_size(rod, state)


def check_one(state: RodState) -> None:
    """Raises a `ValueError` if a state is a batch of states, or a rollout."""
    shape = jnp.shape(state.positions)
    if len(shape) != 2:
        raise ValueError(
            f"state must be one state, got a batch of shape {shape[:-2]} (or a "
            "rollout): use jax.vmap"
        )


def check_size(rod: Rod, state: RodState) -> None:
    """Raises unless a state has the nodes and elements of a scene's rod, traced or not.

    Raises:
        ValueError: If their numbers of elements or nodes differ, a field of the state
            has another shape, or either is a batch.
    """
    check_one(state)
    if rod.batch_shape:
        raise ValueError(
            f"rod must be one rod, got a batch of shape {rod.batch_shape}: use jax.vmap"
        )
    n = rod.n_elements
    elements, nodes = state.orientations.shape[-1], state.positions.shape[-1]
    if elements != n:
        raise ValueError(
            f"state must have {n} elements, as the scene's rod has, got {elements}"
        )
    if nodes != n + 1:
        raise ValueError(
            f"state must have {n + 1} nodes, one more than elements, got {nodes}"
        )
    for field, unit, wanted in (
        ("positions", "m", (3, n + 1)),
        ("orientations", "1", (4, n)),
        ("velocities", "m/s", (3, n + 1)),
        ("angular_momenta", "kg m^2/s", (3, n)),
        ("remainders", "m", (3, n + 1)),
    ):
        own = getattr(state, field)
        if own is not None and jnp.shape(own) != wanted:
            raise ValueError(
                f"{field} of the state [{unit}] must have shape {wanted}, got "
                f"{jnp.shape(own)}"
            )


def interpolated(values: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Linear interpolation along the last axis, extrapolated beyond the ends.

    Args:
        values: Values at the old points `(..., m)`.
        old: Coordinates of the old points, increasing `(m,)`.
        new: Coordinates of the new points `(k,)`.

    Returns:
        Values at the new points `(..., k)`.
    """
    values = values.astype(np.float64)
    if old.size == 1:
        return np.repeat(values, new.size, axis=-1)
    before, share = neighbours(old, new)
    return values[..., before] * (1 - share) + values[..., before + 1] * share


def neighbours(old: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the old point before each new point, and its fraction of the interval.

    The fraction is 0 at that old point and 1 at the next [1].
    """
    before = np.clip(np.searchsorted(old, new) - 1, 0, old.size - 2)
    return before, (new - old[before]) / (old[before + 1] - old[before])


def node_places(rod: Rod) -> Any:
    """Rest arc length from the base to every node [m], float64 unless traced."""
    xp = module_for(rod.rest_lengths)
    lengths = rod.rest_lengths if xp is jnp else np.asarray(rod.rest_lengths, float)
    return xp.concatenate([xp.zeros(1, lengths.dtype), xp.cumsum(lengths)])


def middle_places(rod: Rod) -> Any:
    """Rest arc length from the base to the middle of every element [m]."""
    places = node_places(rod)
    return 0.5 * (places[1:] + places[:-1])


def resampled_along(values: Array, old: Any, new: Any) -> Array:
    """Values on the last axis, interpolated from arc lengths `old` to `new` [m].

    A last axis with a single value, which is for the whole rod, is returned unchanged.
    """
    if values.shape[-1] == 1:
        return values
    found = interpolated(np.asarray(values), np.asarray(old), np.asarray(new))
    return jnp.asarray(found, values.dtype)
