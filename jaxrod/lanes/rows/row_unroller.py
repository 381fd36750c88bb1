"""Translation of a jaxpr to a graph of rows.

Rules of arithmetic, calls and branches are those of `jaxrod.lanes.jaxpr`. The rules
here are for primitives that move numbers, or combine the numbers of one array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxrod.jax_internals.equations import (
    n_equations,
    program_of,
    programs_within,
    scan_of,
    while_of,
)
from jaxrod.lanes.jaxpr.arithmetic import as_kind
from jaxrod.lanes.jaxpr.reductions import CUMULATIVE, REDUCTIONS
from jaxrod.lanes.jaxpr.unroll import (
    RULES,
    NotUnrolled,
    Rule,
    Unroller,
    branched,
    kind_dtype,
    kind_of,
    looped,
    rule,
)
from jaxrod.lanes.rows.arrays import Layout, Rows, long_axes
from jaxrod.lanes.rows.recurrences import recurrence
from jaxrod.lanes.rows.row_graph import Move, RowGraph, identity

SHARED = (
    *(
        "add_any",
        "square",
        "one_minus_square",
        "integer_pow",
        "sign",
        "logistic",
        "round",
        "is_finite",
    ),
    *("clamp", "select_n", "convert_element_type", "copy", "stop_gradient"),
    *("optimization_barrier", "pvary", "reshard", "platform_index"),
    *("custom_linear_solve", "closed_call", "custom_jvp_call", "custom_vjp_call"),
    *("jit", "remat2"),
)
"""Primitives whose rules are those of `jaxrod.lanes.jaxpr`, because the rules do not
depend on the layout of arrays. All other rules of elementwise primitives are shared
too."""
MOST_UNROLLED = 64
"""Largest number of iterations for which a `scan` is unrolled."""
MOST_EQUATIONS = 600
"""Largest number of equations of all iterations for which a `scan` is unrolled, if it
can be a loop."""


@dataclass(frozen=True, eq=False)
class Nested:
    """A loop within a step that is not unrolled, as closed jaxprs.

    Its operands are the constants of the condition, those of the body, the carry, and
    arrays whose leading axis is scanned. Its results are the last carry and the arrays
    of results of all rounds.
    """

    body: Any
    """Program of a round: from constants, carry and entries of the scanned arrays to
    the next carry and results."""
    n_constants: int
    """Number of constants of the body."""
    n_carry: int
    length: int | None = None
    """Number of rounds; `None` if it depends on the condition."""
    backwards: bool = False
    """Whether the rounds begin with the last entries of the scanned arrays."""
    condition: Any = None
    """Program from its constants and the carry to whether another round follows."""
    n_condition: int = 0
    """Number of constants of the condition."""


class RowUnroller(Unroller):
    """Translates jaxprs to nodes of one graph; each node is a number or a row."""

    graph: RowGraph

    def __init__(self, graph: RowGraph) -> None:
        """Creates a translator with the rules for rows.

        Args:
            graph: Graph to which nodes are added.
        """
        super().__init__(graph)
        self.rules = ROW_RULES
        self.layout = Layout(graph)
        self.nest: Callable[[Nested, Sequence[Rows]], list[Rows]] | None = None
        """Function that returns the results of a loop as a function of its own; `None`
        if such loops are not possible here."""
        self.addends: Callable[[int], list[int]] = lambda node: [node]
        """Function that returns the nodes whose sums are computed one by one instead of
        the sum of a node."""

    def as_array(self, result: Any) -> Any:
        """Returns the result of a rule unchanged, because it is a `Rows` already."""
        return result

    def number(self, array: Any) -> int:
        """Returns the only node of an array of one number."""
        return array.scalar

    def each(self, operation: str, kind: str, *arrays: Any) -> Any:
        """Returns an operation applied to arrays entry by entry, after broadcasting.

        `kind` is the type of the results, such as `"f32"`.
        """
        return self.layout.each(operation, kind, *arrays)

    def mapped(self, function: Callable[..., int], kind: str, *arrays: Any) -> Any:
        """Returns the nodes that a function returns for the nodes of arrays.

        The arrays are broadcast; `kind` is the type of the results, such as `"f32"`.
        """
        return self.layout.mapped(function, kind, *arrays)

    def full(self, value: Any, shape: tuple[int, ...], kind: str) -> Any:
        """Returns an array in which one known number is repeated."""
        return self.layout.full(self.graph.constant(value, kind), shape, kind)

    def known(self, value: Any, aval: Any) -> Any:
        """Returns an array of known numbers, broadcast to shape and dtype of `aval`."""
        numbers = np.broadcast_to(np.asarray(value, kind_dtype(aval)), aval.shape)
        return self.layout.known(numbers, kind_of(aval))

    def input(self, which: int, aval: Any, rate: int) -> Rows:
        """Returns operand number `which` of the program as an array of rows.

        `rate` is its rate of change: `UNIFORM`, `FIXED` or `VARYING`.
        """
        kind, shape = kind_of(aval), tuple(map(int, aval.shape))
        size = int(np.prod(shape, dtype=int))
        node = self.graph.array(which, size, kind, rate)
        return self.layout.from_memory(node, shape, kind)


ROW_RULES: dict[str, Rule] = {}
"""Rules by name of the primitive. A rule takes an unroller, an equation and its
operands, and returns the results as arrays of rows."""


def row_rule(*names: str) -> Callable[[Rule], Rule]:
    """Registers a function that translates primitives to rows (a decorator)."""
    return rule(*names, rules=ROW_RULES)


def result_shape(equation: Any) -> tuple[int, ...]:
    """Returns the shape of the result of an equation."""
    return tuple(map(int, equation.outvars[0].aval.shape))


def straight(array: Rows) -> list[Move]:
    """Returns the moves that read each axis of an array in order, from its start."""
    return [Move(axis) for axis in range(len(array.shape))]


@row_rule("slice")
def sliced(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates `slice`: every n-th entry between two limits along each axis."""
    starts = equation.params["start_indices"]
    strides = equation.params["strides"] or (1,) * len(starts)
    moves = [Move(axis, step) for axis, step in enumerate(strides)]
    shape = result_shape(equation)
    return unroller.layout.taken(array, shape, starts, moves)


