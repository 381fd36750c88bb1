"""Flows: velocity of the surrounding fluid in space and time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.effects.time import Timed, as_timed, at_clock, clock_at, is_schedule
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree, static
from jaxrod.validation import as_array


@pytree
class UniformFlow:
    """A flow that is the same everywhere."""

    velocity: Float[Array, "3"]
    """Velocity, world frame [m/s]."""

    def at(self, points: Vec3) -> Vec3:
        """The velocity at each point [m/s]."""
        x, y, z = (jnp.broadcast_to(v, points[0].shape) for v in self.velocity)
        return x, y, z


@pytree
class FlowField:
    """A flow given by a function of position."""

    parameters: Any
    """Traced numbers of the flow: any pytree of arrays and schedules."""
    function: Callable[[Any, Any], Any] = static()
    """Velocity `(3,)` [m/s] at one point `(3,)` [m], given the parameters."""

    def at(self, points: Vec3) -> Vec3:
        """The velocity at each point [m/s]."""
        at_each = jax.vmap(self.function, in_axes=(1, None), out_axes=1)
        found = at_each(jnp.stack(points), self.parameters)
        return found[0], found[1], found[2]


Flow = UniformFlow | FlowField


def flow_field(
    function: Callable[[Any, Any], ArrayLike], parameters: Any = ()
) -> FlowField:
    """A flow that varies in space, and in time if a parameter does.

    Args:
        function: Pure function from one point `(3,)` [m] and `parameters` to the
            velocity of the fluid there `(3,)`, world frame [m/s]. A program is compiled
            for each function, so use the same one again.
        parameters: Traced numbers of the flow: any pytree of numbers and schedules,
            such as `jaxrod.schedules.time()`.

    Raises:
        ValueError: If the function does not give three numbers at a point, or a
            parameter is not a number that can be stored.
        TypeError: If `function` is not callable.
    """
    if not callable(function):
        raise TypeError(f"function must be callable, got {type(function).__name__}")

    def number(leaf: Any) -> Any:
        if is_schedule(leaf):
            return leaf
        return as_array("parameters", leaf, "", [np.shape(leaf)])

    dtype = jnp.result_type(float)
    numbers = jax.tree.map(number, parameters, is_leaf=is_schedule)
    point = jax.ShapeDtypeStruct((3,), dtype)
    now = at_clock(numbers, clock_at(0.0, dtype))
    got = jax.eval_shape(function, point, now)
    if getattr(got, "shape", None) != (3,):
        raise ValueError(
            "function must give one velocity of shape (3,) [m/s] at a point of shape "
            f"(3,), got {got}"
        )
    return FlowField(numbers, function)


def as_flow(flow: Flow | Timed | None) -> Flow | None:
    """Checks an argument that may be a flow, a velocity or `None`.

    Raises:
        ValueError: If it is not one of them.
    """
    if flow is None or isinstance(flow, UniformFlow | FlowField):
        return flow
    return UniformFlow(as_timed("flow", flow, "m/s", (3,)))
