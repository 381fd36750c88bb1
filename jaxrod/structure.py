"""Frozen dataclasses that are JAX pytrees: the whole of jaxrod's "framework"."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, dataclass_transform

import jax

from jaxrod.installation.jax_version import require_sound_jax
from jaxrod.spelling import nearest

# No rod can be made without this module.
require_sound_jax()

T = TypeVar("T")


class Hinted:
    """Base class of pytrees that answer a guessed or misspelt attribute with a hint."""

    _hints: ClassVar[Mapping[str, str]]
    """Hints by the guess."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raises an error, with a hint if the name is a guess or misspelt."""
            kind = type(self)
            hint = kind._hints.get(name)
            if hint is None and not name.startswith("_") and name not in dir(kind):
                fields = [field.name for field in dataclasses.fields(kind)]
                meant = nearest(name, {*dir(kind), *fields} - {name})
                hint = meant and f"did you mean {meant!r}?"
            if hint is None:
                # Python's own error, or again that of a property.
                return object.__getattribute__(self, name)
            raise AttributeError(
                f"{kind.__name__!r} object has no attribute {name!r}: {hint}"
            )


STORABLE: set[type] = set()
"""Dataclasses that `jaxrod.save` may put into a file."""

Given = jax.typing.ArrayLike | Callable[[Any], Any]
"""Value of a `Leaf` field: a number, an array, or a schedule (a function of a
clock)."""


class Leaf:
    """A field for an array, which may be given as a number or a schedule.

    It is an annotation, never instantiated. In hooks of effects the field is an array:
    `make_scene` converts numbers, and a run replaces a schedule by its value.

    Example:
        >>> @extend.pytree
        ... class Lift(extend.Effect):
        ...     force: extend.Leaf  # on every node, along z [N]
        ...
        ...     def loads(self, rod, motion):
        ...         z = jnp.full_like(motion.position[2], self.force)
        ...         return extend.Loads(forces=(0 * z, 0 * z, z))
        >>> growing = schedules.ramp(0.0, 2.0, duration=1.0)
        >>> lifted = jaxrod.make_scene(rod, Lift(growing))
        >>> float(lifted.at(0.5).effects[0].force)
        1.0
    """

    # Type checkers read from these the type of a field and of its argument.
    def __get__(self, owner: Any, kind: Any = None) -> jax.Array:
        """Declares to type checkers that the field is read as an array."""
        raise NotImplementedError

    def __set__(self, owner: Any, value: Given) -> None:
        """Declares to type checkers that a number, array or schedule may be given."""
        raise NotImplementedError


def static(**options: Any) -> Any:
    """Declares a structural field: part of the pytree's type, never traced.

    Its values must be hashable. A program is compiled for each of them.

    Args:
        **options: Options of `dataclasses.field`, such as `default`.

    Example:
        >>> @extend.pytree
        ... class Probe:
        ...     place: jax.Array
        ...     name: str = extend.static(default="probe")
        >>> jax.tree.map(lambda leaf: 2 * leaf, Probe(1.5, "front"))
        Probe(place=3.0, name='front')
    """
    return dataclasses.field(metadata={"static": True}, **options)


def memory(**options: Any) -> Any:
    """Declares a field of an effect that `Effect.after_step` changes at every step.

    Its value in a scene is the initial one; from then on it is in `RodState.memory`.

    Args:
        **options: Options of `dataclasses.field`, such as `default`.

    Example:
        >>> @extend.pytree
        ... class Counter(extend.Effect):
        ...     steps: jax.Array = extend.memory(default=0.0)
        ...
        ...     def after_step(self, rod, motion, dt):
        ...         return replace(self, steps=self.steps + 1)
        >>> counted = jaxrod.make_scene(rod, Counter())
        >>> after = jaxrod.step(counted, jaxrod.step(counted, state, 1e-4), 1e-4)
        >>> float(after.memory[0]["steps"])
        2.0
    """
    return dataclasses.field(metadata={"memory": True}, **options)


def storable(cls: type[T]) -> type[T]:
    """Decorates a dataclass so that `jaxrod.save` can store it, as it does pytrees."""
    STORABLE.add(cls)
    return cls


@dataclass_transform(
    frozen_default=True,
    eq_default=False,
    field_specifiers=(dataclasses.field, static, memory),
)
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass registered as a JAX pytree.

    Every field is a traced leaf (or subtree) unless it is declared with
    `static()`. Use `dataclasses.replace` to make a changed copy. Nothing is
    validated or converted on construction, because JAX also constructs pytrees
    from placeholders while it traces; factories validate instead.

    Example:
        >>> @extend.pytree
        ... class Spring:
        ...     stiffness: jax.Array
        ...     end: str = extend.static(default="tip")
        >>> jax.tree.leaves(Spring(2.0))  # the end is structure
        [2.0]
        >>> slope = jax.grad(lambda spring: spring.stiffness**2)(Spring(2.0))
        >>> float(slope.stiffness), slope.end
        (4.0, 'tip')
    """
    # A class with its own `__repr__` keeps it.
    own = "__repr__" in vars(cls)
    frozen: Any = dataclasses.dataclass(frozen=True, eq=False, repr=not own)(cls)
    names: tuple[list[str], list[str]] = [], []
    for field in dataclasses.fields(frozen):
        names[bool(field.metadata.get("static"))].append(field.name)
    traced, fixed = map(tuple, names)
    keys = [jax.tree_util.GetAttrKey(name) for name in traced]

    def flatten(tree: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return (
            [getattr(tree, name) for name in traced],
            tuple([getattr(tree, name) for name in fixed]),
        )

    def flatten_with_keys(tree: Any) -> tuple[Any, tuple[Any, ...]]:
        children, structure = flatten(tree)
        return list(zip(keys, children, strict=True)), structure

    def unflatten(structure: Any, children: Any) -> Any:
        return frozen(**dict(zip(traced + fixed, (*children, *structure), strict=True)))

    # Not `jax.tree_util.register_dataclass`: in JAX, at least up to 0.12, it makes the
    # structures of two classes with equally many fields equal, and a jitted function
    # may run the program that it compiled for the other class.
    jax.tree_util.register_pytree_with_keys(
        frozen, flatten_with_keys, unflatten, flatten
    )
    return storable(frozen)
