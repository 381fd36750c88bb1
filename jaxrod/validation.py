"""Checks of arguments on the host, with errors that name units.

Values are checked in float64 and stored in a dtype that may be narrower. `check_array`
does the first, `as_array` both; values that the dtype cannot hold are refused. The
values of JAX tracers cannot be read: only their shape and kind are checked, also
inside nested lists and tuples.
"""

from __future__ import annotations

import functools
import math
import numbers
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

Numbers = ArrayLike | list[Any] | tuple[Any, ...]
"""A number, a vector or an array of numbers, as a caller may give it."""

Given = ParamSpec("Given")
Made = TypeVar("Made")

MOST = 2**31 - 1
"""Largest number of steps or of iterations that may be asked for."""


def is_traced(*values: Any) -> bool:
    """Whether any leaf is a tracer, whose value cannot be read."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def with_parameters(
    function: Callable[[Any, Any], Any], point: Array, parameters: Any
) -> tuple[Callable[[Any, Any], Any], Any]:
    """Function and parameters in which traced numbers of the function are parameters.

    A run fixes its number of steps, as reverse mode needs it, if something in its scene
    is traced. It cannot see a traced number inside a function.

    Args:
        function: Function of a point and of parameters that returns one array.
        point: A point.
        parameters: Its parameters, a pytree of arrays.

    Returns:
        What was given, unless the function holds traced numbers.
    """
    converted, held = jax.closure_convert(function, point, parameters)
    if not held:
        return function, parameters
    types = jax.tree.map(jnp.result_type, (point, parameters, held))

    def opened(point: Any, given: Any) -> Any:
        # The converted function has the types with which it was traced.
        fitting, own, numbers = jax.tree.map(
            lambda leaf, kind: jnp.asarray(leaf, kind),
            (point, *given),
            types,
        )
        return converted(fitting, own, *numbers).astype(point.dtype)

    return opened, (parameters, held)


def knows_constants(function: Callable[Given, Made]) -> Callable[Given, Made]:
    """Decorates a function so that it can read known values inside `jax.jit`, too.

    There JAX traces every operation, even one on arrays that were made outside:
    `float(jnp.min(radii))` fails although `is_traced(radii)` is false. The decorator
    makes JAX evaluate operations on known values immediately. It is for functions that
    read values: checks, and numbers that determine the structure of a program.
    """

    @functools.wraps(function)
    def knowing(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        # Outside jit known values stay known, and the option below would make JAX
        # compile each operation once more.
        if not is_traced(lax.neg(np.float32(0))):
            return function(*args, **kwargs)
        before = _evaluating.now
        _evaluating.now = True
        try:
            with jax.ensure_compile_time_eval():
                return function(*args, **kwargs)
        finally:
            _evaluating.now = before

    return knowing


class _Evaluating(threading.local):
    now = False
    """Whether this thread evaluates known values while JAX traces."""


_evaluating = _Evaluating()


def compiled(function: Callable[Given, Made]) -> Callable[Given, Made]:
    """Decorates a function of many operations, so that they are one program.

    Where known values are evaluated inside `jax.jit` (see `knows_constants`) it is not
    compiled: its results would be traced.
    """
    jitted: Callable[Given, Made] = jax.jit(function)

    @functools.wraps(function)
    def either(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        return (function if _evaluating.now else jitted)(*args, **kwargs)

    return either


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Gives a warning that points to the calling line outside jaxrod and JAX.

    Args:
        message: Text of the warning.
        category: Class of the warning.
    """
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and _is_ours(frame.f_globals.get("__name__") or ""):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def _is_ours(module: str) -> bool:
    """Whether a module is part of jaxrod or of JAX, so that warnings skip its lines."""
    return module.partition(".")[0] in ("jaxrod", "jax")


def check_kind(name: str, value: Any, kind: type | tuple[type, ...]) -> None:
    """Raises unless a value is an instance of a jaxrod class, or of one of several.

    Raises:
        TypeError: If it is not; the message names argument, class and given type.
    """
    if isinstance(value, kind):
        return
    kinds = kind if isinstance(kind, tuple) else (kind,)
    wanted = " or ".join(one.__name__ for one in kinds)
    hint = ""
    if isinstance(value, tuple):
        hint = " (factories return the pair rod, state)"
    raise TypeError(
        f"{name} must be a jaxrod {wanted}, got {type(value).__name__}{hint}"
    )


