"""Checks of effects and couplings that users write: hook names, pytrees, load shapes.

Without them a misspelled hook is never called, without any message, or an error is
raised deep inside JAX. Classes of jaxrod are not checked: they have tests. Effects are
tested numerically on a motion without symmetries.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.effects.base import Effect
from jaxrod.effects.directions import frame_along
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState

ALIKE = 0.85
"""Similarity by `difflib` above which a name counts as a misspelling of a hook."""


def check_own_class(thing: Any, base: type, noun: str) -> None:
    """Checks the class of an effect or a coupling that a user wrote.

    Args:
        thing: The effect or coupling.
        base: Base class, whose public methods are the hooks.
        noun: "an effect" or "a coupling", for messages.

    Raises:
        TypeError: If the class is not a pytree, if a method has nearly the name of a
            hook that the class does not define, or if it defines no hook at all.
    """
    kind = type(thing)
    if _is_of_jaxrod(kind):
        return
    if jax.tree_util.all_leaves([thing]):
        raise TypeError(
            f"{kind.__name__} is not a pytree: write @jaxrod.extend.pytree above "
            f"the line class {kind.__name__}(...), and give it its numbers as fields"
        )
    # A class is hashable, but type checkers do not know that of `type`.
    words = _slip(kind, base, noun)  # type: ignore[arg-type]
    if words is not None:
        raise TypeError(words)
    _check_structure(thing)


def _check_structure(thing: Any) -> None:
    """Raises a TypeError if a static field, also of a part, is not hashable.

    A list that was changed after compiling would keep its old values in programs.
    """
    if isinstance(thing, list | tuple):
        for part in thing:
            _check_structure(part)
    if isinstance(thing, type) or not dataclasses.is_dataclass(thing):
        return
    for field in dataclasses.fields(thing):
        value = getattr(thing, field.name)
        if not field.metadata.get("static"):
            _check_structure(value)
            continue
        try:
            hash(value)
        except TypeError:
            remedy = "give a tuple" if isinstance(value, list) else "give tuples"
            raise TypeError(
                f"{type(thing).__name__}.{field.name} is static, so it must be "
                f"hashable, got {type(value).__name__}: compiled programs would keep "
                f"the old value after a change; {remedy}, or make it a traced field"
            ) from None


@contextlib.contextmanager
def called_hook(thing: Any, name: str) -> Iterator[None]:
    """Context of a call of a hook, in which errors of traced values name the hook.

    Args:
        thing: The effect or coupling whose hook is called.
        name: Name of the hook.

    Raises:
        TypeError: If the hook needs the value of a traced number, with JAX's error as
            the cause.
    """
    try:
        yield
    except jax.errors.JAXTypeError as error:
        raise TypeError(
            f"{type(thing).__name__}.{name} reads a number that is known "
            f"only while a program runs{remedy(error)}"
        ) from error


def remedy(error: Exception) -> str:
    """Advice to append to a JAX error that does not say what to change, or ""."""
    if isinstance(error, jax.errors.TracerBoolConversionError):
        # JAX names the place in the lines that follow the first.
        return (
            ". What `if`, `while`, `and` or `or` decides by must be known before the "
            "program runs: jnp.where and jax.lax.cond decide while it runs"
        )
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return ". NumPy cannot compute here: jax.numpy has the same functions"
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return (
            ". float(), int() and shapes need a number known before the program runs: "
            "keep it an array"
        )
    return ""


def advice_for(given: Any, noun: str) -> str:
    """Advice to append to the error about a thing in the wrong place, or "".

    Args:
        given: The thing in the wrong place.
        noun: Word for what was wanted, `"effect"` or `"coupling"`.
    """
    if isinstance(given, list | tuple):
        return f": write *{noun}s"
    if callable(given):
        name = getattr(given, "__name__", "it")
        article = "an" if noun == "effect" else "a"
        return f": call {name}(...), which returns {article} {noun}"
    advice: str = getattr(given, "misplaced", "")
    return advice


def check_own_hooks(effect: Effect, rod: Rod) -> None:
    """Traces hooks of an effect that a user wrote, to find those that read values.

    All other errors are left to the functions that need the hook.

    Args:
        effect: The effect, with schedules replaced by their values at one time.
        rod: The rod.

    Raises:
        TypeError: If a hook needs the value of a traced number, or returns something
            else than it should.
    """
    kind = type(effect)
    if _is_of_jaxrod(kind) or rod.batch_shape:
        return
    hooks: dict[str, Callable[[Effect, Rod], Any]] = {
        "energy": lambda effect, rod: effect.energy(rod, _trial_state(rod)),
        "stability_bound": lambda effect, rod: effect.stability_bound(rod),
        "damping_rates": lambda effect, rod: effect.damping_rates(rod),
        "constrain": lambda effect, rod: effect.constrain(rod, trial_motion(rod)),
        "constrain_rates": lambda effect, rod: effect.constrain_rates(
            rod, trial_motion(rod)
        ),
    }
    for name, call in hooks.items():
        if getattr(kind, name) is getattr(Effect, name):
            continue
        try:
            found = jax.eval_shape(call, effect, rod)
        except jax.errors.JAXTypeError:
            with called_hook(effect, name):
                raise
        except Exception:
            continue
        fits, wanted = _ANSWERS[name]
        if not fits(found):
            raise TypeError(
                f"{kind.__name__}.{name} must return {wanted}, got {_described(found)}"
            )


_ANSWERS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "energy": (lambda found: getattr(found, "shape", None) == (), "one number [J]"),
    "stability_bound": (
        lambda found: found is None or callable(getattr(found, "drags", None)),
        "a jaxrod.extend.StabilityBound",
    ),
    "damping_rates": (
        lambda found: (
            found is None or (isinstance(found, tuple | list) and len(found) == 2)
        ),
        "two rates, of velocities and of spins [1/s]",
    ),
    **dict.fromkeys(
        ("constrain", "constrain_rates"),
        (
            lambda found: getattr(found, "spin", None) is not None,
            "the motion, replaced where it is held",
        ),
    ),
}
"""For each hook a test of its result, and the result as text."""


def _trial_state(rod: Rod) -> RodState:
    """State of `trial_motion`."""
    motion = trial_motion(rod)
    return RodState(
        positions=jnp.stack(motion.position),
        orientations=jnp.stack(motion.orientation),
        velocities=jnp.stack(motion.velocity),
        angular_momenta=jnp.stack(motion.spin),
    )


def check_own_loads(effect: Effect, rod: Rod) -> None:
    """Checks the type and the shapes of the loads of an effect that a user wrote.

    The loads are traced, not computed. Loads on batches of rods are not checked.

    Args:
        effect: The effect, with schedules replaced by their values at one time.
        rod: The rod.

    Raises:
        TypeError: If `loads` returns something other than `jaxrod.extend.Loads`.
        ValueError: If forces or couples do not fit the rod.
    """
    kind = type(effect)
    gives = kind.loads is not Effect.loads or kind.loads_after is not Effect.loads_after
    if _is_of_jaxrod(kind) or not gives or rod.batch_shape:
        return

    def look(effect: Effect, rod: Rod) -> None:
        motion = trial_motion(rod)
        none = Loads(*jax.tree.map(jnp.zeros_like, (motion.position, motion.spin)))
        _check_loads(kind, effect.loads_after(rod, motion, none), rod.n_elements)

    with called_hook(effect, _hook_of_loads(kind)):
        jax.eval_shape(look, effect, rod)


def is_own(thing: Any) -> bool:
    """Whether the class of an effect or a coupling was written by a user."""
    return not _is_of_jaxrod(type(thing))


def _hook_of_loads(kind: type) -> str:
    """Name of the hook that a class of effects defines for its loads."""
    # `kind` is a subclass of `Effect`, which its annotation does not show.
    return "loads" if kind.loads is not Effect.loads else "loads_after"  # type: ignore[attr-defined]


def _check_loads(kind: type, found: Any, n_elements: int) -> None:
    """Raises unless `found`, the result of a load hook, is `Loads` that fits the rod.

    `kind` is the class of the effect, for the message; the rod has `n_elements`.
    """
    name = _hook_of_loads(kind)
    if not isinstance(found, Loads):
        raise TypeError(
            f"{kind.__name__}.{name} must return jaxrod.extend.Loads(forces=(x, y, z), "
            f"couples=(x, y, z)), got {_described(found)}"
        )
    for what, count, of in (
        ("forces", n_elements + 1, "nodes"),
        ("couples", n_elements, "elements"),
    ):
        given = getattr(found, what)
        if given is not None and not _fits(given, count):
            raise ValueError(
                f"{kind.__name__}.{name} must return {what} as three components of "
                f"shape ({count},), one number for each of the {count} {of}, got "
                f"{_described(given)}"
            )


def _fits(given: Any, count: int) -> bool:
    """Whether a value is three components that broadcast to `count` entries each."""
    if isinstance(given, jax.Array):
        return given.shape == (3, count)
    if not isinstance(given, tuple | list) or len(given) != 3:
        return False
    return all(jnp.shape(part) in ((count,), (1,), ()) for part in given)


def _described(given: Any) -> str:
    """Shape or shapes of forces or couples that a hook returned, for a message."""
    if isinstance(given, tuple | list):
        shapes = ", ".join(str(jnp.shape(part)) for part in given)
        return f"{len(given)} of shapes {shapes}"
    if isinstance(given, jax.Array | jax.ShapeDtypeStruct):
        return f"an array of shape {given.shape}"
    return type(given).__name__


def _is_of_jaxrod(kind: type) -> bool:
    return kind.__module__.startswith("jaxrod.")


@functools.cache
def _slip(kind: type, base: type, noun: str) -> str | None:
    """Error message if a class misspells a hook, or defines none; otherwise `None`.

    Hooks are the public methods of `base`. The message calls the class `noun`, such as
    "an effect".
    """
    bases = [each for each in kind.__mro__ if issubclass(each, base)]
    hooks = {n for each in bases if _is_of_jaxrod(each) for n in _public(each)}
    own = {n for each in bases if not _is_of_jaxrod(each) for n in _public(each)}
    for name in sorted(own - hooks):
        meant = difflib.get_close_matches(name, hooks - own, 1, ALIKE)
        # A helper may have a name close to a hook that the class defines, too.
        if meant and not difflib.get_close_matches(name, hooks & own, 1, ALIKE):
            return (
                f"{kind.__name__}.{name} is not a hook of {noun} and would never be "
                f"called: is {meant[0]} meant? If it is a helper, give it a name less "
                "like a hook's, or a leading underscore"
            )
    hooks = _public(base)
    defined = [n for n in hooks if getattr(kind, n) is not getattr(base, n)]
    if not defined:
        return (
            f"{kind.__name__} defines no hook of {noun}, and would do nothing; the "
            f"hooks are {', '.join(sorted(hooks))}"
        )
    return None


def _public(kind: type) -> set[str]:
    """Names of public methods, and of `reach`, that a class defines itself."""
    return {
        name
        for name, value in vars(kind).items()
        if not name.startswith("_") and (_is_method(value) or name == "reach")
    }


def _is_method(value: Any) -> bool:
    return callable(value) or isinstance(value, property | classmethod | staticmethod)


def trial_motion(rod: Rod) -> Motion:
    """Unstretched rod with irregular directions of elements and irregular rates.

    It is for tests of effects. The angular momentum of each element is perpendicular to
    the element.
    """
    k = jnp.arange(rod.n_elements, dtype=rod.rest_lengths.dtype)
    x, y, z = jnp.cos(1.1 * k + 0.3), jnp.sin(1.7 * k + 0.7), jnp.cos(0.6 * k - 0.5)
    direction = vectors.scale(1 / jnp.sqrt(x * x + y * y + z * z), (x, y, z))
    position = _summed(vectors.scale(rod.rest_lengths, direction))
    return Motion(
        position=position,
        orientation=frame_along(direction),
        velocity=(position[1], position[2], position[0]),
        spin=vectors.cross(direction, vectors.scale(rod.inertias[0], (y, z, x))),
    )


def _summed(edges: Vec3) -> Vec3:
    x, y, z = (vectors.pad(jnp.cumsum(c), 1, 0) for c in edges)
    return x, y, z
