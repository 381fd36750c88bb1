"""Unrolling: translation of a jaxpr of arrays to a graph of single numbers.

Every array becomes an array of nodes of a graph. Primitives that only move numbers
(slices, pads, transposes, ...) cost nothing, because they only rearrange nodes. Others
add a node for every number. Loops of known length are unrolled, all branches are
computed and one is selected, and nested calls are inlined.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.jax_internals.equations import (
    CALLS,
    called_program,
    is_literal,
    program_of,
    programs_within,
    scan_of,
    unknown_parameter,
    while_of,
)
from jaxrod.lanes.graph import KINDS, Graph

MOST_NODES = 400_000
"""Largest number of nodes of a graph: longer programs take minutes to compile."""


class NotUnrolled(Exception):
    """Raised with the reason if a program cannot be translated or is too long."""


class Unroller:
    """Translates jaxprs to nodes of one graph; each node is a single number."""

    def __init__(self, graph: Graph, most: int = MOST_NODES) -> None:
        """Makes an unroller with the rules of all registered primitives.

        Args:
            graph: Graph to which nodes are added.
            most: Largest number of nodes; longer programs are refused.
        """
        self.graph, self.most = graph, most
        self.rules: dict[str, Rule] = RULES
        """Translation rules, by name of the primitive."""

    def run(self, closed: Any, arrays: Sequence[Any]) -> list[Any]:
        """Translates a closed jaxpr; takes and returns arrays of nodes.

        Raises:
            NotUnrolled: The jaxpr contains something unknown, or is too long.
        """
        jaxpr, constants = program_of(closed)
        values: dict[Any, Any] = {}
        for variable, const in zip(jaxpr.constvars, constants, strict=True):
            values[variable] = self.known(const, variable.aval)
        for variable, array in zip(jaxpr.invars, arrays, strict=True):
            values[variable] = array

        def read(atom: Any) -> Any:
            if is_literal(atom):
                return self.known(atom.val, atom.aval)
            return values[atom]

        for equation in jaxpr.eqns:
            name = equation.primitive.name
            words = _unknown(equation, self.rules)
            if words is not None:
                raise NotUnrolled(words)
            given = [read(atom) for atom in equation.invars]
            try:
                made = self.rules[name](self, equation, *given)
            except (KeyError, AttributeError) as error:
                raise NotUnrolled(f"'{name}' is not as expected: {error!r}") from error
            results = made if isinstance(made, list) else [made]
            for variable, result in zip(equation.outvars, results, strict=True):
                result = self.as_array(result)
                if result.shape != variable.aval.shape:
                    raise AssertionError(
                        f"{name}: {result.shape}, not {variable.aval.shape}"
                    )
                values[variable] = result
            if self.graph.n_operations > self.most:
                raise NotUnrolled(f"the program has more than {self.most} operations")
        return [read(atom) for atom in jaxpr.outvars]

    def as_array(self, result: Any) -> Any:
        """Returns the result of a rule as an array of nodes."""
        return np.asarray(result, np.int64)

    def number(self, array: Any) -> int:
        """Returns the only node of an array of one number."""
        return int(array)

    def each(self, operation: str, kind: str, *arrays: Any) -> Any:
        """Returns the nodes of an operation, applied to arrays of nodes entry by entry.

        `kind` is the type of the results, such as `"f32"`.
        """
        return self.graph.each(operation, kind, *arrays)

    def mapped(self, function: Callable[..., int], kind: str, *arrays: Any) -> Any:
        """Returns the nodes that a function returns for the entries of arrays of nodes.

        The arrays are broadcast; `kind` is the type of the results, such as `"f32"`.
        """
        return self.graph.mapped(function, *arrays)

    def full(self, value: Any, shape: tuple[int, ...], kind: str) -> Any:
        """Returns an array whose entries are all the node of one known number.

        `kind` is the type of the number, such as `"f32"`.
        """
        return np.full(shape, self.graph.constant(value, kind), np.int64)

    def known(self, value: Any, aval: Any) -> Any:
        """Returns nodes of known numbers, broadcast to shape and dtype of `aval`."""
        return self.graph.constants(
            np.broadcast_to(np.asarray(value, kind_dtype(aval)), aval.shape)
        )


def kind_of(aval: Any) -> str:
    """Returns the name of the number type of an array, such as `"f32"`.

    Raises:
        NotUnrolled: Kernels do not support this type.
    """
    kind = KINDS.get(np.dtype(aval.dtype)) if _plain(aval.dtype) else None
    if kind is None:
        raise NotUnrolled(f"lanes have no numbers of type {aval.dtype}")
    return kind


def kind_dtype(aval: Any) -> np.dtype:
    """Returns the dtype of an array.

    Raises:
        NotUnrolled: Kernels do not support this type.
    """
    kind_of(aval)
    return np.dtype(aval.dtype)


def _plain(dtype: Any) -> bool:
    return isinstance(dtype, np.dtype) or not jnp.issubdtype(dtype, jax.dtypes.extended)


Rule = Callable[..., Any]
RULES: dict[str, Rule] = {}
"""Rules by name of the primitive. A rule takes an unroller, an equation and the nodes
of its operands, and returns the nodes of the results."""


def rule(*names: str, rules: dict[str, Rule] = RULES) -> Callable[[Rule], Rule]:
    """Registers a function as the translation rule of primitives (a decorator).

    The rule is added to the table `rules` under the names of the primitives.
    """

    def note(function: Rule) -> Rule:
        for name in names:
            rules[name] = function
        return function

    return note


def supported(program: Any) -> str | None:
    """Returns the reason why a jaxpr cannot be unrolled, or `None`.

    Only primitives, their parameters and types are checked, not the values of indices
    and conditions, nor the length.
    """
    jaxpr = program_of(program).jaxpr
    for variable in (*jaxpr.invars, *jaxpr.constvars):
        if not hasattr(variable.aval, "dtype"):
            return f"lanes have no {variable.aval}"
    for equation in jaxpr.eqns:
        words = _unknown(equation, RULES)
        if words is not None:
            return words
        for inner in programs_within(equation):
            words = supported(inner)
            if words is not None:
                return words
    return None


def _unknown(equation: Any, rules: dict[str, Rule]) -> str | None:
    name = equation.primitive.name
    if name not in rules:
        return f"lanes do not know the primitive '{name}'"
    return unknown_parameter(equation)


MOST_ROUNDS = 10_000
"""Largest number of iterations for which a `while` loop is unrolled."""


@rule(*CALLS)
def called(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates a nested call: the operations of its program are inlined."""
    return unroller.run(called_program(equation), arrays)


