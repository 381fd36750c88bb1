"""jaxrod's own primitives, and the rules by which JAX transforms and lowers them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import jax
from jax import lax

from jaxrod.jax_internals.equations import program_of

_NEEDED = {
    "core": ("ShapedArray", "eval_jaxpr"),
    "interpreters.ad": (
        *("Zero", "instantiate_zeros", "is_undefined_primal"),
        *("primitive_jvps", "primitive_transposes"),
    ),
    "interpreters.batching": ("primitive_batchers",),
    "interpreters.mlir": ("lower_fun", "register_lowering"),
}
"""Names that jaxrod's primitives need, by the module of JAX that contains them."""
_METHODS = ("bind", "def_abstract_eval", "def_impl")

Rule = Callable[..., Any]
Program = Callable[..., Any]


@cache
def unknown_rules() -> str | None:
    """Returns the reason why this version of JAX does not support custom primitives.

    Returns:
        The reason, or `None` if JAX supports them.
    """
    import importlib

    for module, names in _NEEDED.items():
        try:
            found = importlib.import_module(f"jax.{module}")
        except ImportError:
            return f"this JAX has no jax.{module}"
        for name in names:
            if not hasattr(found, name):
                return f"this JAX has no jax.{module}.{name}"
    for name in _METHODS:
        if not hasattr(lax.add_p, name):
            return f"primitives of this JAX have no method {name}"
    return None


def new_primitive(name: str) -> Any:
    """Creates a JAX primitive with several results; `define` adds its rules.

    Args:
        name: Name of the primitive in printed jaxprs.
    """
    # The class has no public name outside jax.extend.
    primitive = type(lax.add_p)(name)
    primitive.multiple_results = True
    return primitive


def define(
    primitive: Any,
    reference: Program,
    *,
    static: str,
    shapes: Rule,
    batched: Rule,
    jvp: Rule,
    transpose: Rule | None = None,
) -> None:
    """Registers with JAX how to run, batch, differentiate and lower a primitive.

    Args:
        primitive: Primitive from `new_primitive`.
        reference: The same operation as a function that JAX can trace.
        static: Name of the one parameter that is not an array. JAX searches parameters
            for jaxprs and transforms those that it finds, so this parameter must hide
            its jaxprs inside an object.
        shapes: Rule that maps the types of the operands to those of the results.
        batched: Rule for `jax.vmap`.
        jvp: Rule for forward mode.
        transpose: Rule for the cotangents of the operands; None if the operation is not
            linear.
    """
    from jax.interpreters import ad, batching, mlir

    primitive.def_abstract_eval(shapes)
    primitive.def_impl(jax.jit(reference, static_argnames=static))
    batching.primitive_batchers[primitive] = batched
    ad.primitive_jvps[primitive] = jvp
    if transpose is not None:
        ad.primitive_transposes[primitive] = transpose
    mlir.register_lowering(primitive, mlir.lower_fun(reference, multiple_results=True))


def lower_on(
    platform: str,
    primitive: Any,
    reference: Program,
    choose: Callable[[str | None, Sequence[Any], Mapping[str, Any]], Program | None],
) -> None:
    """Registers the choice between a special program and the reference on a platform.

    Args:
        platform: `"cpu"` or `"cuda"`.
        primitive: A primitive with rules from `define`.
        reference: Program that is lowered if `choose` returns `None`.
        choose: Function that returns the program to compile, or `None`. It takes the
            reason why the compiled program may not contain kernels (`None` if it may),
            the types of the results, and the parameters of the primitive.
    """
    from jax.interpreters import mlir

    by_xla = mlir.lower_fun(reference, multiple_results=True)

    def rule(context: Any, *operands: Any, **parameters: Any) -> Any:
        try:
            unfit, results = no_kernels_in(context), context.avals_out
            # A kernel runs on one device, so that its types have no mesh axes.
            plain = [jax.core.ShapedArray(a.shape, a.dtype) for a in context.avals_in]
            alone = context.replace(avals_in=plain)
        except (AttributeError, TypeError) as error:
            unfit, results, alone = f"this JAX lowers differently: {error}", (), None
        program = choose(unfit, results, parameters)
        if program is None:
            return by_xla(context, *operands, **parameters)
        return mlir.lower_fun(program, multiple_results=True)(alone, *operands)

    mlir.register_lowering(primitive, rule, platform=platform)


def no_kernels_in(context: Any) -> str | None:
    """Returns the reason why a compiled program may not contain kernels, or `None`.

    Programs for export, for several platforms, and for batches that the compiler
    spreads over devices may not. Within `jax.shard_map` each device may run a kernel of
    its part.

    Args:
        context: JAX's context for lowering one equation.
    """
    module = context.module_context
    if len(module.platforms) > 1:
        return "the program is for several platforms, and kernels are of one"
    if module.lowering_parameters.for_export:
        return "the program is to be exported, and kernels are of this process"
    where = module.axis_context
    devices = getattr(where, "num_devices", None)
    if hasattr(where, "manual_axes"):
        left = set(where.mesh.axis_names) - set(where.manual_axes)
        devices = math.prod(where.mesh.shape[name] for name in left)
    if devices not in (None, 1):
        return (
            "the compiler spreads the batch over devices, which it cannot do to kernels"
        )
    return None


def evaluate(closed: Any, *arrays: Any) -> list[Any]:
    """Evaluates a closed jaxpr, or traces it if the operands are traced.

    Args:
        closed: A jaxpr with its constants, from `jax.make_jaxpr`.
        *arrays: Operands of the program.

    Returns:
        The results of the program.
    """
    jaxpr, constants = program_of(closed)
    return list(jax.core.eval_jaxpr(jaxpr, constants, *arrays))


def is_zero(tangent: Any) -> bool:
    """Whether a tangent or cotangent is a symbolic zero."""
    from jax.interpreters import ad

    return type(tangent) is ad.Zero


def no_tangent(array: Any) -> Any:
    """Returns a symbolic zero as the tangent of an array of integers or booleans."""
    from jax.interpreters import ad

    return ad.Zero(jax.typeof(array).to_tangent_aval())


def filled_in(tangent: Any) -> Any:
    """Returns a tangent or cotangent as an array, with zeros for a symbolic zero."""
    from jax.interpreters import ad

    return ad.instantiate_zeros(tangent)


def is_linear_input(operand: Any) -> bool:
    """Whether a transpose rule has to return a cotangent for an operand."""
    from jax.interpreters import ad

    return ad.is_undefined_primal(operand)
