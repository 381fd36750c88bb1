"""Checks of a user's own environments, actions and names, with clear messages."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxrod.effects.own_classes import remedy
from jaxrod.envs.protocol import Environment, Snapshot

_COUNTS = ("observation_size", "action_size", "episode_length")
_METHODS = ("default_params", "reset", "step")
_WORDS: dict[Any, str] = {jnp.floating: "floats", jnp.bool_: "bool"}


def check_facts(env: Any) -> None:
    """Checks the attributes of an environment, without computing anything.

    Raises:
        ValueError: It lacks something that `Environment` requires.
    """
    kind = type(env).__name__
    if isinstance(env, type):
        raise ValueError(f"an environment must be an object, got the class {env!r}")
    lacking = [name for name in ("name", *_COUNTS) if not hasattr(env, name)]
    lacking += [
        f"{name}()" for name in _METHODS if not callable(getattr(env, name, None))
    ]
    if lacking:
        raise ValueError(
            "an environment must have what jaxrod.envs.Environment asks for, got "
            f"{_a(kind)} without {', '.join(lacking)}"
        )
    if not isinstance(env.name, str):
        raise ValueError(f"name of {_a(kind)} must be text, got {env.name!r:.60}")
    for name in _COUNTS:
        value = getattr(env, name)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ValueError(
                f"{name} of {env.name} must be a positive integer, got {value!r:.60}"
            )
    try:
        hash(env)
    except TypeError as error:
        raise ValueError(
            f"{env.name} must be hashable, for example a frozen dataclass: {error}"
        ) from None


def check_environment(env: Environment) -> None:
    """Checks the results of an environment by tracing it, without computing a step.

    Args:
        env: The environment.

    Raises:
        ValueError: The results are not what `Environment` promises, or a method raises,
            with that exception as the cause.

    Example:
        >>> env = envs.make("trivial")
        >>> envs.check_environment(env)
        >>> envs.check_environment(replace(env, observation_size=2))
        Traceback (most recent call last):
            ...
        ValueError: the observation of reset of trivial must be an array of ...
    """
    check_facts(env)
    params = _called("default_params", env, env.default_params)
    key = jax.eval_shape(lambda: jax.random.key(0))
    started = _traced("reset", env, env.reset, key, params)
    _check_parts("reset", env, started, ("observation", "state"))
    observation, state = started
    _check_array("the observation of reset", env, observation, (env.observation_size,))
    action = jax.ShapeDtypeStruct((env.action_size,), jnp.result_type(float))
    stepped = _traced("step", env, env.step, key, state, action, params)
    parts = ("observation", "state", "reward", "terminated", "truncated", "info")
    _check_parts("step", env, stepped, parts)
    observation, after, reward, terminated, truncated, info = stepped
    _check_array("the observation of step", env, observation, (env.observation_size,))
    _check_array("the reward", env, reward, ())
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        _check_array(name, env, flag, (), jnp.bool_)
    _check_same_state(env, state, after)
    if not isinstance(info, dict):
        raise ValueError(f"info of {env.name} must be a dict, got {_kind(info)}")
    for name, value in info.items():
        _check_array(f"info[{name!r}]", env, value, (), None)
    if callable(getattr(env, "snapshot", None)):
        drawn: Any = env
        seen = _traced("snapshot", env, drawn.snapshot, state, params)
        if not isinstance(seen, Snapshot):
            raise ValueError(
                f"snapshot of {env.name} must return a jaxrod.envs.Snapshot, "
                f"got {_kind(seen)}"
            )


def _called(
    name: str, env: Environment, method: Callable[..., Any], *given: Any
) -> Any:
    try:
        return method(*given)
    except Exception as error:
        said = str(error).strip().partition("\n")[0].rstrip(".")
        raise ValueError(
            f"{name} of {env.name} raised {type(error).__name__}: {said}"
            f"{_remedy(error)}"
        ) from error


def _remedy(error: Exception) -> str:
    """Advice to append to a JAX error that does not say what to change, or ""."""
    if "not a valid JAX type" in str(error):
        return (
            ". Return arrays, and a state as a pytree of them: `@jaxrod.extend.pytree` "
            "makes one of a class"
        )
    return remedy(error)


def _traced(
    name: str, env: Environment, method: Callable[..., Any], *given: Any
) -> Any:
    return _called(name, env, jax.eval_shape, method, *given)


def _check_parts(
    name: str, env: Environment, value: Any, parts: tuple[str, ...]
) -> None:
    if not isinstance(value, tuple) or len(value) != len(parts):
        count = f" of {len(value)}" if isinstance(value, tuple) else ""
        raise ValueError(
            f"{name} of {env.name} must return ({', '.join(parts)}), "
            f"got {_kind(value)}{count}"
        )


def _check_array(
    name: str,
    env: Environment,
    value: Any,
    shape: tuple[int, ...],
    kind: Any = jnp.floating,
) -> None:
    got: Any = _kind(value)
    fits = isinstance(value, jax.ShapeDtypeStruct) and value.shape == shape
    if isinstance(value, jax.ShapeDtypeStruct):
        got = f"{value.dtype} of shape {value.shape}"
        fits = fits and (kind is None or jnp.issubdtype(value.dtype, kind))
    if not fits:
        wanted = "" if kind is None else f" of {_WORDS[kind]}"
        raise ValueError(
            f"{name} of {env.name} must be an array{wanted} of shape {shape}, got {got}"
        )


def _check_same_state(env: Environment, before: Any, after: Any) -> None:
    was: Any = jax.tree.structure(before)
    now: Any = jax.tree.structure(after)
    if was != now:
        raise ValueError(
            f"step of {env.name} must return a state like that of reset, "
            f"{was}, got {now}"
        )
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    for (path, a), b in pairs:
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            raise ValueError(
                f"step of {env.name} must return a state like that of reset: "
                f"state{jax.tree_util.keystr(path)} was {a.dtype} of shape {a.shape}, "
                f"and becomes {b.dtype} of shape {b.shape}"
            )


def _kind(value: Any) -> str:
    return _a(type(value).__name__)


def _a(word: str) -> str:
    return f"{'an' if word[:1] in 'AEIOUaeiou' else 'a'} {word}"


def check_key(key: Any) -> None:
    """Raises unless `key` may be a random key.

    Raises:
        TypeError: If it is a number, `None` or anything else without bits of a key.
    """
    dtype = getattr(key, "dtype", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    # Raw keys have two numbers, or four with the generators "rbg" and "unsafe_rbg".
    if typed or (dtype == jnp.uint32 and np.shape(key)[-1:] in ((2,), (4,))):
        return
    seed = key if isinstance(key, int) and not isinstance(key, bool) else 0
    raise TypeError(
        f"key must be a random key, such as jax.random.key({seed}), got {key!r}"
    )


def action_of_size(action: ArrayLike, size: int) -> Array:
    """Returns the action as an array, after a check that its shape is `(size,)`.

    Raises:
        ValueError: If the shape differs: broadcasting the action would drive actuators
            that the caller did not intend.
    """
    check_action_shape("action", action, (size,))
    return jnp.asarray(action)


def check_action_shape(name: str, given: Any, shape: tuple[int, ...]) -> None:
    """Raises unless an array from the caller has the expected shape.

    Callers that add a batch axis check first, so that the message describes the user's
    own array.

    Args:
        name: "action" for one environment, "actions" for several.
        given: Array from the caller.
        shape: Expected shape, `(action_size,)` or `(num_envs, action_size)`.

    Raises:
        ValueError: If the shapes differ; the message shows both.
    """
    found = np.shape(given)
    if found == shape:
        return
    hint = ""
    if len(shape) == 1 and len(found) > 1:
        hint = "; a batch of environments is jax.vmap of step"
    raise ValueError(f"{name} must have shape {shape}, got {found}{hint}")


def check_variant(variant: str, variants: Collection[str]) -> None:
    """Raises a ValueError unless `variant` is one of `variants`."""
    if variant not in variants:
        known = ", ".join(variants)
        raise ValueError(f"variant must be one of {known}; got {variant!r}")


def dotted(path: Any) -> str:
    """Dotted path of a leaf, from a path as JAX returns them."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def by_path(tree: Any) -> dict[str, Any]:
    """Leaves of a pytree by their dotted paths."""
    return {dotted(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}


def is_below(path: str, above: str) -> bool:
    """Whether a path is `above`, or leads to something inside it."""
    return f"{path}.".startswith(f"{above}.")


def nearest(path: str, known: Iterable[str]) -> str:
    """Up to five known paths that are inside a path, or spelt like it, as text."""
    names = list(known)
    inside = [name for name in names if is_below(name, path)]
    return ", ".join((inside or difflib.get_close_matches(path, names, 5, 0.0))[:5])
