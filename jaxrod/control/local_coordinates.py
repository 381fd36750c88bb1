r"""Local coordinates of the states near a state, one per degree of freedom and rate.

A state near a given one differs by displacements $d$ of nodes, rotation vectors
$\theta$ of elements, and changes of velocities $v$ and angular velocities $\omega$,

$$x \mapsto x + d, \quad q \mapsto q\,e^{\theta}, \quad v \mapsto v + \delta v, \quad
\omega \mapsto \omega + \delta\omega,$$

with $\theta$ and $\omega$ in the material frames of the elements. Not all of these
components are free. A very short time step projects a state onto the states that
supports, ties, attachments and the method allow. So the columns of the step's Jacobian
$T$ span all allowed directions, and its derivatives with respect to rates span all
allowed displacements. A component that no rate moves is held. Among components that
move together, such as the positions of tied nodes, one is chosen as free, and the
others follow it: with $S$ selecting the rows of free components, the directions are the
columns of $B = T (S T)^{-1}$, so that $S B = 1$.

This also works for custom methods, couplings and effects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    multiply_quaternions,
    normalise,
    rotation_exp,
    rotation_log,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.model import TimeStep
from jaxrod.stepping.runs import advance, check_first, with_memory
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, is_traced, knows_constants

WithControl = Callable[[Any, Array], Any]
"""`(model, control) -> model`: the model under a control, constant for a period."""
INSTANT = 1e-6
"""Duration of the very short step whose Jacobian shows the free components, as a
fraction of the time step [1]."""
STILL = 1e-6
"""A component counts as held if its displacement in a very short step is below this
fraction of its rate times the duration [1]."""
_SHAKEN = 0.1
"""Size of the random change of a state that shows which components follow others, as a
fraction of the shortest element (or of 1 m) [1]."""


class Fields(NamedTuple):
    """Positions, orientations and their rates of one member, for local coordinates."""

    position: Array
    """Node positions [m]."""
    orientation: Array
    """Unit quaternions of elements, material to world."""
    velocity: Array
    """Node velocities [m/s]."""
    turning: Array
    """Angular velocities of elements, material frame [rad/s]."""


@pytree
class LocalCoordinates:
    """Local coordinates of the states of a model; make them with `local_coordinates`.

    A vector of coordinates has `size` numbers: displacements [m] and rotations [rad] in
    the order of `names`, then changes of their rates [m/s], [rad/s] in the same order.
    Rotations and angular velocities are in material frames.

    Example:
        >>> near = control.local_coordinates(scene, state, 1e-4)
        >>> near.size, near.names[0], near.names[-1]
        (120, 'node 1 along x', 'element 9 about d3')
        >>> lifted = near.retract(state, near.filled(displacement=0.01))  # [m]
        >>> print(near.difference(state, lifted)[:3].round(3))
        [0.01 0.01 0.01]
    """

    model: Any
    """The scene or system."""
    instant: Float[Array, ""]
    """Duration of the very short step that gives the allowed directions [s]."""
    names: tuple[str, ...] = static()
    """Names of the free displacements and rotations, such as "node 3 along x"."""
    free: tuple[int, ...] = static()
    """Indices of the free components among all displacements and rotations."""
    follow: bool = static()
    """Whether other components follow the free ones, as tied nodes do; if not, they are
    held."""

    @property
    def size(self) -> int:
        """Number of coordinates: twice the number of free components."""
        return 2 * len(self.free)

    def filled(
        self,
        *,
        displacement: Numbers = 0.0,
        rotation: Numbers = 0.0,
        velocity: Numbers = 0.0,
        angular_velocity: Numbers = 0.0,
    ) -> Float[Array, " size"]:
        """Vector of coordinates with the same value for all coordinates of a kind.

        Args:
            displacement: Value for all displacements of nodes [m].
            rotation: Value for all rotations of elements [rad].
            velocity: Value for all velocities of nodes [m/s].
            angular_velocity: Value for all angular velocities of elements [rad/s].
        """
        turns = np.array([" about " in name for name in self.names], bool)
        given = [
            as_array(name, number, "", dtype=self.instant.dtype)
            for name, number in (
                ("displacement", displacement),
                ("rotation", rotation),
                ("velocity", velocity),
                ("angular_velocity", angular_velocity),
            )
        ]
        moved, turned, moving, turning = given
        return jnp.concatenate(
            [jnp.where(turns, turned, moved), jnp.where(turns, turning, moving)]
        )

    def directions(
        self,
        state: Any,
        *,
        first: ArrayLike = 0,
        control: Array | None = None,
        with_control: WithControl | None = None,
    ) -> Float[Array, "components size"]:
        """Matrix B: change of all components of a state per unit of each coordinate.

        Components are displacements of nodes, rotations of elements, and their rates.

        Args:
            state: State about which coordinates are taken.
            first: Number of steps since time zero, if the model depends on time.
            control: Control, or `None`. It hardly changes the result, but with the
                control of a run the run's compiled program is reused.
            with_control: `(model, control) -> model`, or `None`.
        """
        chosen = self._chosen(state)
        if not self.follow:
            return jnp.eye(_count(self.model, state), dtype=self.instant.dtype)[
                :, chosen
            ]
        tangents = tangent_map(
            self.model, state, self.instant, 1, first, control, with_control
        )[1]
        allowed = tangents[:, chosen]
        inverse = jnp.linalg.inv(allowed[chosen])
        return jnp.sum(allowed[:, :, None] * inverse[None], axis=1)

    def retract(self, state: Any, step: Array, *, first: int | Array = 0) -> Any:
        """Converts coordinates about a state to a state.

        Args:
            state: State about which coordinates are taken.
            step: Coordinates `(size,)`.
            first: Number of steps since time zero, if the model depends on time.

        Raises:
            ValueError: If `step` does not have `size` coordinates.
        """
        self.check_size("step", step)
        return self.moved(state, self.directions(state, first=first), step)

    def moved(self, state: Any, directions: Array, step: Array) -> Any:
        """State at coordinates `step` about `state`, along `directions` (matrix B)."""
        return moved_by(self.model, state, jnp.sum(directions * step[None], axis=1))

    def difference(self, state: Any, other: Any) -> Float[Array, " size"]:
        """Converts a state to coordinates about another one: the inverse of `retract`.

        Args:
            state: State about which coordinates are taken.
            other: State that is converted.
        """
        here, there = fields(self.model, state), fields(self.model, other)
        return ravel_pytree(differences(here, there))[0][self._chosen(state)]

    def chosen(self, state: Any, changes: Array) -> Array:
        """Selects the rows of `changes` whose component of `state` is free.

        `changes` has a row for each component.
        """
        return changes[self._chosen(state)]

    def check_size(self, name: str, step: Any) -> None:
        """Raises a `ValueError` unless `step` has the shape `(size,)`.

        `name` is its name in the message.
        """
        if jnp.shape(step) != (self.size,):
            raise ValueError(
                f"{name} must have shape {(self.size,)}, one number for each local "
                f"coordinate, got {jnp.shape(step)}"
            )

    def _chosen(self, state: Any) -> np.ndarray:
        places = np.array(self.free, int)
        return np.concatenate([places, places + _count(self.model, state) // 2])


@knows_constants
def local_coordinates(model: Any, state: Any, dt: TimeStep) -> LocalCoordinates:
    """Finds the local coordinates of the states near a state, without held components.

    The free components are found from concrete numbers, before tracing. They are the
    same for all states with the same supports. Memory of effects, such as the anchors
    of friction, has no coordinates and does not change.

    Args:
        model: The scene or the system.
        state: A state of the model.
        dt: Step size of simulations [s], or the result of `stable_dt`.

    Returns:
        The coordinates, for `linearise` inside `jax.jit`, and for filters.

    Raises:
        ValueError: If no component is free, or an argument is traced.
        TypeError: If the model or the state has the wrong type.

    Example:
        >>> near = control.local_coordinates(scene, state, 1e-4)
        >>> near.names[0], near.size  # node 0 is clamped
        ('node 1 along x', 120)
    """
    return coordinates_under(model, state, dt, None, None)


def coordinates_under(
    model: Any,
    state: Any,
    dt: TimeStep,
    control: Array | None,
    with_control: WithControl | None,
) -> LocalCoordinates:
    """Finds the local coordinates of states near `state`, with a control or `None`.

    The coordinates do not depend on the control. With the control of later runs, the
    program compiled here (`tangent_map`) is reused by those runs.
    """
    begin = check_first(model, 0, 1)
    if is_traced(model, state, dt):
        raise ValueError(
            "local coordinates need numbers that are known, not traced by jax.jit, "
            "grad or vmap: make jaxrod.control.local_coordinates outside; they hold "
            "for other numbers, too"
        )
    step = model.check_run(state, dt, begin)
    instant = INSTANT * step
    count = _count(model, state)

    def tangents(change: np.ndarray) -> np.ndarray:
        made = tangent_map(
            model, state, instant, 1, 0, control, with_control, change=change
        )
        return np.asarray(made[1], np.float64)[:, :count]

    allowed = tangents(np.zeros(count))
    free = _free(allowed / float(instant))
    if not free:
        raise ValueError(
            "local coordinates need a state that can change: supports hold all"
        )
    names = list(_names(model, state))
    found = LocalCoordinates(
        model=model,
        instant=instant,
        names=tuple(names[k] for k in free),
        free=tuple(free),
        follow=False,
    )
    chosen = found._chosen(state)
    others = np.setdiff1d(np.arange(count), chosen)
    noise = np.random.default_rng(0).normal(size=len(chosen))
    shaken = tangents(_shaking(model, state) * allowed[:, chosen] @ noise)
    following = shaken[np.ix_(others, chosen)]
    # Loads during the very short step are no constraint: their effect is small.
    return replace(found, follow=bool(np.any(np.abs(following) > STILL**0.5)))


def _free(rates_of_change: np.ndarray) -> list[int]:
    """Indices of free components: a largest set of independent displacements.

    `rates_of_change` is the Jacobian of the very short step divided by its duration.
    Its rows and columns are displacements and rotations, followed by their rates.
    """
    half = len(rates_of_change) // 2
    moved = rates_of_change[:half, half:]
    own = np.flatnonzero(np.abs(np.diagonal(moved)) > STILL)
    rows = moved[np.ix_(own, own)]
    lengths = np.linalg.norm(rows, axis=1)
    free: list[int] = []
    # Gram-Schmidt with pivoting: the longest remaining row is next.
    while len(free) < len(own):
        left = np.linalg.norm(rows, axis=1) / lengths
        best = int(np.argmax(left > 0.999 * np.max(left)))
        if left[best] < STILL:
            break
        way = rows[best] / np.linalg.norm(rows[best])
        rows = rows - np.outer(rows @ way, way)
        free.append(int(own[best]))
    return sorted(free)


def _shaking(model: Any, state: Any) -> float:
    """Size of the random changes of a state that show which components follow others.

    It is a tenth of the shortest edge, at most 0.1, for displacements [m] and rotations
    [rad].
    """
    edges = [
        np.min(np.linalg.norm(np.diff(np.asarray(own.positions)), axis=-2))
        for own in model.states_by_name(state).values()
        if own.positions.shape[-1] > 1
    ]
    return _SHAKEN * min([*map(float, edges), 1.0])


def _names(model: Any, state: Any) -> Iterator[str]:
    """Names of all displacements and rotations, in the order of components."""
    for name, own in sorted(jax.eval_shape(lambda: fields(model, state)).items()):
        for what, axes, field in (
            ("node {} along {}", "xyz", own.position),
            ("element {} about d{}", "123", own.turning),
        ):
            for *rod, axis, place in np.ndindex(field.shape):
                words = what.format(place, axes[axis])
                inside = "".join(f"rod {k}, " for k in rod)
                yield f"{name}: {inside}{words}" if name else inside + words


def _count(model: Any, state: Any) -> int:
    """Number of all components: displacements, rotations and their rates."""
    states = model.states_by_name(state).values()
    return sum(2 * (own.velocities.size + own.rates[1].size) for own in states)


def fields(model: Any, state: Any) -> dict[str, Fields]:
    """Positions, orientations and rates of all members, by member name."""
    members = model.interfaces()
    found = {}
    for name, own in model.states_by_name(state).items():
        velocities, spins = own.rates
        frame = directors(_quaternion(own.orientations))
        turning = _joined(to_material(frame, _vector(spins)))
        rod = members[name].rod
        if rod is not None:
            turning = turning / rod.principal_inertias
        found[name] = Fields(own.positions, own.orientations, velocities, turning)
    return found


def differences(here: dict[str, Fields], there: dict[str, Fields]) -> Any:
    """Differences `there` - `here` of two states: displacements, rotations, then rates.

    Both are dicts by member. A rotation is the rotation vector from the orientation in
    `here` to that in `there`, material frame.
    """
    places, rates = {}, {}
    for name, one in here.items():
        other = there[name]
        turned = multiply_quaternions(
            conjugate(_quaternion(one.orientation)), _quaternion(other.orientation)
        )
        rotation = _joined(rotation_log(turned))
        places[name] = other.position - one.position, rotation
        rates[name] = other.velocity - one.velocity, other.turning - one.turning
    return places, rates


def moved_by(model: Any, state: Any, changes: Float[Array, " components"]) -> Any:
    """State after changes of all components.

    `changes` concatenates, for each member in alphabetical order, the displacements
    `(3, nodes)` and rotation vectors `(3, elements)`. The changes of velocities and
    angular velocities follow after all members, in the same order. Rotation vectors and
    angular velocities are in the material frames.
    """
    here = fields(model, state)
    places, rates = ravel_pytree(differences(here, here))[1](changes)
    members, states, moved = model.interfaces(), model.states_by_name(state), {}
    for name, own in here.items():
        displacement, rotation = places[name]
        turned = normalise(
            multiply_quaternions(
                _quaternion(own.orientation), rotation_exp(_vector(rotation))
            )
        )
        velocity, turning = own.velocity + rates[name][0], own.turning + rates[name][1]
        rod = members[name].rod
        if rod is not None:
            turning = turning * rod.principal_inertias
        spins = _joined(to_world(directors(turned), _vector(turning)))
        moved[name] = replace(
            states[name].with_rates(velocity, spins),
            positions=own.position + displacement,
            orientations=jnp.stack(turned, axis=-2),
        )
    return model.with_states(state, moved)


def tangent_map(
    model: Any,
    state: Any,
    dt: Array,
    n_steps: ArrayLike,
    first: ArrayLike,
    control: Array | None,
    with_control: WithControl | None,
    *,
    change: Any = None,
) -> tuple[Any, Float[Array, "components inputs"]]:
    """Simulates a run; differentiates it in the initial state and the control.

    Numbers of steps are traced, so that one compiled program serves every run.

    Args:
        model: The scene or system.
        state: Initial state.
        dt: Step size [s].
        n_steps: Number of steps.
        first: Number of steps since time zero.
        control: Control that is held during the run, or `None`.
        with_control: `(model, control) -> model`, or `None` without a control.
        change: Change of all components of the initial state before the run; zero by
            default.

    Returns:
        The end state, and the derivatives of all its components: a column for each
        component of the initial state, followed by a column for each control value.
    """
    steps, begin = (jnp.asarray(number, jnp.int32) for number in (n_steps, first))
    state = with_memory(model, state)
    if change is None:
        change = np.zeros(_count(model, state))
    point = jnp.asarray(change, dt.dtype)
    made: tuple[Any, Array] = _tangent_map(
        model, state, point, dt, steps, begin, control, with_control
    )
    return made


@jax.jit(static_argnames="with_control")
def _tangent_map(
    model: Any,
    state: Any,
    point: Array,
    dt: Array,
    n_steps: Array,
    first: Array,
    control: Array | None,
    with_control: WithControl | None,
) -> tuple[Any, Array]:
    count = _count(model, state)
    if control is not None:
        point = jnp.concatenate([point, jnp.zeros(control.size, dt.dtype)])

    def run(change: Array) -> tuple[dict[str, Fields], Any]:
        driven = model
        if control is not None and with_control is not None:
            more = change[count:].reshape(control.shape)
            driven = with_control(model, control + more)
        begun = moved_by(model, state, change[:count])
        after = advance(driven, begun, dt, n_steps, first=first)
        return fields(model, after), after

    here, changed, after = jax.linearize(run, point, has_aux=True)
    near = jax.linearize(lambda there: differences(here, there), here)[1]

    def column(way: Array) -> Array:
        return ravel_pytree(near(changed(way)))[0]

    # One after another: a kernel of rows, which compiles faster than one of lanes.
    ways = jnp.eye(point.size, dtype=dt.dtype)
    return after, lax.map(column, ways).T


def _vector(field: Array) -> Vec3:
    return field[..., 0, :], field[..., 1, :], field[..., 2, :]


def _quaternion(field: Array) -> Quaternion:
    return field[..., 0, :], field[..., 1, :], field[..., 2, :], field[..., 3, :]


def _joined(vector: Vec3) -> Array:
    return jnp.stack(vector, axis=-2)
