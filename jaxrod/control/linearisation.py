r"""Linear models of a control period for small changes of state and control.

In local coordinates $z$ about a state, with a control $u$ held during a period,

$$z_{k+1} = A z_k + B\,\delta u_k, \qquad \delta y_k = C z_k,$$

with $z_{k+1}$ about the state at the end of the period. The matrices are the exact
derivatives of the time steps, computed in forward mode as one batch, with one column
per coordinate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from jaxrod.control.local_coordinates import (
    LocalCoordinates,
    WithControl,
    coordinates_under,
    tangent_map,
)
from jaxrod.model import TimeStep
from jaxrod.stepping.runs import check_first, check_step
from jaxrod.structure import pytree
from jaxrod.validation import as_array, check_count, check_kind, is_traced, numeric

Measure = Callable[[Any, Any], Array]
"""`(model, state) -> array`: a measurement of a state, without noise."""


@pytree
class Linearisation:
    """Linear model $z' = A z + B u$, $y = C z$ of one period; see `linearise`.

    The state $z$, control $u$ and readings $y$ are deviations.

    Example:
        >>> tip = lambda scene, state: state.tip
        >>> arm = control.linearise(scene, state, 1e-4, measure=tip)
        >>> arm.state_matrix.shape, arm.output_matrix.shape
        ((120, 120), (3, 120))
    """

    state_matrix: Float[Array, "size size"]
    """Matrix A: derivative of the coordinates after the period with respect to those
    before it."""
    input_matrix: Float[Array, "size controls"] | None
    """Matrix B: derivative of the coordinates after the period with respect to the
    control; `None` without a control."""
    output_matrix: Float[Array, "measured size"] | None
    """Matrix C: derivative of the measurement at the beginning with respect to the
    local coordinates there; `None` without a measurement."""
    state: Any
    """State at the end of the unperturbed period."""
    measured: Array | None
    """Measurement at the beginning of the period; `None` without `measure`."""
    coordinates: LocalCoordinates
    """Local coordinates of the matrices: names, and conversion to and from states."""


def linearise(
    model: Any,
    state: Any,
    dt: TimeStep,
    n_steps: int = 1,
    *,
    control: Any = None,
    with_control: WithControl | None = None,
    measure: Measure | None = None,
    first: int | Array = 0,
    coordinates: LocalCoordinates | None = None,
) -> Linearisation:
    """Makes the linear model of one control period about a state and a control.

    The derivatives are those of the discrete time steps, with damping, contact and
    drag. Where contact begins or ends, they are one-sided. Define `with_control` and
    `measure` at module level, so that each is compiled only once.

    Args:
        model: The scene or the system.
        state: State at the beginning of the period.
        dt: Step size [s], or the result of `stable_dt`.
        n_steps: Number of steps in the period.
        control: Control that is held during the period, an array.
        with_control: `(model, control) -> model`: the model under a control.
        measure: `(model, state) -> array`: a measurement, such as marker positions.
        first: Number of steps since time zero, if the model depends on time.
        coordinates: Local coordinates of this model, needed inside `jax.jit`.

    Returns:
        The matrices, in local coordinates, and the state after the period.

    Raises:
        ValueError: If an argument is out of range, one of `control` and `with_control`
            is missing, or anything is traced and `coordinates` are not given.
        TypeError: If the model or the state has the wrong type.

    Example:
        >>> arm = control.linearise(scene, state, 1e-4, n_steps=10)
        >>> roots = jnp.linalg.eigvals(arm.state_matrix)
        >>> bool(jnp.abs(roots).max() < 1.0)  # damping makes every motion decay
        True
    """
    begin = check_first(model, first, check_count("n_steps", n_steps, 1))
    step = model.check_run(state, dt, begin)
    if not is_traced(model, state, step):
        check_step(model.recalling(state), step, state)
    given = checked_control(control, with_control, step.dtype)
    if coordinates is None:
        coordinates = coordinates_under(model, state, step, given, with_control)
    check_kind("coordinates", coordinates, LocalCoordinates)
    start = jnp.zeros((), jnp.int32) if begin is None else begin
    ways = coordinates.directions(
        state, first=start, control=given, with_control=with_control
    )
    after, by_state, by_control = period(
        coordinates, model, state, ways, step, n_steps, start, given, with_control
    )
    seen: Any = (None, None)
    if measure is not None:
        now = model.at(start * step) if model.depends_on_time else model
        seen = measured(coordinates, now, state, ways, measure)
    return Linearisation(
        state_matrix=by_state,
        input_matrix=None if given is None else by_control,
        output_matrix=seen[1],
        state=after,
        measured=seen[0],
        coordinates=coordinates,
    )


def checked_control(
    control: Any, with_control: WithControl | None, dtype: Any, name: str = "control"
) -> Array | None:
    """Validates a control and returns it as an array of `dtype`; `None` for `None`.

    `with_control` must be given if and only if `control` is. `name` is the control's
    name in error messages.

    Raises:
        ValueError: If only one of `control` and `with_control` is given, or the control
            is not finite.
    """
    if (control is None) != (with_control is None):
        missing = "with_control" if with_control is None else name
        raise ValueError(f"{name} and with_control go together, but {missing} is None")
    if control is None:
        return None
    numbers = numeric(name, control)
    return as_array(name, numbers, "", [numbers.shape], dtype=dtype)


def period(
    coordinates: LocalCoordinates,
    model: Any,
    state: Any,
    ways: Array,
    dt: Array,
    n_steps: ArrayLike,
    first: ArrayLike,
    control: Array | None,
    with_control: WithControl | None,
) -> tuple[Any, Array, Array]:
    """Returns the state after a period, and the matrices A and B.

    Args:
        coordinates: The local coordinates.
        model: The scene or system, without the control.
        state: State at the beginning.
        ways: Changes of all components per coordinate, from
            `LocalCoordinates.directions`.
        dt: Step size [s].
        n_steps: Number of steps.
        first: Number of steps since time zero.
        control: Control, or `None`.
        with_control: `(model, control) -> model`, or `None` without a control.
    """
    after, tangents = tangent_map(
        model, state, dt, n_steps, first, control, with_control
    )
    chosen = coordinates.chosen(state, tangents)
    count = len(ways)
    return after, chosen[:, :count] @ ways, chosen[:, count:]


@jax.jit(static_argnames="measure")
def measured(
    coordinates: LocalCoordinates,
    model: Any,
    state: Any,
    ways: Array,
    measure: Measure,
) -> tuple[Array, Array]:
    """Returns a measurement of a state, and its derivatives C.

    C is with respect to local coordinates. `ways` is the matrix from
    `LocalCoordinates.directions`: changes of all components of the state per
    coordinate.
    """
    now = model.recalling(state)

    def seen(step: Array) -> tuple[Array, Array]:
        made = measure(now, coordinates.moved(state, ways, step))
        return ravel_pytree(made)[0], made

    def column(way: Array) -> tuple[Array, Array]:
        _, change, made = jax.jvp(seen, (jnp.zeros_like(way),), (way,), has_aux=True)
        return made, change

    size = coordinates.size
    made: tuple[Array, Array] = jax.vmap(column, out_axes=(None, -1))(
        jnp.eye(size, dtype=ways.dtype)
    )
    return made
