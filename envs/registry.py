"""Registry of the built-in tasks; `make` imports a task when it is first needed."""

from __future__ import annotations

import dataclasses
import inspect
import weakref
from collections.abc import Callable, Mapping
from typing import Any

from jaxrod.envs.checking import check_facts
from jaxrod.envs.importing import canonical_path, import_callable
from jaxrod.envs.protocol import Environment
from jaxrod.envs.randomisation import Randomisation
from jaxrod.envs.randomised import Randomised
from jaxrod.spelling import meant_or_listed, nearest

_FACTORIES = {
    "catheter": "jaxrod.envs.tasks.catheter:catheter",
    "following": "jaxrod.envs.tasks.following:following",
    "gripper": "jaxrod.envs.tasks.gripper:gripper",
    "insert": "jaxrod.envs.tasks.insert:insert",
    "lift": "jaxrod.envs.tasks.lift:lift",
    "octopus": "jaxrod.envs.tasks.octopus:octopus",
    "reaching": "jaxrod.envs.tasks.reaching:reaching",
    "snake": "jaxrod.envs.tasks.snake:snake",
    "structured": "jaxrod.envs.tasks.structured_obstacles:structured_obstacles",
    "tracking": "jaxrod.envs.tasks.tracking:tracking",
    "trivial": "jaxrod.envs.trivial:Trivial",
    "unstructured": "jaxrod.envs.tasks.unstructured_nest:unstructured_nest",
}


@dataclasses.dataclass(frozen=True)
class Origin:
    """Arguments of `make` with which an environment was made."""

    task: str
    """Task as passed to `make`; the path of a file is made absolute."""
    options: Mapping[str, Any]
    """Options of `make` with non-default values, and always the variant."""


def names() -> tuple[str, ...]:
    """Returns the names of the built-in tasks, sorted.

    Example:
        >>> "tracking" in envs.names(), "unstructured" in envs.names()
        (True, True)
    """
    return tuple(sorted(_FACTORIES))


def make(
    task: str,
    /,
    *,
    randomise: Randomisation | Mapping[str, Any] | None = None,
    **options: Any,
) -> Environment:
    """Makes the environment of a task.

    Args:
        task: One of `names()`, or the import path of a callable of your own that
            returns an `Environment`: `"mypackage.mymodule:make_task"`, or
            `"folder/file.py:make_task"` for a file that imports nothing from its own
            folder.
        randomise: Distributions of parameters, and faults of actuators and sensors; or
            the same as a mapping, such as the contents of a TOML file. The environment
            is then a `jaxrod.envs.Randomised`.
        **options: Passed to the task's callable, for example `variant="paper"` for
            `"tracking"`.

    Raises:
        ValueError: There is no such task, it has no such option, it raises, or its
            result is not an environment; or `randomise` does not fit the task.

    Example:
        >>> env = envs.make("tracking", n_elements=10)
        >>> env.observation_size, env.action_size, env.episode_length
        (44, 12, 7142)
    """
    build = factory_of(task)
    chosen = _chosen(task, build, options)
    env = build(**options) if task in _FACTORIES else _made_by(task, build, options)
    if randomise is not None:
        given: Any = randomise
        record = given.record() if hasattr(given, "record") else given
        varied = Randomisation.from_record(record)
        env, chosen = Randomised(env, varied), chosen | {"randomise": varied.record()}
    _remember(env, Origin(task if task in _FACTORIES else canonical_path(task), chosen))
    return env


def factory_of(task: str) -> Callable[..., Any]:
    """Callable that makes the environment of a task.

    Raises:
        ValueError: There is no such task.
    """
    if task not in _FACTORIES and ":" not in task:
        listed = (
            f"task must be one of {', '.join(names())}, or the path of your own, "
            f"such as mypackage.mymodule:make_task; got {task!r}"
            + (f": add its class, {task}:NAME" if task.endswith(".py") else "")
        )
        meant = nearest(task, _FACTORIES)
        raise ValueError(
            f"there is no task {task!r}: did you mean {meant!r}?" if meant else listed
        )
    return import_callable(_FACTORIES.get(task, task))


