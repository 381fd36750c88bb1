r"""Process for state estimation: a model with disturbances, measured with noise.

In period $k$ the control $u_k$ is constant. Random disturbances add to it and to the
state. The state at the end of the period is measured with noise:

$$x_{k+1} = f(x_k, u_k + w_k) \oplus v_k, \qquad y_k = h(x_k) + e_k,$$

$w \sim N(0, \mathrm{diag}(s^2))$, $v \sim N(0, Q)$, $e \sim N(0, \mathrm{diag}(r^2))$,
with $v$ in local coordinates. An estimate is a state and a covariance $P$ of local
coordinates about it. It stores the square root $L$ of $P = L L^T$, so that rounding
cannot make $P$ indefinite.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from jaxrod.control.linearisation import Measure, checked_control
from jaxrod.control.local_coordinates import (
    LocalCoordinates,
    WithControl,
    coordinates_under,
)
from jaxrod.model import TimeStep
from jaxrod.stepping.runs import check_step, with_memory
from jaxrod.structure import pytree, static
from jaxrod.validation import (
    as_array,
    as_time_step,
    check_count,
    check_kind,
    is_traced,
    knows_constants,
    numeric,
)

ROUNDING = 100
"""Largest asymmetry or negative eigenvalue of a scaled covariance matrix that counts as
round-off, in units of machine epsilon times the matrix size [1]."""


@pytree
class Process:
    """A model with disturbances, measured with noise; make it with `make_process`.

    Its arrays are traced, so `jax.vmap` handles a batch of processes.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> process.n_steps, process.noise.shape, process.coordinates.size
        (10, (3,), 120)
    """

    model: Any
    """The scene or system, without controls."""
    coordinates: LocalCoordinates
    """Local coordinates of the model's states."""
    dt: Float[Array, ""]
    """Step size [s]."""
    noise: Float[Array, "..."]
    """Standard deviations of the measurement noise, in the measurement's shape."""
    state_root: Float[Array, "size size"] | None
    """Square root L of the covariance Q = L L^T that each period adds to the state in
    local coordinates; `None` for no state disturbance."""
    control_noise: Float[Array, "..."] | None
    """Standard deviations of the control's disturbance, in the control's shape; `None`
    for a process without control."""
    n_steps: int = static()
    """Number of time steps in a period."""
    measure: Measure = static()
    """`(model, state) -> array`: noise-free measurement of a state."""
    with_control: WithControl | None = static()
    """`(model, control) -> model`: the model under a control; `None` if it has none."""

    def at(self, steps: ArrayLike) -> Any:
        """Model with its schedules evaluated at the time `steps` times `dt`."""
        if not self.model.depends_on_time:
            return self.model
        return self.model.at(jnp.asarray(steps) * self.dt)

    def control(self, control: Any) -> Array | None:
        """Validates a control and returns it as an array.

        For `None` it returns zeros, or `None` for a process without control.

        Raises:
            ValueError: If its shape is wrong, or the process takes no control.
        """
        if self.control_noise is None or self.with_control is None:
            if control is not None:
                raise ValueError(
                    "control must be None for a process without with_control"
                )
            return None
        if control is None:
            return jnp.zeros_like(self.control_noise)
        shape = self.control_noise.shape
        return as_array("control", control, "", [shape], dtype=self.dt.dtype)


@pytree
class Estimate:
    """Estimated state, with the covariance of its error in local coordinates.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> loose = process.coordinates.filled(velocity=0.1)
        >>> estimate = estimation.first_estimate(process, state, loose**2)
        >>> estimate.covariance.shape, round(float(estimate.deviations.max()), 3)
        ((120, 120), 0.1)
    """

    state: Any
    """The estimated state."""
    root: Float[Array, "size size"]
    """Square root L of the covariance L L^T."""
    steps: Int[Array, ""]
    """Number of time steps since time zero."""

    @property
    def covariance(self) -> Float[Array, "size size"]:
        """Covariance $L L^T$ of local coordinates of the true state about `state`."""
        return self.root @ jnp.swapaxes(self.root, -1, -2)

    @property
    def deviations(self) -> Float[Array, " size"]:
        """Standard deviation of each local coordinate."""
        return jnp.sqrt(jnp.sum(self.root**2, axis=-1))