@rule("scan")
def scanned(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Unrolls `lax.scan`: the operations of its body are repeated for each row."""
    scan = scan_of(equation)
    n_carry, length = scan.n_carry, scan.length
    first_row = scan.n_constants + n_carry
    consts = arrays[: scan.n_constants]
    carry = list(arrays[scan.n_constants : first_row])
    along = arrays[first_row:]
    rows: list[Any] = [None] * length
    order = range(length)
    for i in reversed(order) if scan.backwards else order:
        given = [*consts, *carry, *[array[i] for array in along]]
        made = unroller.run(scan.body, given)
        carry, rows[i] = made[:n_carry], made[n_carry:]
    avals = [v.aval for v in equation.outvars[n_carry:]]
    stacked = [
        np.stack([row[k] for row in rows]) if length else np.zeros(aval.shape, np.int64)
        for k, aval in enumerate(avals)
    ]
    return [*carry, *stacked]


@rule("while")
def looped(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Unrolls a `while` loop whose condition is a known number in every iteration.

    Raises:
        NotUnrolled: The condition depends on inputs, or the loop has too many
            iterations.
    """
    loop = while_of(equation)
    first_carry = loop.n_condition + loop.n_body
    for_test, for_body = (
        arrays[: loop.n_condition],
        arrays[loop.n_condition : first_carry],
    )
    carry = list(arrays[first_carry:])
    for _ in range(MOST_ROUNDS):
        (answer,) = unroller.run(loop.condition, [*for_test, *carry])
        known = unroller.graph.value(unroller.number(answer))
        if known is None:
            raise NotUnrolled("lanes have no loop whose length depends on numbers")
        if not known:
            return carry
        carry = unroller.run(loop.body, [*for_body, *carry])
    raise NotUnrolled(f"a loop runs for more than {MOST_ROUNDS} rounds")


@rule("cond")
def branched(unroller: Unroller, equation: Any, index: Any, *arrays: Any) -> Any:
    """Unrolls all branches of `cond`, as under `vmap`, and selects one result.

    If the index is a known number, only that branch is unrolled.
    """
    graph = unroller.graph
    branches = equation.params["branches"]
    known = graph.value(unroller.number(index))
    if known is not None:
        which = min(max(int(known), 0), len(branches) - 1)
        return unroller.run(branches[which], arrays)
    kind = kind_of(equation.invars[0].aval)
    results = unroller.run(branches[0], arrays)
    for i, branch in enumerate(branches[1:], 1):
        if kind == "b1":
            chosen = index
        else:
            chosen = unroller.each("ge", "b1", index, unroller.full(i, (), kind))
        others = unroller.run(branch, arrays)
        results = [
            unroller.each("select", kind_of(v.aval), chosen, new, old)
            for v, new, old in zip(equation.outvars, others, results, strict=True)
        ]
    return results


@rule("sort")
def ordered(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Refuses `sort`, which only rows have.

    Raises:
        NotUnrolled: Always.
    """
    raise NotUnrolled("lanes have no 'sort'")


@rule("platform_index")
def by_platform(unroller: Unroller, equation: Any) -> Any:
    """Returns the index of the default variant of a program with variants by platform.

    A program with a separate variant for CPUs is refused, because only XLA selects
    variants.

    Raises:
        NotUnrolled: There is a variant for CPUs, or no default variant.
    """
    rest = None
    for i, names in enumerate(equation.params["platforms"]):
        if names is None:
            rest = i
        elif "cpu" in names:
            raise NotUnrolled("lanes have no program that differs by platform")
    if rest is None:
        raise NotUnrolled("the program is for other platforms")
    kind = kind_of(equation.outvars[0].aval)
    return unroller.full(rest, (), kind)


@rule("custom_linear_solve")
def solved(unroller: Unroller, equation: Any, *arrays: Any) -> Any:
    """Translates `custom_linear_solve`: the operations of its solver are inlined."""
    lengths = equation.params["const_lengths"]
    begin = lengths.matvec + lengths.vecmat
    consts = arrays[begin : begin + lengths.solve]
    right = arrays[sum(lengths) :]
    return unroller.run(equation.params["jaxprs"].solve, [*consts, *right])
