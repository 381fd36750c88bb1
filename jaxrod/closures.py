"""Functions from users that hold traced numbers, which become parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.jax_internals.equations import program_of
from jaxrod.validation import is_traced


def with_parameters(
    function: Callable[[Any, Any], Any], point: Any, parameters: Any
) -> tuple[Callable[[Any, Any], Any], Any]:
    """Function and parameters in which traced numbers of the function are parameters.

    A run that is differentiated fixes its number of steps if something in its scene is
    traced. It cannot see a traced number inside a function.

    Args:
        function: Function of a point and of parameters, for one point.
        point: A point.
        parameters: Its parameters, a pytree of arrays.

    Returns:
        What was given, unless the function holds traced numbers.
    """
    traced = jax.make_jaxpr(function)(point, parameters)
    jaxpr, held = program_of(traced)
    if not is_traced(held):
        return function, parameters
    types = [(p.shape, p.dtype) for p in jax.tree.leaves((point, parameters))]

    def opened(point: Any, given: Any) -> Any:
        parameters, numbers = given
        leaves = jax.tree.leaves((point, parameters))
        # The program has the types with which it was traced.
        fitting = [
            jnp.asarray(leaf, dtype)
            for leaf, (_, dtype) in zip(leaves, types, strict=True)
        ]
        constants = [
            jnp.asarray(number, known.dtype)
            for number, known in zip(numbers, held, strict=True)
        ]
        found = jax.core.eval_jaxpr(jaxpr, constants, *fitting)[0]
        return found.astype(point.dtype)

    return opened, (parameters, list(held))