def check_count(name: str, value: Any, smallest: int, largest: float = MOST) -> int:
    """Returns `value` as an int; raises if it is not an integer within bounds."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(
            f"{name} must be an integer known when the program is traced, not one "
            "that is traced itself: jax.jit(..., static_argnames=...) makes it so"
        )
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name} must be an integer, got {_shown(value)}")
    if value < smallest:
        raise ValueError(f"{name} must be at least {smallest}, got {_shown(value)}")
    if value > largest:
        raise ValueError(f"{name} must be at most {largest}, got {_shown(value)}")
    return int(value)


LARGEST_SEED = 2**32 - 1
"""Largest seed: `jax.random.key` uses no more bits unless 64-bit types are enabled."""


def check_seed(seed: Any, name: str = "seed") -> int:
    """Returns a seed as an int; raises unless it is from 0 to `LARGEST_SEED`.

    A larger seed would give the same random numbers as a smaller one.
    """
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not whole or not 0 <= seed <= LARGEST_SEED:
        raise ValueError(
            f"{name} must be an integer from 0 to {LARGEST_SEED}, got {seed!r}"
        )
    return int(seed)


def check_dtype(dtype: Any) -> np.dtype:
    """Validates the floating-point dtype of a rod and returns it.

    For `None` it returns JAX's default dtype.

    Raises:
        ValueError: If it is neither float32 nor float64, or float64 while JAX has
            64-bit types turned off.
    """
    if dtype is None:
        return jnp.result_type(float)
    try:
        kind = jnp.dtype(dtype)
    except TypeError:
        raise ValueError(f"dtype must be float32 or float64, got {dtype!r}") from None
    if kind not in (np.float32, np.float64):
        raise ValueError(f"dtype must be float32 or float64, got {kind}")
    if kind != jax.dtypes.canonicalize_dtype(kind):
        raise ValueError(
            'dtype float64 needs jax.config.update("jax_enable_x64", True), called '
            "before anything is computed"
        )
    return kind


def check_array(
    name: str,
    value: Any,
    shapes: Sequence[tuple[int, ...]],
    unit: str,
    *,
    positive: bool = False,
    non_negative: bool = False,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    dtype: Any = None,
) -> Any:
    """Validates kind, shape, finiteness, sign and size of numbers, and returns them.

    If JAX is tracing the values, only kind and shape are checked.

    Args:
        name: The argument's name, for the message.
        value: A number or array, or numbers and arrays in lists and tuples.
        shapes: The allowed shapes.
        unit: SI unit, for the message ("" for a pure number).
        positive: Whether values must be > 0.
        non_negative: Whether values must be >= 0.
        at_least: Smallest allowed value.
        at_most: Largest allowed value.
        dtype: Floating-point dtype that must be able to hold the values, if given.

    Returns:
        The value as a NumPy float64 array, or as a JAX array if it is traced.

    Raises:
        ValueError: If a check fails; the message names argument, value and unit.
    """
    value = numeric(name, value, unit)
    if tuple(value.shape) not in [tuple(s) for s in shapes]:
        allowed = " or ".join(str(tuple(s)) for s in shapes)
        raise ValueError(
            f"{name} must have shape {allowed}, got {tuple(value.shape)}"
            + (f"; its unit is {unit}" if unit else "")
        )
    if is_traced(value):
        return value
    for is_bad, demand in (
        (~np.isfinite(value), "finite"),
        (positive & (value <= 0), "positive"),
        (non_negative & (value < 0), "non-negative"),
        (value < at_least, f"at least {at_least:g}"),
        (value > at_most, f"at most {at_most:g}"),
    ):
        if np.any(is_bad):
            bad = _first(value, is_bad, unit)
            raise ValueError(f"{name} must be {demand}, got {bad}")
    if dtype is not None:
        check_held(name, value, unit, dtype, each=positive)
    return value


def as_array(
    name: str,
    value: Any,
    unit: str,
    shapes: Sequence[tuple[int, ...]] = ((),),
    *,
    positive: bool = False,
    non_negative: bool = False,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    dtype: Any = None,
) -> Array:
    """Converts an argument to a JAX array, after the checks of `check_array`.

    Args:
        name: The argument's name, for the message.
        value: A number or array, or numbers and arrays in lists and tuples.
        unit: SI unit, for the message ("" for a pure number).
        shapes: The allowed shapes; one number by default.
        positive: Whether values must be > 0.
        non_negative: Whether values must be >= 0.
        at_least: Smallest allowed value.
        at_most: Largest allowed value.
        dtype: Floating-point dtype; by default JAX's default.

    Raises:
        ValueError: If a check fails; the message names argument, value and unit.

    Example:
        >>> extend.as_array("force", [1, 2, 3], "N", [(3,)]).tolist()
        [1.0, 2.0, 3.0]
        >>> extend.as_array("stiffness", -1.0, "N/m", positive=True)
        Traceback (most recent call last):
            ...
        ValueError: stiffness must be positive, got -1 N/m
    """
    dtype = jnp.result_type(float) if dtype is None else dtype
    checked = check_array(
        name,
        value,
        shapes,
        unit,
        positive=positive,
        non_negative=non_negative,
        at_least=at_least,
        at_most=at_most,
        dtype=dtype,
    )
    return jnp.asarray(checked, dtype)


def step_of(dt: Any) -> Any:
    """Time step of an object that has one; anything else is returned unchanged."""
    return getattr(dt, "dt", dt)


def check_time_step(dt: Any, dtype: Any = None) -> Any:
    """Validates a time step, which must be positive, and returns it.

    Args:
        dt: Time step [s], or an object that has one.
        dtype: Floating-point dtype that must be able to hold it, if given.

    Returns:
        A NumPy float64 array; a JAX array if the step is traced.

    Raises:
        ValueError: If it is not one positive number.
    """
    return check_array("dt", step_of(dt), [()], "s", positive=True, dtype=dtype)


def as_time_step(dt: Any, dtype: Any = None) -> Array:
    """Converts a time step to a JAX array, after the checks of `check_time_step`.

    Args:
        dt: Time step [s], or an object that has one.
        dtype: Floating-point dtype; by default JAX's default.

    Raises:
        ValueError: If it is not one positive number.
    """
    return as_array("dt", step_of(dt), "s", positive=True, dtype=dtype)


def optional_number(name: str, value: Numbers | None, unit: str) -> Array | None:
    """Checked number that must not be negative; `None` if none is given.

    `name` and `unit` are for error messages.
    """
    if value is None:
        return None
    return as_array(name, value, unit, non_negative=True)


def check_held(
    name: str, value: np.ndarray, unit: str, dtype: Any, *, each: bool = False
) -> None:
    """Raises ValueError unless a floating-point dtype can hold float64 values.

    It can if they and their reciprocals are normal numbers of the dtype: neither
    infinite nor rounded to zero. Entries of an array (a vector, say) may vanish if they
    are negligible compared with the largest, unless `each` is set.

    Args:
        name: Name, for the message.
        value: The values.
        unit: SI unit, for the message ("" for a pure number).
        dtype: The floating-point dtype.
        each: Whether every entry matters by itself.

    Raises:
        ValueError: If it cannot; the message names value, unit and dtype.
    """
    limits = jnp.finfo(dtype)
    smallest, largest = float(limits.tiny), 1 / float(limits.tiny)
    size = np.abs(value)
    negligible = 0.0 if each else float(limits.eps) * np.max(size, initial=0)
    lost = ~(size <= largest) | ((size < smallest) & (size > negligible))
    if each:
        lost |= size == 0
    if not np.any(lost):
        return
    limits_in_unit = f"{smallest:.2g} and {largest:.2g}{f' {unit}' if unit else ''}"
    remedy = ""
    if np.dtype(dtype) == np.float32:
        remedy = (
            '. float64 holds more: jax.config.update("jax_enable_x64", True), and for '
            "a rod dtype=jnp.float64"
        )
    raise ValueError(
        f"{name} must be between {limits_in_unit} in size in {np.dtype(dtype)}, got "
        f"{_first(value, lost, unit)}{remedy}"
    )


def in_type(dtype: Any, name: str, tree: Any) -> Any:
    """Returns a pytree with its floating-point numbers converted to a dtype.

    Args:
        dtype: The floating-point dtype.
        name: Name of the pytree, for the message.
        tree: The pytree; leaves of other kinds stay as they are.

    Raises:
        ValueError: If the dtype cannot hold a number; the message names its place in
            the pytree.
    """

    def cast(path: Any, leaf: Any) -> Array:
        array = jnp.asarray(leaf)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            return array
        if not is_traced(array) and array.dtype != dtype:
            where = f"{name}{jax.tree_util.keystr(path)}"
            known = np.asarray(array, np.float64)
            # NaN, which stands for a number that is left out, is in every dtype.
            check_held(where, known[~np.isnan(known)], "", dtype)
        return array.astype(dtype)

    return jax.tree_util.tree_map_with_path(cast, tree)


def astype(tree: Any, dtype: Any) -> Any:
    """Returns a scene, a system, a state or another pytree in another precision.

    All arrays of floating-point numbers are converted; integers, Python's own numbers
    and the structure are kept. Numbers that were rounded to float32 remain rounded in
    float64: build a scene in float64 from the start if its parameters have to be exact.

    Args:
        tree: Any pytree.
        dtype: float32 or float64; `None` for JAX's default.

    Raises:
        ValueError: If the dtype is any other, or cannot hold a number; the message
            names its place in the pytree.

    Example:
        >>> import jax, jax.numpy as jnp, jaxrod
        >>> single = jaxrod.end_load(force=jnp.asarray([0.0, 0.5, 2.0], jnp.float32))
        >>> with jax.enable_x64(True):
        ...     jaxrod.astype(single, jnp.float64).force.dtype
        dtype('float64')
    """
    kind = check_dtype(dtype)

    def cast(path: Any, leaf: Any) -> Any:
        given = getattr(leaf, "dtype", np.dtype(bool))
        if given == kind or not jnp.issubdtype(given, jnp.floating):
            return leaf
        if not is_traced(leaf):
            values = np.asarray(leaf, np.float64)
            # States that are not finite stay so.
            finite = np.where(np.isfinite(values), values, 0)
            check_held(f"tree{jax.tree_util.keystr(path)}", finite, "", kind)
        return jnp.asarray(leaf, kind)

    return jax.tree_util.tree_map_with_path(cast, tree)


def numeric(name: str, value: Any, unit: str = "") -> Any:
    """Converts numbers and arrays, including those in lists and tuples, to one array.

    Args:
        name: The argument's name, for the message.
        value: The argument's value.
        unit: SI unit, for the message ("" for a pure number).

    Returns:
        A NumPy float64 array; a JAX array if anything in it is traced.

    Raises:
        ValueError: If anything in it is not a real number (strings, truth values and
            complex numbers are not), or the nesting is not regular.
    """
    leaves = list(_leaves(value))
    wanted = f"{name} must be real numbers{f' in {unit}' if unit else ''}"
    if not all(map(_is_real, leaves)):
        raise ValueError(f"{wanted}, got {_shown(value)}")
    traced = is_traced(leaves)
    if traced and len(leaves) > 1:
        # Known values become traced once they are in an array with traced ones.
        for leaf in leaves:
            as_array(f"each number of {name}", leaf, unit, [np.shape(leaf)])
    try:
        with np.errstate(over="ignore"):
            return jnp.asarray(value) if traced else np.asarray(value, np.float64)
    except OverflowError:
        raise ValueError(f"{name} must be finite, got {_shown(value)}") from None
    except (TypeError, ValueError):
        raise ValueError(f"{wanted}, one array, got {_shown(value)}") from None


def _leaves(value: Any) -> Iterator[Any]:
    """Leaves of nested lists and tuples; anything else is itself a leaf."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        for part in value:
            yield from _leaves(part)
    else:
        yield value


def _is_real(leaf: Any) -> bool:
    """Whether a leaf is a real number or an array of real numbers."""
    if isinstance(leaf, numbers.Real):
        # Numbers of Python and NumPy; Python counts truth values as integers.
        return not isinstance(leaf, bool)
    if not isinstance(leaf, np.ndarray | np.generic | jax.Array):
        if not hasattr(leaf, "__array__"):
            return False
        leaf = np.asarray(leaf)
    return any(jnp.issubdtype(leaf.dtype, kind) for kind in (jnp.floating, jnp.integer))


def _first(value: np.ndarray, is_bad: np.ndarray, unit: str) -> str:
    """Text for the first entry of `value` that `is_bad` flags, with unit and index."""
    unit = f" {unit}" if unit else ""
    if value.ndim == 0:
        return f"{value[()]:g}{unit}"
    index = np.argwhere(is_bad)[0]
    return f"{value[tuple(index)]:g}{unit} at index {index}"


def _shown(value: Any) -> str:
    """Text for a value in a message, cut short if it is long."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no integers of thousands of digits
        text = f"a huge {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:76]} ..."
