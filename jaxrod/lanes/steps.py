"""The steps of a run as JAX primitives, which kernels can replace at compile time."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxrod.jax_internals.equations import (
    computed_results,
    program_of,
    result_types,
)
from jaxrod.jax_internals.mesh_axes import axes_of, pvary, varying_shape
from jaxrod.lanes.choice import (
    NEVER,
    lane_mode,
    lanes_wanted,
    refused,
    rows_wanted,
    say_if_slower,
)
from jaxrod.lanes.jaxpr.unroll import supported
from jaxrod.lanes.run_spec import (
    Ends,
    LoopBody,
    RunSpec,
    as_step,
    in_one_kernel,
    is_in_one_kernel,
)

MOST_PROGRAMS = 128
"""Number of traced methods that are remembered."""
_programs: dict[Any, tuple[Any, Any]] = {}
"""Traced methods by their name and the structure and types of their operands, the
oldest first. Runs and derivatives of equal models thus share programs and kernels."""
_body = lru_cache(MOST_PROGRAMS)(LoopBody)
_ends = lru_cache(MOST_PROGRAMS)(Ends)
_step = lru_cache(MOST_PROGRAMS)(as_step)
_computed = lru_cache(MOST_PROGRAMS)(computed_results)


def try_lanes(integrator: Any, given: Any, n_times: Any) -> Any:
    """Runs an integrator from a state to a result, by a primitive that has kernels.

    Args:
        integrator: A pytree with methods `begin`, `cycle` and `end`. If its attribute
            `iterates` is true, a cycle has loops whose length depends on numbers.
        given: State, the argument of `begin`.
        n_times: Number of cycles, an `int` or traced.

    Returns:
        The result of `end` after all cycles; `None` if a kernel cannot run them, so
        that the caller has to write the loop for XLA.
    """
    if not _kernels_wanted():
        return None
    if getattr(integrator, "iterates", False) and not rows_wanted():
        refused("lanes have no loop whose length depends on numbers")
        return None
    from jaxrod.lanes.primitives import run_p

    parts = _Parts(integrator, given, n_times)
    begin, carried = parts.program("begin", parts.given)
    carry = parts.like(carried, begin)
    body, cycled = parts.program("cycle", carry)
    end, made_tree = parts.program("end", carry)
    if _refused(parts, carried, begin, body, cycled, begin, end):
        return None
    ends = _ends(begin, end, parts.n)
    spec = RunSpec(_body(body, parts.n), parts.length, ends=ends)
    made = run_p.bind(*parts.operands, spec=spec)
    return jax.tree.unflatten(made_tree, made)


def try_cycles(integrator: Any, carry: Any, n_times: Any) -> Any:
    """Repeats an integrator's cycle from a carry, by a primitive that has kernels.

    Args:
        integrator: A pytree with a method `cycle`.
        carry: Carry before the first cycle, the argument of `cycle`.
        n_times: Number of cycles, an `int` or traced.

    Returns:
        The carry after all cycles; `None` if a kernel cannot run them, so that the
        caller has to write the loop for XLA.
    """
    if not _kernels_wanted():
        return None
    from jaxrod.lanes.primitives import cycles_p

    parts = _Parts(integrator, carry, n_times)
    carried = jax.tree.structure(carry)
    body, cycled = parts.program("cycle", parts.given)
    if _refused(parts, carried, None, body, cycled):
        return None
    spec = RunSpec(_body(body, parts.n), parts.length)
    made = cycles_p.bind(*parts.operands, spec=spec)
    return jax.tree.unflatten(carried, made)


def by_kernel(integrator: Any, name: str, given: Any, *, iterates: bool = False) -> Any:
    """Calls a method of an integrator, by a kernel if possible, and otherwise by XLA.

    Args:
        integrator: A pytree.
        name: Name of the method.
        given: Argument of the method.
        iterates: Whether the method has loops whose length depends on numbers. Only
            rows have such loops. Elsewhere XLA runs the method, and only its calls of
            `by_kernel` become kernels.
    """
    left_out = is_in_one_kernel() or (iterates and not rows_wanted())
    if left_out or not _kernels_wanted():
        return getattr(integrator, name)(given)
    from jaxrod.lanes.primitives import run_once

    parts = _Parts(integrator, given, 1)
    closed, made_tree = parts.program(name, parts.given)
    words = _foreign(closed) or supported(closed)
    if words is not None:
        refused(words)
        return getattr(integrator, name)(given)
    _, *arrays = parts.operands
    # What a method only passes on is no result of the kernel.
    closed, passed_on = _computed(closed)
    made = iter(())
    if None in passed_on:
        step = _step(closed, parts.n)
        made = iter(run_once(step, arrays[: parts.n], arrays[parts.n :]))
    results = [next(made) if i is None else arrays[i] for i in passed_on]
    return jax.tree.unflatten(made_tree, results)


def _kernels_wanted() -> bool:
    if lanes_wanted():
        return True
    if lane_mode() != NEVER:
        say_if_slower()
    return False


class _Parts:
    """Methods of an integrator as closed jaxprs, and the operands of a run of it."""

    def __init__(self, integrator: Any, given: Any, n_times: Any) -> None:
        constants, self.structure = jax.tree.flatten(integrator)
        state = [_settled(leaf) for leaf in jax.tree.leaves(given)]
        constants = [_settled(leaf) for leaf in constants]
        steps = jnp.asarray(n_times, jnp.int32)
        self.axes = axes_of(*map(jax.typeof, (steps, *constants, *state)))
        self.constants, state = pvary(constants, self.axes), pvary(state, self.axes)
        self.n = len(constants)
        self.length = n_times if isinstance(n_times, int) else None
        self.operands = (steps, *self.constants, *state)
        self.state = state
        self.given = jax.tree.unflatten(jax.tree.structure(given), state)

    def program(self, name: str, argument: Any) -> tuple[Any, Any]:
        """Returns a method as a closed jaxpr, and the tree structure of its result.

        It is traced for `argument`, a pytree of arrays or array types, once for equal
        structures and types.
        """
        leaves, tree = jax.tree.flatten(argument)
        types = tuple((leaf.shape, leaf.dtype) for leaf in (*self.constants, *leaves))
        wide: Any = getattr(jax.config, "jax_enable_x64", None)
        mesh = jax.sharding.get_abstract_mesh()
        key = (name, self.structure, tree, types, self.axes, mesh, wide)
        if key in _programs:
            return _programs[key]
        result: list[Any] = []

        def method(*arrays: Any) -> list[Any]:
            stepper = jax.tree.unflatten(self.structure, arrays[: self.n])
            bound: Callable[[Any], Any] = getattr(stepper, name)
            made, made_tree = jax.tree.flatten(
                bound(jax.tree.unflatten(tree, arrays[self.n :]))
            )
            result.append(made_tree)
            return pvary([_settled(leaf) for leaf in made], self.axes)

        with in_one_kernel():
            closed = jax.make_jaxpr(method)(*self.constants, *leaves)
        if _foreign(closed) is not None:
            # A function in the structure holds a number of this trace alone.
            return closed, result[0]
        while len(_programs) >= MOST_PROGRAMS:
            del _programs[next(iter(_programs))]
        _programs[key] = closed, result[0]
        return _programs[key]

    def like(self, tree: Any, closed: Any) -> Any:
        """Returns a pytree of structure `tree` with a closed jaxpr's result types."""
        types = [varying_shape(aval) for aval in result_types(closed)]
        return jax.tree.unflatten(tree, types)