@knows_constants
def make_process(
    model: Any,
    state: Any,
    dt: TimeStep,
    n_steps: int,
    *,
    measure: Measure,
    noise: Any,
    state_noise: Any = None,
    with_control: WithControl | None = None,
    control_noise: Any = None,
) -> Process:
    """Makes a process, with validated arguments.

    To estimate an unknown force, treat it as a control whose known value is zero:
    `with_control` applies it to the model, `control_noise` is its standard deviation.

    Args:
        model: The scene or system, without controls.
        state: A state of the model, from which its local coordinates are found.
        dt: Step size [s], or the result of `stable_dt`.
        n_steps: Number of steps in a period, from one measurement to the next.
        measure: `(model, state) -> array`: a measurement without noise.
        noise: Standard deviations of the measurement noise, a number or an array of
            the measurement's shape.
        state_noise: Covariance that every period adds to the state in local
            coordinates: variances `(size,)` or a matrix `(size, size)`.
        with_control: `(model, control) -> model`: the model under a control.
        control_noise: Standard deviations of the control's disturbance, which is
            constant during a period and independent between periods: an array in the
            control's shape, zero for known components. It is required with
            `with_control`.

    Raises:
        ValueError: If an argument is out of range or shapes do not match.
        TypeError: If the model or the state has the wrong type.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> process.noise.shape, process.coordinates.size
        ((3,), 120)
    """
    n_steps = check_count("n_steps", n_steps, 1)
    unknown = checked_control(
        control_noise, with_control, jnp.result_type(float), "control_noise"
    )
    coordinates = coordinates_under(model, state, dt, unknown, with_control)
    step = as_time_step(dt, coordinates.instant.dtype)
    check_step(model.recalling(state), step, state)
    if unknown is not None:
        shape = unknown.shape
        unknown = as_array(
            "control_noise", control_noise, "", [shape], non_negative=True,
            dtype=step.dtype,
        )  # fmt: skip
    now = model.at(0.0).recalling(state)
    shape = np.shape(measure(now, state))
    spread = as_array("noise", noise, "", [(), shape], positive=True, dtype=step.dtype)
    root = None
    if state_noise is not None:
        root = root_of("state_noise", state_noise, coordinates)
    return Process(
        model=model,
        coordinates=coordinates,
        dt=step,
        noise=jnp.broadcast_to(spread, shape),
        state_root=root,
        control_noise=unknown,
        n_steps=n_steps,
        measure=measure,
        with_control=with_control,
    )


def first_estimate(
    process: Process, state: Any, covariance: Any, *, steps: ArrayLike = 0
) -> Estimate:
    """Makes the estimate with which a filter begins.

    Args:
        process: The process.
        state: The most likely state.
        covariance: Covariance of local coordinates about `state`: variances `(size,)`
            or a matrix `(size, size)`, which may be singular.
        steps: Number of steps since time zero.

    Raises:
        ValueError: If the covariance has the wrong shape, or is not symmetric and
            positive semidefinite.
        TypeError: If `process` is not a `Process`.

    Example:
        >>> process = estimation.make_process(
        ...     scene, state, 1e-4, 10, measure=lambda _, seen: seen.tip, noise=1e-3
        ... )
        >>> loose = process.coordinates.filled(velocity=0.1, angular_velocity=1.0)
        >>> estimate = estimation.first_estimate(process, state, loose**2)
        >>> round(float(estimate.deviations.max()), 3)  # [rad/s]
        1.0
    """
    check_process(process)
    process.model.check_run(state, process.dt, None)
    return Estimate(
        state=with_memory(process.model, state),
        root=root_of("covariance", covariance, process.coordinates),
        steps=jnp.asarray(steps, jnp.int32),
    )


def root_of(
    name: str, covariance: Any, coordinates: LocalCoordinates
) -> Float[Array, "size size"]:
    """Square root L of a covariance P = L L^T of local coordinates.

    `covariance` holds variances `(size,)` or is a matrix `(size, size)`; `name` is its
    name in error messages.

    Raises:
        ValueError: If its shape is wrong, or it is not symmetric and positive
            semidefinite.
    """
    size, dtype = coordinates.size, coordinates.instant.dtype
    given = numeric(name, covariance)
    if given.ndim == 1:
        variances = as_array(name, given, "", [(size,)], non_negative=True, dtype=dtype)
        return jnp.diag(jnp.sqrt(variances))
    matrix = as_array(name, given, "", [(size,), (size, size)], dtype=dtype)
    # Scaled to unit variances, because units of coordinates differ widely.
    units = jnp.sqrt(jnp.abs(jnp.diagonal(matrix)))
    units = jnp.where(units > 0, units, 1)
    scaled = matrix / units[:, None] / units[None]
    least = ROUNDING * float(jnp.finfo(dtype).eps) * size
    if not is_traced(scaled) and float(jnp.max(jnp.abs(scaled - scaled.T))) > least:
        raise ValueError(f"{name} must be symmetric")
    values, ways = jnp.linalg.eigh(0.5 * (scaled + scaled.T))
    if not is_traced(values) and float(values[0]) < -least * max(float(values[-1]), 1):
        raise ValueError(
            f"{name} must be positive semidefinite, got an eigenvalue of "
            f"{float(values[0]):.3g} in units of its variances"
        )
    return units[:, None] * ways * jnp.sqrt(jnp.maximum(values, 0))[None]


def check_process(process: Any) -> None:
    """Raises a `TypeError` unless `process` is a `Process`."""
    check_kind("process", process, Process)


def check_estimate(process: Process, estimate: Any, name: str = "estimate") -> None:
    """Raises unless `estimate` is an `Estimate` with the coordinates of `process`.

    `name` is its name in the error message.
    """
    check_process(process)
    check_kind(name, estimate, Estimate)
    size = process.coordinates.size
    if estimate.root.shape != (size, size):
        raise ValueError(
            f"{name}.root must have shape {(size, size)}, as the process has {size} "
            f"local coordinates, got {estimate.root.shape}"
        )
