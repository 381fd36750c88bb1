"""Checks of effects and couplings that users write: hook names, pytrees, load shapes.

Without them a misspelled hook is never called, without any message, or an error is
raised deep inside JAX. Classes of jaxrod are not checked: they have tests. Effects are
tested numerically on a motion without symmetries.
"""

from __future__ import annotations

import difflib
import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.effects.base import Effect
from jaxrod.effects.directions import frame_along
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod

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

    jax.eval_shape(look, effect, rod)


def _check_loads(kind: type, found: Any, n_elements: int) -> None:
    """Raises unless `found`, the result of a load hook, is `Loads` that fits the rod.

    `kind` is the class of the effect, for the message; the rod has `n_elements`.
    """
    # `kind` is a subclass of `Effect`, which its annotation does not show.
    name = "loads" if kind.loads is not Effect.loads else "loads_after"  # type: ignore[attr-defined]
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
    if isinstance(given, jax.Array):
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
