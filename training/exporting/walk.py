"""Translation of a jaxpr into a `Program`, which has only three kinds of steps.

Values that depend on no input are computed here and become constants. Primitives that
only move numbers, such as `transpose`, add no step: they change the indices at which an
array's numbers are read from their buffer. Elementwise operations and matrix products
become steps. Any other primitive is refused by name.
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
    operand_types,
    program_of,
    scan_of,
    unknown_parameter,
)
from jaxrod.training.exporting.program import (
    OPERATIONS,
    Buffer,
    Each,
    Join,
    Product,
    Program,
    Step,
    Value,
)

MOST_STEPS = 20_000
"""Largest number of steps of a program; loops are unrolled and can exceed it."""


def walked(closed: Any) -> Program:
    """Translates a closed jaxpr into a program.

    Raises:
        ValueError: The jaxpr has a primitive or a type of number that is not exported.
    """
    walk = _Walk()
    inputs = tuple(
        Buffer(int(np.prod(aval.shape)), aval.dtype) for aval in operand_types(closed)
    )
    given = [
        Value(buffer, np.arange(buffer.size).reshape(aval.shape))
        for buffer, aval in zip(inputs, operand_types(closed), strict=True)
    ]
    results = tuple(walk.run(closed, given))
    # A result is copied if it lies in an input buffer, because the caller may write
    # results over inputs, such as the memory of the previous step.
    results = tuple(
        walk.copied(result) if result.buffer in inputs else result for result in results
    )
    needed = {result.buffer for result in results}
    steps: list[Step] = []
    for step in reversed(walk.steps):
        if step.out in needed:
            steps.append(step)
            needed |= {operand.buffer for operand in step.operands}
    program = Program(inputs, tuple(reversed(steps)), results)
    for buffer in (*inputs, *(value.buffer for value in program.operands())):
        _ = buffer.kind
    return program


class _Walk:
    """Translation in progress: the list of steps so far."""

    def __init__(self) -> None:
        self.steps: list[Step] = []

    def run(self, closed: Any, values: Sequence[Value]) -> list[Value]:
        """Adds the steps of a jaxpr for given inputs; returns its results."""
        jaxpr, constants = program_of(closed)
        found: dict[Any, Value] = dict(zip(jaxpr.invars, values, strict=True))
        for variable, constant in zip(jaxpr.constvars, constants, strict=True):
            found[variable] = _constant(constant, variable.aval.dtype)

        def read(atom: Any) -> Value:
            if is_literal(atom):
                return _constant(atom.val, atom.aval.dtype)
            return found[atom]

        for equation in jaxpr.eqns:
            made = self.equation(equation, [read(atom) for atom in equation.invars])
            for variable, value in zip(equation.outvars, made, strict=True):
                assert value.places.shape == variable.aval.shape, equation
                found[variable] = value
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, values: list[Value]) -> list[Value]:
        """Adds the steps of one equation for given operands; returns its results."""
        name = equation.primitive.name
        if name in CALLS:
            return self.run(called_program(equation), values)
        if all(value.known for value in values):
            made = _evaluated(equation, [jnp.asarray(v.numbers) for v in values])
            return [_constant(array, array.dtype) for array in made]
        if len(self.steps) > MOST_STEPS:
            raise _refusal(f"its loops make more than {MOST_STEPS} steps")
        if name not in RULES:
            raise _refusal(
                f"its program has the primitive {name!r}, for which there is no rule"
            )
        if words := unknown_parameter(equation):
            raise _refusal(words)
        results = RULES[name](self, equation, *values)
        return results if isinstance(results, list) else [results]

    def each(self, operation: str, dtype: Any, *values: Value) -> Value:
        """Adds an elementwise operation; operands are broadcast to a common shape."""
        for value in values:
            if value.buffer.kind not in OPERATIONS[operation].kinds:
                raise _refusal(f"it has {operation!r} of {value.buffer.dtype}")
        shape = np.broadcast_shapes(*(value.places.shape for value in values))
        operands = tuple(
            Value(value.buffer, np.broadcast_to(value.places, shape))
            for value in values
        )
        return self._made(Each, shape, dtype, operands, operation)

    def together(self, values: Sequence[Value]) -> list[Value]:
        """Returns values that share one buffer, after copying them if necessary."""
        if len({value.buffer for value in values}) == 1:
            return list(values)
        sizes = [value.places.size for value in values]
        joined = self._made(Join, (sum(sizes),), values[0].buffer.dtype, tuple(values))
        parts = np.split(joined.places, np.cumsum(sizes)[:-1])
        return [
            Value(joined.buffer, part.reshape(value.places.shape))
            for part, value in zip(parts, values, strict=True)
        ]

    def copied(self, value: Value) -> Value:
        """Copies a value to a new buffer, which it fills in order."""
        if value.known:
            return _constant(value.numbers, value.buffer.dtype)
        return self._made(Join, value.places.shape, value.buffer.dtype, (value,))

    def product(self, left: Value, right: Value) -> Value:
        """Adds a matrix product, (batch, m, k) times (batch, k, n)."""
        batch, m, k = left.places.shape
        n = right.places.shape[2]
        if n == 1 and m > 1:  # Rows of the result are computed side by side.
            turned = [
                Value(v.buffer, v.places.transpose(0, 2, 1)) for v in (right, left)
            ]
            made = self.product(*turned)
            return Value(made.buffer, made.places.transpose(0, 2, 1))
        if left.buffer.kind != "f":
            raise _refusal(f"it has a product of {left.buffer.dtype}")
        whole = tuple(v if v.whole else self.copied(v) for v in (left, right))
        shape, sizes = (batch, m, n), (batch, m, k, n)
        return self._made(Product, shape, np.float32, whole, sizes)

    def _made(
        self,
        kind: Callable[..., Step],
        shape: tuple[int, ...],
        dtype: Any,
        operands: tuple[Value, ...],
        *more: Any,
    ) -> Value:
        out = Buffer(int(np.prod(shape)), np.dtype(dtype))
        self.steps.append(kind(out, operands, *more))
        return Value(out, np.arange(out.size).reshape(shape))


def _constant(numbers: Any, dtype: Any) -> Value:
    if jnp.issubdtype(dtype, jax.dtypes.extended):
        raise _refusal(f"it holds {dtype}")
    array = np.asarray(numbers, dtype)
    buffer = Buffer(array.size, array.dtype, array.ravel())
    return Value(buffer, np.arange(array.size).reshape(array.shape))


def _evaluated(equation: Any, operands: list[Any], **params: Any) -> list[Any]:
    made = equation.primitive.bind(*operands, **{**equation.params, **params})
    return made if equation.primitive.multiple_results else [made]


def _refusal(reason: str) -> ValueError:
    return ValueError(f"the policy cannot be exported: {reason}")


Rule = Callable[..., Value | list[Value]]
RULES: dict[str, Rule] = {}
"""Rules by name of the primitive that they translate. A rule takes `(walk, equation,
*values)` and returns the results."""


def _rule(*names: str) -> Callable[[Rule], Rule]:
    def add(rule: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, rule))
        return rule

    return add


@_rule(*OPERATIONS)
def _same(walk: _Walk, equation: Any, *values: Value) -> Value:
    """Translates a primitive that has an entry of the same name in `OPERATIONS`."""
    return walk.each(equation.primitive.name, equation.outvars[0].aval.dtype, *values)


@_rule("copy", "stop_gradient")
def _unchanged(walk: _Walk, equation: Any, value: Value) -> Value:
    return value


@_rule("square")
def _squared(walk: _Walk, equation: Any, value: Value) -> Value:
    return walk.each("mul", value.buffer.dtype, value, value)


@_rule("integer_pow")
def _powered(walk: _Walk, equation: Any, value: Value) -> Value:
    """Translates `integer_pow` into products, by repeated squaring."""
    dtype, exponent = value.buffer.dtype, equation.params["y"]
    result, square = _constant(1, dtype), value
    for digit in reversed(f"{abs(exponent):b}"):
        if digit == "1":
            result = square if result.known else walk.each("mul", dtype, result, square)
        square = walk.each("mul", dtype, square, square)
    one = _constant(1, dtype)
    return result if exponent > 0 else walk.each("div", dtype, one, result)


@_rule("rsqrt")
def _reciprocal_root(walk: _Walk, equation: Any, value: Value) -> Value:
    dtype = value.buffer.dtype
    return walk.each("div", dtype, _constant(1, dtype), walk.each("sqrt", dtype, value))


@_rule("logistic")
def _logistic(walk: _Walk, equation: Any, value: Value) -> Value:
    """Translates `logistic` as 1 / (1 + exp(-x))."""
    dtype, one = value.buffer.dtype, _constant(1, value.buffer.dtype)
    decay = walk.each("exp", dtype, walk.each("neg", dtype, value))
    return walk.each("div", dtype, one, walk.each("add", dtype, one, decay))


@_rule("sign")
def _sign(walk: _Walk, equation: Any, value: Value) -> Value:
    """Translates `sign`: -1 or 1; zeros and NaN are unchanged."""
    dtype, zero = value.buffer.dtype, _constant(0, value.buffer.dtype)
    above, below = (walk.each(name, np.bool_, value, zero) for name in ("gt", "lt"))
    rest = walk.each("select", dtype, below, _constant(-1, dtype), value)
    return walk.each("select", dtype, above, _constant(1, dtype), rest)


@_rule("clamp")
def _clamped(
    walk: _Walk, equation: Any, low: Value, value: Value, high: Value
) -> Value:
    dtype = value.buffer.dtype
    return walk.each("min", dtype, walk.each("max", dtype, low, value), high)


@_rule("select_n")
def _selected(walk: _Walk, equation: Any, which: Value, *cases: Value) -> Value:
    if len(cases) != 2 or which.buffer.kind != "b":
        raise _refusal(f"it selects from {len(cases)} cases by {which.buffer.dtype}")
    return walk.each("select", cases[0].buffer.dtype, which, cases[1], cases[0])


@_rule("convert_element_type")
def _converted(walk: _Walk, equation: Any, value: Value) -> Value:
    dtype = np.dtype(equation.params["new_dtype"])
    if dtype == value.buffer.dtype:
        return value
    names = {"f": "to float", "i": "to integer", "b": "to boolean"}
    return walk.each(names[Buffer(0, dtype).kind], dtype, value)


_DATA = {
    **dict.fromkeys(
        ("broadcast_in_dim", "expand_dims", "reshape", "rev", "slice"), (0,)
    ),
    **dict.fromkeys(("split", "squeeze", "tile", "transpose", "unstack"), (0,)),
    **dict.fromkeys(("gather", "dynamic_slice"), (0,)),
    **dict.fromkeys(("pad", "dynamic_update_slice"), (0, 1)),
    "scatter": (0, 2),
    **dict.fromkeys(("concatenate", "stack"), None),
}
"""Primitives that only move numbers, with the positions of the operands that hold these
numbers; `None` for all operands. The other operands are indices."""


@_rule(*_DATA)
def _moved(walk: _Walk, equation: Any, *values: Value) -> list[Value]:
    """Applies a primitive that only moves numbers to the indices into the buffer.

    The result holds the same numbers at the moved indices, so no step is added.
    """
    name = equation.primitive.name
    data = _DATA[name] or range(len(values))
    if not all(value.known for i, value in enumerate(values) if i not in data):
        raise _refusal(f"its {name!r} has indices that depend on the observation")
    joined = walk.together([values[i] for i in data])
    operands = [
        jnp.asarray(joined[list(data).index(i)].places, jnp.int32)
        if i in data
        else jnp.asarray(value.numbers)
        for i, value in enumerate(values)
    ]
    outside = {"fill_value": np.int32(-1)} if name == "gather" else {}
    made = [np.asarray(one) for one in _evaluated(equation, operands, **outside)]
    if any((places < 0).any() for places in made):
        raise _refusal(f"its {name!r} reads outside of an array")
    return [Value(joined[0].buffer, places) for places in made]


_REDUCTIONS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
}


@_rule(*_REDUCTIONS)
def _reduced(walk: _Walk, equation: Any, value: Value) -> Value:
    """Translates a reduction into pairwise operations: halves are combined repeatedly.

    The round-off of a sum then grows with the logarithm of the length.
    """
    axes, operation = equation.params["axes"], _REDUCTIONS[equation.primitive.name]
    kept = [axis for axis in range(value.places.ndim) if axis not in axes]
    rows = np.transpose(value.places, (*axes, *kept))
    rows = rows.reshape(-1, *(value.places.shape[axis] for axis in kept))
    buffer = value.buffer
    while len(rows) > 1:
        half, rest = len(rows) // 2, len(rows) % 2
        pair = Value(buffer, rows[:half]), Value(buffer, rows[half : 2 * half])
        halved = walk.each(operation, buffer.dtype, *pair)
        if rest:
            last = Value(buffer, rows[-1:])
            parts = walk.together([halved, last])
            buffer = parts[0].buffer
            rows = np.concatenate([part.places for part in parts])
        else:
            buffer, rows = halved.buffer, halved.places
    if not len(rows):
        raise _refusal(f"it has {equation.primitive.name!r} of an empty array")
    return Value(buffer, rows[0])


@_rule("dot_general")
def _contracted(walk: _Walk, equation: Any, left: Value, right: Value) -> Value:
    """Translates `dot_general` into a batched matrix product."""
    summed, batches = equation.params["dimension_numbers"]

    def arranged(value: Value, side: int) -> tuple[np.ndarray, tuple[int, ...]]:
        batch, inner = batches[side], summed[side]
        free = [i for i in range(value.places.ndim) if i not in (*batch, *inner)]
        shape = [value.places.shape[i] for i in (*batch, *free, *inner)]
        places = np.transpose(value.places, (*batch, *free, *inner))
        sizes = [int(np.prod(shape[: len(batch)])), -1]
        sizes += [int(np.prod([value.places.shape[i] for i in inner]))]
        return places.reshape(sizes), tuple(shape[: len(batch) + len(free)])

    (a, rows), (b, columns) = arranged(left, 0), arranged(right, 1)
    turned = Value(right.buffer, b.transpose(0, 2, 1))
    made = walk.product(Value(left.buffer, a), turned)
    shape = (*rows, *columns[len(batches[0]) :])
    return Value(made.buffer, made.places.reshape(shape))


@_rule("conv_general_dilated")
def _convolved(walk: _Walk, equation: Any, left: Value, right: Value) -> Value:
    """Translates a convolution into a matrix product of all windows and the kernel."""
    given, groups = equation.params, equation.params["feature_group_count"]
    if given["batch_group_count"] != 1 or any(n != 1 for n in given["lhs_dilation"]):
        raise _refusal("it has a transposed convolution")
    if any(n < 0 for pair in given["padding"] for n in pair):
        raise _refusal("it has a convolution with negative padding")
    order = given["dimension_numbers"]
    inputs, zero = walk.together([left, _constant(0, left.buffer.dtype)])
    windows = np.pad(
        np.transpose(inputs.places, order.lhs_spec),
        ((0, 0), (0, 0), *given["padding"]),
        constant_values=int(zero.places),
    )
    kernel = np.transpose(right.places, order.rhs_spec)
    outputs, channels, *taps = kernel.shape
    positions = []
    # Every spatial axis becomes two: window positions, and kernel taps within a window.
    for axis, (tap, stride, apart) in enumerate(
        zip(taps, given["window_strides"], given["rhs_dilation"], strict=True)
    ):
        at = 2 + 2 * axis
        count = (windows.shape[at] - apart * (tap - 1) - 1) // stride + 1
        places = stride * np.arange(count)[:, None] + apart * np.arange(tap)
        windows = np.take(windows, places, axis=at)
        positions.append(count)
    batch = len(windows)
    windows = windows.reshape(batch, groups, channels, *windows.shape[2:])
    space = range(len(taps))
    windows = windows.transpose(
        1, 0, *(3 + 2 * i for i in space), 2, *(4 + 2 * i for i in space)
    )
    rows = windows.reshape(groups, batch * int(np.prod(positions)), -1)
    columns = kernel.reshape(groups, outputs // groups, -1).transpose(0, 2, 1)
    made = walk.product(Value(inputs.buffer, rows), Value(right.buffer, columns))
    places = made.places.reshape(groups, batch, *positions, outputs // groups)
    places = np.moveaxis(np.moveaxis(places, 0, 1), -1, 2)
    places = places.reshape(batch, outputs, *positions)
    return Value(made.buffer, places.transpose(np.argsort(order.out_spec)))


@_rule("scan")
def _scanned(walk: _Walk, equation: Any, *values: Value) -> list[Value]:
    """Translates a `scan` by unrolling its loop."""
    scan = scan_of(equation)
    first = scan.n_constants + scan.n_carry
    constants, carry = (
        values[: scan.n_constants],
        list(values[scan.n_constants : first]),
    )
    rows: list[Any] = [None] * scan.length
    order = range(scan.length)
    for i in reversed(order) if scan.backwards else order:
        along = [Value(value.buffer, value.places[i]) for value in values[first:]]
        made = walk.run(scan.body, [*constants, *carry, *along])
        carry, rows[i] = made[: scan.n_carry], made[scan.n_carry :]
    stacked = []
    for column in zip(*rows, strict=True):
        parts = walk.together(column)
        places = np.stack([part.places for part in parts])
        stacked.append(Value(parts[0].buffer, places))
    return [*carry, *stacked]