@row_rule("squeeze", "expand_dims", "reshape")
def reshaped(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a change of shape that keeps the order of the numbers."""
    if equation.params.get("new_sizes") and equation.params["dimensions"] is not None:
        raise NotUnrolled("rows have no reshape that permutes axes")
    shape = result_shape(equation)
    return unroller.layout.reshaped(array, shape)


@row_rule("broadcast_in_dim")
def broadcast(unroller: RowUnroller, equation: Any, array: Rows, *_: Any) -> Rows:
    """Translates `broadcast_in_dim`: repeats numbers along new or length-1 axes."""
    shape = result_shape(equation)
    moves = [Move(None)] * len(shape)
    for axis, to in enumerate(equation.params["broadcast_dimensions"]):
        if array.shape[axis] == shape[to]:
            moves[to] = Move(axis)
    return unroller.layout.taken(array, shape, [0] * len(array.shape), moves)


@row_rule("transpose")
def transposed(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates `transpose`: the axes are permuted."""
    moves = [Move(axis) for axis in equation.params["permutation"]]
    shape = result_shape(equation)
    return unroller.layout.taken(array, shape, [0] * len(shape), moves)


@row_rule("rev")
def reversed_along(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates `rev`: the order of entries is reversed along axes."""
    moves, start = straight(array), [0] * len(array.shape)
    for axis in equation.params["dimensions"]:
        moves[axis], start[axis] = Move(axis, -1), array.shape[axis] - 1
    return unroller.layout.taken(array, array.shape, start, moves)


@row_rule("concatenate")
def concatenated(unroller: RowUnroller, equation: Any, *arrays: Rows) -> Rows:
    """Translates `concatenate`: arrays are joined along an axis."""
    return unroller.layout.concatenated(arrays, equation.params["dimension"])


@row_rule("stack")
def stacked(unroller: RowUnroller, equation: Any, *arrays: Rows) -> Rows:
    """Translates `stack`: arrays are joined along a new axis."""
    return _stacked(unroller, arrays, equation.params["axis"])


def _stacked(unroller: RowUnroller, arrays: Sequence[Rows], axis: int) -> Rows:
    shape = list(arrays[0].shape)
    shape.insert(axis, 1)
    made = [unroller.layout.reshaped(array, tuple(shape)) for array in arrays]
    return unroller.layout.concatenated(made, axis)


@row_rule("unstack")
def unstacked(unroller: RowUnroller, equation: Any, array: Rows) -> list[Rows]:
    """Translates `unstack`: returns the slices along an axis, without that axis."""
    axis = equation.params["axis"]
    return [slice_at(unroller, array, axis, i) for i in range(array.shape[axis])]


def slice_at(unroller: RowUnroller, array: Rows, axis: int, index: int) -> Rows:
    """Returns the slice of an array at an index of an axis, without that axis."""
    moves = [Move(a) for a in range(len(array.shape)) if a != axis]
    start = [index if a == axis else 0 for a in range(len(array.shape))]
    shape = tuple(n for a, n in enumerate(array.shape) if a != axis)
    return unroller.layout.taken(array, shape, start, moves)


@row_rule("split")
def parted(unroller: RowUnroller, equation: Any, array: Rows) -> list[Rows]:
    """Translates `split`: returns parts of the given sizes along an axis."""
    axis, begin, made = equation.params["axis"], 0, []
    for size in equation.params["sizes"]:
        made.append(unroller.layout.sliced(array, axis, begin, begin + size))
        begin += size
    return made


@row_rule("pad")
def padded(unroller: RowUnroller, equation: Any, array: Rows, value: Rows) -> Rows:
    """Translates padding at the edges and between entries.

    Negative padding removes entries at the edges.
    """
    for axis, (low, high, inner) in enumerate(equation.params["padding_config"]):
        array = unroller.layout.padded(array, axis, low, high, inner, value.scalar)
    return array


@row_rule("iota")
def counted(unroller: RowUnroller, equation: Any, *_: Any) -> Rows:
    """Translates `iota`: the integers 0, 1, 2, ... along an axis."""
    shape, axis = result_shape(equation), equation.params["dimension"]
    return row_of_places(unroller, shape, axis, kind_of(equation.outvars[0].aval))


def row_of_places(
    unroller: RowUnroller, shape: tuple[int, ...], axis: int, kind: str
) -> Rows:
    """Returns an array of integers that are their own index along an axis.

    `kind` is the type of the numbers, such as `"f32"`.
    """
    graph, loops = unroller.graph, long_axes(shape)
    dims = tuple(shape[a] for a in loops)
    nodes = np.empty([1 if a in loops else n for a, n in enumerate(shape)], np.int64)
    for index in np.ndindex(*nodes.shape):
        if axis in loops:
            nodes[index] = graph.iota(dims, loops.index(axis), kind)
        else:
            nodes[index] = graph.constant(index[axis], kind)
    return Rows(shape, loops, nodes, kind)


@row_rule(*REDUCTIONS)
def reduced(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a reduction such as `reduce_sum` along axes."""
    operation = REDUCTIONS[equation.primitive.name]
    axes = tuple(equation.params["axes"])
    return _reduced(unroller, array, operation, axes)


def _reduced(
    unroller: RowUnroller, array: Rows, operation: str, axes: Sequence[int]
) -> Rows:
    graph, kind = unroller.graph, array.kind
    if 0 in array.shape:
        left = tuple(n for a, n in enumerate(array.shape) if a not in axes)
        if 0 in left:
            raise NotUnrolled("rows have no reduction to nothing")
        return unroller.full(identity(operation, kind), left, kind)
    along = tuple(i for i, axis in enumerate(array.loops) if axis in axes)
    count = int(np.prod([array.dims[i] for i in along], dtype=int))

    def of(node: int) -> int:
        if not along:
            return node
        if graph.dims[node]:
            parts = unroller.addends(node) if operation == "add" else [node]
            total, *rest = (graph.reduced(part, operation, along) for part in parts)
            for part in rest:
                total = graph.add("add", (total, part), kind)
            return total
        if operation == "add":
            return graph.add("mul", (node, graph.constant(count, kind)), kind)
        if operation in ("mul", "xor"):
            raise NotUnrolled(f"rows have no '{operation}' of one number, repeated")
        return node

    nodes = graph.mapped(of, array.nodes) if along else array.nodes
    kept = [axis for axis in range(len(array.shape)) if axis not in axes]
    lines = np.transpose(nodes, (*axes, *kept))
    lines = lines.reshape(-1, *[nodes.shape[axis] for axis in kept])
    while len(lines) > 1:
        half = len(lines) // 2
        joined = graph.each(operation, kind, lines[:half], lines[half : 2 * half])
        lines = np.concatenate([joined, lines[2 * half :]])
    loops = tuple(kept.index(axis) for axis in array.loops if axis in kept)
    shape = tuple(array.shape[axis] for axis in kept)
    return Rows(shape, loops, lines[0], kind)


@row_rule(*CUMULATIVE)
def accumulated(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates a cumulative operation such as `cumsum` by log2(n) shifts.

    The array is combined with itself shifted by 1, 2, 4, ... entries.
    """
    operation = CUMULATIVE[equation.primitive.name]
    axis, kind = equation.params["axis"], array.kind
    none = unroller.graph.constant(identity(operation, kind), kind)
    n, shift = array.shape[axis], 1
    while shift < n:
        low, high = (-shift, shift) if equation.params["reverse"] else (shift, -shift)
        moved = unroller.layout.padded(array, axis, low, high, 0, none)
        array = unroller.each(operation, kind, array, moved)
        shift *= 2
    return array


@row_rule("argmax", "argmin")
def place_of_extreme(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates `argmax` or `argmin`: index of the first largest or smallest entry.

    The first NaN counts as largest and smallest, as in JAX.
    """
    kind = kind_of(equation.outvars[0].aval)
    (axis,) = equation.params["axes"]
    operation = "max" if equation.primitive.name == "argmax" else "min"
    best = _reduced(unroller, array, operation, (axis,))
    shape = tuple(1 if a == axis else n for a, n in enumerate(array.shape))
    best = unroller.layout.reshaped(best, shape)
    match = unroller.each("eq", "b1", array, best)
    if array.kind[0] == "f":
        odd = unroller.each("ne", "b1", array, array)
        match = unroller.each("or", "b1", match, odd)
    index = row_of_places(unroller, array.shape, axis, kind)
    beyond = unroller.full(array.shape[axis], (), kind)
    index = unroller.each("select", kind, match, index, beyond)
    return _reduced(unroller, index, "min", (axis,))


@row_rule("tile")
def tiled(unroller: RowUnroller, equation: Any, array: Rows) -> Rows:
    """Translates `tile`: an array is repeated along each axis."""
    for axis, count in enumerate(equation.params["reps"]):
        if count != 1:
            array = unroller.layout.concatenated([array] * count, axis)
    return array


@row_rule("dot_general")
def product(unroller: RowUnroller, equation: Any, left: Rows, right: Rows) -> Rows:
    """Translates `dot_general`: sums of products, such as matrix products."""
    kind = kind_of(equation.outvars[0].aval)
    summed, batch = equation.params["dimension_numbers"]
    layout = unroller.layout
    left = as_kind(unroller, left, left.kind, kind)
    right = as_kind(unroller, right, right.kind, kind)
    free = [
        [a for a in range(len(array.shape)) if a not in (*b, *s)]
        for array, s, b in zip((left, right), summed, batch, strict=True)
    ]
    n_batch, n_left, n_right = len(batch[0]), len(free[0]), len(free[1])
    shape = (
        *(left.shape[a] for a in batch[0]),
        *(left.shape[a] for a in free[0]),
        *(right.shape[a] for a in free[1]),
        *(left.shape[a] for a in summed[0]),
    )
    first_sum = n_batch + n_left + n_right
    moves_left = [Move(a) for a in (*batch[0], *free[0])]
    moves_left += [Move(None)] * n_right + [Move(a) for a in summed[0]]
    moves_right = [Move(a) for a in batch[1]] + [Move(None)] * n_left
    moves_right += [Move(a) for a in (*free[1], *summed[1])]
    a = layout.taken(left, shape, [0] * len(left.shape), moves_left)
    b = layout.taken(right, shape, [0] * len(right.shape), moves_right)
    terms = unroller.each("mul", kind, a, b)
    return _reduced(unroller, terms, "add", range(first_sum, len(shape)))


@row_rule("scan")
def scanned(unroller: RowUnroller, equation: Any, *arrays: Rows) -> list[Rows]:
    """Translates `scan` to one loop along rows if possible; otherwise unrolls it.

    Raises:
        NotUnrolled: The scan has no iterations, or too many to unroll.
    """
    scan = scan_of(equation)
    along_rows = recurrence(unroller, scan, arrays)
    if along_rows is not None:
        return along_rows
    if unroller.nest is not None and scan.length > 1:
        work = scan.length * n_equations(scan.body)
        if scan.length > MOST_UNROLLED or work > MOST_EQUATIONS:
            program = Nested(
                scan.body, scan.n_constants, scan.n_carry, scan.length, scan.backwards
            )
            return unroller.nest(program, arrays)
    if scan.length > MOST_UNROLLED or not scan.length:
        raise NotUnrolled(f"rows have no loop of {scan.length} rounds")
    n_carry, first_row = scan.n_carry, scan.n_constants + scan.n_carry
    consts, along = arrays[: scan.n_constants], arrays[first_row:]
    carry = list(arrays[scan.n_constants : first_row])
    rows: list[Any] = [None] * scan.length
    order = range(scan.length)
    for i in reversed(order) if scan.backwards else order:
        each = [slice_at(unroller, array, 0, i) for array in along]
        made = unroller.run(scan.body, [*consts, *carry, *each])
        carry, rows[i] = made[:n_carry], made[n_carry:]
    made = [_stacked(unroller, column, 0) for column in zip(*rows, strict=True)]
    return [*carry, *made]


@row_rule("while")
def repeated(unroller: RowUnroller, equation: Any, *arrays: Rows) -> list[Rows]:
    """Translates a `while` loop, whose length depends on numbers.

    It is unrolled if the condition is a known number in every round.
    """
    loop = while_of(equation)
    n_constants = loop.n_condition + loop.n_body
    carry = arrays[n_constants:]
    if unroller.nest is not None:
        given = [*arrays[: loop.n_condition], *carry]
        (goes_on,) = unroller.run(loop.condition, given)
        if unroller.graph.value(goes_on.scalar) is None:
            program = Nested(
                loop.body,
                loop.n_body,
                len(carry),
                condition=loop.condition,
                n_condition=loop.n_condition,
            )
            return unroller.nest(program, arrays)
    return looped(unroller, equation, *arrays)


@row_rule("cond")
def one_of(
    unroller: RowUnroller, equation: Any, index: Rows, *arrays: Rows
) -> list[Rows]:
    """Translates `cond`: all branches are computed, and one result is selected.

    Raises:
        NotUnrolled: A branch has a loop that might never end where it is not chosen.
    """
    unknown = unroller.graph.value(index.scalar) is None
    if unknown and any(map(_has_while, equation.params["branches"])):
        raise NotUnrolled("rows have no branch with a loop of unknown length")
    made: list[Rows] = branched(unroller, equation, index, *arrays)
    return made


def _has_while(program: Any) -> bool:
    """Whether a program has a `while` loop."""
    return any(
        equation.primitive.name == "while"
        or any(map(_has_while, programs_within(equation)))
        for equation in program_of(program).jaxpr.eqns
    )


for _name in SHARED:
    ROW_RULES[_name] = RULES[_name]
for _name, _rule in RULES.items():
    if _rule.__module__.endswith("arithmetic"):
        ROW_RULES.setdefault(_name, _rule)
