"""The loop over the steps of a run, made so that lanes may take it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.lanes.choice import lanes_wanted, refused, supported
from jaxrod.lanes.cycle import Cycle, Plan


def stepped(integrator: Any, carry: Any, n_times: Any) -> Any:
    """The carry of an integrator after some cycles; `None` where XLA is to loop.

    Args:
        integrator: A pytree with a method `cycle`.
        carry: What it works on.
        n_times: How many cycles, an `int` or traced.
    """
    if not lanes_wanted():
        return None
    from jaxrod.lanes.primitives import cycles_p

    constants, structure = jax.tree.flatten(integrator)
    begun, carried = jax.tree.flatten(carry)
    constants = [_settled(leaf) for leaf in constants]
    begun = [_settled(leaf) for leaf in begun]

    def cycle(*leaves: Any) -> list[Any]:
        stepper = jax.tree.unflatten(structure, leaves[: len(constants)])
        now = jax.tree.unflatten(carried, leaves[len(constants) :])
        return jax.tree.leaves(stepper.cycle(now))

    closed = jax.make_jaxpr(cycle)(*constants, *begun)
    words = supported(closed.jaxpr)
    same = [
        (after.shape, after.dtype) == (before.shape, before.dtype)
        for after, before in zip(closed.out_avals, begun, strict=True)
    ]
    if words is None and not all(same):
        words = "what a step makes is not of the type of what it is given"
    if words is not None:
        refused(words)
        return None
    length = n_times if isinstance(n_times, int) else None
    after = cycles_p.bind(
        jnp.asarray(n_times, jnp.int32),
        *constants,
        *begun,
        plan=Plan(Cycle(closed, len(constants)), length),
    )
    return jax.tree.unflatten(carried, after)


def _settled(leaf: Any) -> Any:
    """An array whose type is its own, not that of what it is joined with."""
    array = jnp.asarray(leaf)
    return lax.convert_element_type(array, array.dtype)