def _refused(
    parts: _Parts, carried: Any, begin: Any, body: Any, cycled: Any, *programs: Any
) -> bool:
    """Whether a loop is left to XLA; if so, the reason is recorded.

    Every jaxpr must be supported, and a step must keep the carry's types. `carried` and
    `cycled` are the trees of the carry before and after a step. `begin` computes the
    first carry; it is `None` if the carry is an operand.
    """
    words = None
    for closed in (body, *programs):
        words = words or _foreign(closed) or supported(closed)
    given = parts.state if begin is None else result_types(begin)
    before = [(a.shape, a.dtype) for a in given]
    after = [(a.shape, a.dtype) for a in result_types(body)]
    if words is None and (cycled, after) != (carried, before):
        words = "the output of a step differs in type from its input"
    if words is not None:
        refused(words)
    return words is not None


def _foreign(closed: Any) -> str | None:
    """Reason why kernels cannot run a program: it holds a number of another trace.

    A function that was defined while JAX traced can hold such a number.
    """
    known = program_of(closed).constants
    if any(isinstance(number, jax.core.Tracer) for number in known):
        return "a function holds a traced number: give it as one of its parameters"
    return None


def _settled(leaf: Any) -> Any:
    """Returns a value as an array without weak type, as carries of loops require."""
    array = jnp.asarray(leaf)
    return lax.convert_element_type(array, array.dtype)
