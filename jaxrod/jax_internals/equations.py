"""Parameters of the equations of jaxprs: the known names, and functions to read them.

A parameter that is not listed here may change the meaning of an equation. A program
with such a parameter is left to XLA.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.jax_internals.mesh_axes import varying_shape

_PARAMETERS: dict[str, str] = {
    # Primitives that only move numbers.
    "broadcast_in_dim": "broadcast_dimensions shape",
    "concatenate": "dimension",
    "expand_dims": "dimensions",
    "iota": "dimension dtype shape",
    "pad": "padding_config",
    "reshape": "dimensions new_sizes",
    "rev": "dimensions",
    "slice": "limit_indices start_indices strides",
    "split": "axis sizes",
    "squeeze": "dimensions",
    "stack": "axis",
    "tile": "reps",
    "transpose": "permutation",
    "unstack": "axis",
    # Indexing.
    "dynamic_slice": "slice_sizes",
    "sort": "dimension is_stable num_keys",
    "jaxrod_true_entries": "listing",
    "gather": "dimension_numbers fill_value indices_are_sorted mode slice_sizes "
    "unique_indices",
    **dict.fromkeys(
        ("scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max"),
        "dimension_numbers indices_are_sorted mode unique_indices update_consts "
        "update_jaxpr",
    ),
    # Reductions.
    **dict.fromkeys(("argmax", "argmin"), "axes index_dtype"),
    **dict.fromkeys(("cumsum", "cumprod", "cummax", "cummin"), "axis reverse"),
    "conv_general_dilated": "batch_group_count dimension_numbers feature_group_count "
    "lhs_dilation padding precision preferred_element_type rhs_dilation window_strides",
    "dot_general": "dimension_numbers precision preferred_element_type",
    **dict.fromkeys(
        (f"reduce_{name}" for name in ("sum", "prod", "max", "min", "and", "or")),
        "axes",
    ),
    "reduce_xor": "axes",
    # Elementwise operations.
    "convert_element_type": "new_dtype weak_type",
    "integer_pow": "y",
    "round": "rounding_method",
    # Programs within programs.
    "closed_call": "call_jaxpr",
    "cond": "branches branches_platforms",
    "custom_jvp_call": "call_jaxpr jvp_jaxpr_fun num_consts symbolic_zeros",
    "custom_linear_solve": "const_lengths jaxprs",
    "custom_vjp_call": "bwd call_jaxpr fwd_jaxpr_thunk num_consts out_trees "
    "symbolic_zeros",
    "jit": "compiler_options_kvs ctx_mesh donated_invars in_layouts in_shardings "
    "inline jaxpr keep_unused name out_layouts out_shardings",
    "platform_index": "platforms",
    "pvary": "axes axis_index_groups",
    "remat2": "differentiated jaxpr policy prevent_cse",
    "reshard": "concrete_mesh",
    "scan": "ft_in ft_out jaxpr length num_carry num_consts reverse unroll",
    "while": "body_jaxpr body_nconsts cond_jaxpr cond_nconsts",
}
"""Names of the parameters that are understood, separated by spaces, by name of the
primitive. A primitive that is not listed has no parameters."""
_NONE_ONLY = frozenset({"accuracy", "out_dtype"})
"""Parameters that any primitive may have, provided that their value is `None`."""
_SHARDINGS = frozenset({"dst_sharding", "out_sharding", "sharding"})
"""Parameters that any primitive may have, provided that their sharding splits no axis
over devices. Within `jax.shard_map` such a sharding names a mesh and is not `None`."""
_CALLS = {
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "jit": "jaxpr",
    "remat2": "jaxpr",
}
CALLS = tuple(_CALLS)
"""Names of the primitives that only call an inner program."""


def unknown_parameter(equation: Any) -> str | None:
    """Returns the reason why a parameter of an equation is not understood, or `None`.

    Args:
        equation: An equation of a jaxpr.
    """
    name = equation.primitive.name
    known = _PARAMETERS.get(name, "").split()
    for parameter, value in equation.params.items():
        if parameter in known:
            continue
        if parameter in _SHARDINGS:
            if not _divides_nothing(value):
                return f"'{name}' with {parameter}={value} is not known"
            continue
        if parameter not in _NONE_ONLY:
            return f"the parameter '{parameter}' of '{name}' is not known"
        if value is not None:
            return f"'{name}' with {parameter}={value} is not known"
    return None


def _divides_nothing(sharding: Any) -> bool:
    """Whether a sharding splits no axis, so that every device holds the whole array."""
    if sharding is None:
        return True
    spec = getattr(sharding, "spec", None)
    if spec is None or getattr(spec, "unreduced", None):
        return False
    return all(axes in (None, ()) for axes in spec)


class Parts(NamedTuple):
    """A jaxpr and the values of its constants."""

    jaxpr: Any
    constants: tuple[Any, ...]


def program_of(jaxpr: Any) -> Parts:
    """Returns the jaxpr and the constants of a closed jaxpr.

    An open jaxpr is accepted too; it has no constants.
    """
    return Parts(getattr(jaxpr, "jaxpr", jaxpr), tuple(getattr(jaxpr, "consts", ())))


def operand_types(closed: Any) -> list[Any]:
    """Returns the types (shape and dtype) of the operands of a closed jaxpr."""
    return [variable.aval for variable in program_of(closed).jaxpr.invars]


def result_types(closed: Any) -> list[Any]:
    """Returns the types (shape and dtype) of the results of a closed jaxpr."""
    return [atom.aval for atom in program_of(closed).jaxpr.outvars]


def as_carry(closed: Any, first: int) -> Any:
    """Returns a program whose operands from `first` on are a carry with its results.

    It takes the operands and old results, which it ignores, and returns the operands
    from `first` on and new results. Its equations are those of `closed`: nothing is
    traced again.
    """
    jaxpr = program_of(closed).jaxpr
    types = map(varying_shape, result_types(closed))
    old = jax.make_jaxpr(lambda *arrays: arrays)(*types)
    changed = jaxpr.replace(
        invars=[*jaxpr.invars, *old.jaxpr.invars],
        outvars=[*jaxpr.invars[first:], *jaxpr.outvars],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    return closed.replace(jaxpr=changed)


def computed_results(closed: Any) -> tuple[Any, list[int | None]]:
    """Returns a program without the results that are operands, and which these are.

    Returns:
        The closed jaxpr whose results are all computed, and for each result of `closed`
        the index of the operand that it is; `None` if it is computed.
    """
    jaxpr = program_of(closed).jaxpr
    numbers = {variable: i for i, variable in enumerate(jaxpr.invars)}
    given = [None if is_literal(a) else numbers.get(a) for a in jaxpr.outvars]
    computed = [a for a, i in zip(jaxpr.outvars, given, strict=True) if i is None]
    names = jaxpr.debug_info.with_unknown_names()
    return closed.replace(
        jaxpr=jaxpr.replace(outvars=computed, debug_info=names)
    ), given


def is_literal(atom: Any) -> bool:
    """Whether an operand of an equation is a literal number rather than a variable."""
    return hasattr(atom, "val")


def programs_within(equation: Any) -> Iterator[Any]:
    """Yields the jaxprs among the parameters of an equation."""
    for value in equation.params.values():
        for inner in value if isinstance(value, tuple | list) else (value,):
            if _is_program(inner):
                yield program_of(inner).jaxpr


def n_equations(program: Any) -> int:
    """Returns the number of equations of a program, with those of nested programs."""
    return sum(
        1 + sum(map(n_equations, programs_within(equation)))
        for equation in program_of(program).jaxpr.eqns
    )


def _is_program(value: Any) -> bool:
    """Whether a value is a jaxpr, closed or not."""
    return hasattr(program_of(value).jaxpr, "eqns")


def called_program(equation: Any) -> Any:
    """Returns the inner program that an equation calls.

    The primitive of the equation must be one of `CALLS`.
    """
    return equation.params[_CALLS[equation.primitive.name]]


@dataclass(frozen=True)
class Scan:
    """The parts of a `scan` equation, a loop of known length (`lax.scan`)."""

    body: Any
    length: int
    backwards: bool
    n_constants: int
    n_carry: int


def scan_of(equation: Any) -> Scan:
    """Returns the body, length, direction and operand counts of a `scan` equation.

    JAX 0.12 keeps the operands (constants, carry, rows) in trees, which are counted
    here; earlier versions keep their counts.
    """
    given = equation.params
    if "ft_in" in given:
        n_constants, n_carry, _ = map(len, given["ft_in"].unpack())
    else:
        n_constants, n_carry = given["num_consts"], given["num_carry"]
    return Scan(given["jaxpr"], given["length"], given["reverse"], n_constants, n_carry)


@dataclass(frozen=True)
class While:
    """The parts of a `while` equation, a loop with a condition (`lax.while_loop`)."""

    condition: Any
    n_condition: int
    """Number of constants of the condition; they are the first operands."""
    body: Any
    n_body: int
    """Number of constants of the body; they follow those of the condition."""


def while_of(equation: Any) -> While:
    """Returns condition, body and numbers of constants of a `while` equation."""
    given = equation.params
    return While(
        given["cond_jaxpr"],
        given["cond_nconsts"],
        given["body_jaxpr"],
        given["body_nconsts"],
    )


class NoDescriptionError(Exception):
    """Raised for a program with a part that has no stable description."""


def description(program: Any, *, rules: bool = False) -> str:
    """Returns a text that is equal for programs that compute the same, in any process.

    It has all types, known numbers, equations and the parameters that are understood.

    Args:
        program: A jaxpr, closed or not.
        rules: Whether programs with equal texts also have the same derivatives. Then
            custom rules of derivatives are described by what they compute.

    Raises:
        NoDescriptionError: If a primitive, a parameter or a number has no description.
    """
    jaxpr, constants = program_of(program)
    numbers: dict[Any, int] = {}

    def new(variable: Any) -> str:
        numbers[variable] = len(numbers)
        return _type_text(variable.aval)

    def read(atom: Any) -> str:
        if is_literal(atom):
            return f"{_described(np.asarray(atom.val), rules)}{_type_text(atom.aval)}"
        return str(numbers[atom])

    lines = [",".join(map(new, [*jaxpr.constvars, *jaxpr.invars]))]
    lines += [_described(np.asarray(constant), rules) for constant in constants]
    for equation in jaxpr.eqns:
        words = unknown_parameter(equation)
        if words is not None:
            raise NoDescriptionError(words)
        given = ",".join(map(read, equation.invars))
        made = ",".join(map(new, equation.outvars))
        lines.append(f"{_operation(equation, rules)}:{given}:{made}")
        if rules and equation.primitive.name.startswith("custom_"):
            lines.append(_rule(jaxpr, equation))
    lines.append(",".join(map(read, jaxpr.outvars)))
    return "\n".join(lines)


def _operation(equation: Any, rules: bool) -> str:
    """Description of the primitive and the parameters of an equation."""
    name = equation.primitive.name
    if name in CALLS:
        return f"{name}{{{description(called_program(equation), rules=rules)}}}"
    if name == "scan":
        scan = scan_of(equation)
        facts = scan.length, scan.backwards, scan.n_constants, scan.n_carry
        return f"{name}{facts}{{{description(scan.body, rules=rules)}}}"
    known = _PARAMETERS.get(name, "").split()
    given = {key: equation.params[key] for key in known if key in equation.params}
    return f"{name}{_described(tuple(sorted(given.items())), rules)}"


def _rule(jaxpr: Any, equation: Any) -> str:
    """Description of the tangent of one equation of a jaxpr, with its own rule.

    Raises:
        NoDescriptionError: It has no tangent, or JAX builds jaxprs differently.
    """
    operands = [a for a in dict.fromkeys(equation.invars) if not is_literal(a)]
    moving = [jnp.issubdtype(a.aval.dtype, jnp.floating) for a in operands]
    try:
        alone = jaxpr.replace(
            constvars=[],
            invars=operands,
            outvars=equation.outvars,
            eqns=[equation],
            debug_info=jaxpr.debug_info.with_unknown_names(),
        )

        def tangent(given: list[Any], tangents: list[Any]) -> Any:
            def value(moved: list[Any]) -> list[Any]:
                rest = iter(moved)
                pairs = zip(given, moving, strict=True)
                arrays = [next(rest) if moves else array for array, moves in pairs]
                return list(jax.core.eval_jaxpr(alone, [], *arrays))

            moved = [a for a, moves in zip(given, moving, strict=True) if moves]
            return jax.jvp(value, (moved,), (tangents,))

        types = [jax.ShapeDtypeStruct(a.aval.shape, a.aval.dtype) for a in operands]
        rates = [a for a, moves in zip(types, moving, strict=True) if moves]
        return description(jax.make_jaxpr(tangent)(types, rates))
    except (TypeError, AttributeError, AssertionError, ValueError) as error:
        raise NoDescriptionError(f"{equation.primitive.name}: {error}") from error


def _type_text(aval: Any) -> str:
    return f"{aval.dtype}{list(aval.shape)}"


def _described(value: Any, rules: bool) -> str:
    """Description of the value of a parameter, or of known numbers.

    Raises:
        NoDescriptionError: It has none.
    """
    if isinstance(value, enum.Enum):
        return f"{type(value).__name__}.{value.name}"
    if value is None or isinstance(value, bool | int | float | str):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, tuple | list):
        inside = ";".join(_described(part, rules) for part in value)
        return f"{type(value).__name__}({inside})"
    if _is_program(value):
        return f"{{{description(value, rules=rules)}}}"
    if isinstance(value, np.dtype):
        return str(value)
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        return f"{value.dtype}{list(value.shape)}{value.tobytes().hex()}"
    if isinstance(value, np.ndarray) and value.dtype == jax.dtypes.float0:
        return f"no tangent{list(value.shape)}"
    raise NoDescriptionError(f"{type(value).__name__} has no description")