def made(task: str | Environment, options: Mapping[str, Any]) -> Environment:
    """The given environment, or the one that `make` makes of a task with options.

    Raises:
        ValueError: There are options beside an environment, or `make` raises.
    """
    if isinstance(task, str):
        return make(task, **options)
    if options:
        raise ValueError(f"an environment takes no options, got {sorted(options)}")
    return task


def check_object(env: Any) -> None:
    """Raises unless `env` is an object, not the name or the class of one.

    Raises:
        ValueError: If it is; the message says what makes the object.
    """
    wanted = "an environment must be an object, got"
    if isinstance(env, str):
        raise ValueError(f"{wanted} {env!r}: jaxrod.envs.make({env!r}) makes it")
    if isinstance(env, type):
        raise ValueError(f"{wanted} the class {env!r}: {env.__name__}(...) makes it")


def origin_of(env: Environment) -> Origin | None:
    """Task and options with which `make` made an environment; None if it did not."""
    remembered, how = _MADE.get(id(env), (lambda: None, None))
    return how if remembered() is env else None


def options_of(task: str, build: type, env: Environment) -> dict[str, Any]:
    """Attributes of an environment that its class takes as options.

    Args:
        task: Import path of the class, for messages.
        build: The class.
        env: An instance of it.

    Returns:
        The options with non-default values, and always the variant.

    Raises:
        AttributeError: An argument of the class is no attribute of the instance.
        ValueError: The class has no signature.
    """
    known = inspect.signature(build).parameters.values()
    named = (
        one for one in known if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    )
    return _chosen(task, build, {one.name: getattr(env, one.name) for one in named})


_MADE: dict[int, tuple[Callable[[], Any], Origin]] = {}
"""Weak reference to each made environment, and its `Origin`, by `id(environment)`.

The key is the identity, because an equal environment may have been made with other
options, or without `make`.
"""


def _made_by(
    task: str, build: Callable[..., Any], options: Mapping[str, Any]
) -> Environment:
    """Calls a user's callable, and checks that the result is an environment.

    `build` is called with `options`; `task` is its import path, for messages.
    """
    try:
        env = build(**options)
        check_facts(env)
    except (ValueError, OSError, ImportError):
        raise
    except Exception as error:
        raise ValueError(f"{task} raised {type(error).__name__}: {error}") from error
    return env


def _remember(env: Environment, how: Origin) -> None:
    key = id(env)
    try:
        reference: Callable[[], Any] = weakref.ref(env, lambda _: _MADE.pop(key, None))
    except TypeError:  # Some classes allow no weak reference: keep them.
        reference = lambda: env
    _MADE[key] = (reference, how)


def _chosen(
    task: str, build: Callable[..., Any], options: Mapping[str, Any]
) -> dict[str, Any]:
    """Checks the names of options; returns the options with non-default values.

    Names and defaults are those of `build`, the callable of `task`. The variant is
    always included, because it identifies the physics.

    Raises:
        ValueError: There is no such option, or one is missing.
    """
    try:
        known = inspect.signature(build).parameters
    except (TypeError, ValueError):  # A callable written in C checks its own arguments.
        return dict(options)
    any_name = any(one.kind is one.VAR_KEYWORD for one in known.values())
    named = {
        name: one
        for name, one in known.items()
        if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)
    }
    for option in options:
        if option not in named and not any_name:
            has = f"it has {', '.join(named)}" if named else "it has none"
            listed = (
                f"{has}; numbers such as lengths and stiffnesses are in its "
                "parameters, env.default_params()"
            )
            raise ValueError(
                f"{task!r} has no option {option!r}, "
                f"{meant_or_listed(option, named, listed)}"
            )
    missing = [
        name
        for name, one in known.items()
        if one.default is one.empty
        and one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)
        and name not in options
    ]
    if missing:
        raise ValueError(f"{task!r} needs the option {' and '.join(missing)}")
    usual = {
        name: one.default for name, one in named.items() if one.default is not one.empty
    }
    return {
        name: value
        for name, value in (usual | dict(options)).items()
        if name == "variant" or name not in usual or not _same(value, usual[name])
    }


def _same(a: Any, b: Any) -> bool:
    """Whether two option values are identical, or equal and of the same type."""
    try:
        return a is b or (type(a) is type(b) and bool(a == b))
    except (TypeError, ValueError):  # For example an array.
        return False
