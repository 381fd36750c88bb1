"""The steps of a run, built in the form that lanes can take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.jax_internals.equations import result_types
from jaxrod.jax_internals.mesh_axes import axes_of, pvary, varying_shape
from jaxrod.lanes.choice import (
    NEVER,
    lane_mode,
    lanes_wanted,
    refused,
    say_if_slower,
)
from jaxrod.lanes.jaxpr.unroll import supported
from jaxrod.lanes.run_spec import Ends, LoopBody, RunSpec


def try_lanes(integrator: Any, given: Any, n_times: Any) -> Any:
    """Runs an integrator's cycles from a state; `None` if XLA has to do the loop.

    Args:
        integrator: A pytree with methods `begin`, `cycle` and `end`.
        given: Argument of `begin`, the state.
        n_times: Number of cycles, an `int` or traced.

    Returns:
        The result of `end` after all cycles, or `None`.
    """
    if not lanes_wanted():
        if lane_mode() != NEVER:
            say_if_slower()
        return None
    from jaxrod.lanes.primitives import run_p

    constants, structure = jax.tree.flatten(integrator)
    state = [_settled(leaf) for leaf in jax.tree.leaves(given)]
    constants = [_settled(leaf) for leaf in constants]
    steps = jnp.asarray(n_times, jnp.int32)
    axes = axes_of(*map(jax.typeof, (steps, *constants, *state)))
    constants, state = pvary(constants, axes), pvary(state, axes)
    n = len(constants)

    def part(name: str, argument: Any) -> tuple[Any, Any]:
        """Returns a method as a closed jaxpr, and the tree of its result."""
        leaves, tree = jax.tree.flatten(argument)
        result: list[Any] = []

        def method(*arrays: Any) -> list[Any]:
            stepper = jax.tree.unflatten(structure, arrays[:n])
            bound: Callable[[Any], Any] = getattr(stepper, name)
            made, made_tree = jax.tree.flatten(
                bound(jax.tree.unflatten(tree, arrays[n:]))
            )
            result.append(made_tree)
            return pvary([_settled(leaf) for leaf in made], axes)

        closed = jax.make_jaxpr(method)(*constants, *leaves)
        return closed, result[0]

    state_tree = jax.tree.structure(given)
    begin, carried = part("begin", jax.tree.unflatten(state_tree, state))
    carry = [varying_shape(aval) for aval in result_types(begin)]
    body, cycled = part("cycle", jax.tree.unflatten(carried, carry))
    end, made_tree = part("end", jax.tree.unflatten(carried, carry))
    words = None
    for closed in (begin, body, end):
        words = words or supported(closed)
    after = [(a.shape, a.dtype) for a in result_types(body)]
    if words is None and (cycled, after) != (
        carried,
        [(a.shape, a.dtype) for a in carry],
    ):
        words = "what a step makes is not of the type of what it is given"
    if words is not None:
        refused(words)
        return None
    made = run_p.bind(
        steps,
        *constants,
        *state,
        spec=RunSpec(
            LoopBody(body, n),
            n_times if isinstance(n_times, int) else None,
            ends=Ends(begin, end, n),
        ),
    )
    return jax.tree.unflatten(made_tree, made)


def _settled(leaf: Any) -> Any:
    """Returns an array whose dtype is no longer weak."""
    array = jnp.asarray(leaf)
    return lax.convert_element_type(array, array.dtype)
