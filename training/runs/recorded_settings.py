"""Settings of a learner as JSON holds them, and back."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping
from typing import Any

import jax
import numpy as np

from jaxrod.files import UntrustedError
from jaxrod.training.import_path import find_object, import_path

KINDS: dict[type, str] = {
    bool: "true or false",
    tuple: "integers with commas between",
    int: "an integer",
    float: "a number",
    str: "text",
}
"""Kinds of settings in words."""
FUNCTION = "the import path of a function, module:NAME"
"""Settings that are functions, in words."""


def recorded(settings: Any) -> dict[str, Any]:
    """The settings of a learner, a dataclass, as `config.json` keeps them.

    Raises:
        ValueError: One is a function that no other process could find.
    """
    return {
        field.name: _recorded(field.name, getattr(settings, field.name))
        for field in dataclasses.fields(settings)
    }


def restored(
    defaults: Any, stored: Mapping[str, Any], trust: Collection[str] = ()
) -> Any:
    """Settings from what `config.json` keeps of them.

    Args:
        defaults: Settings of the learner; those that are not stored stay.
        stored: What was kept; what is no setting of the learner is left out.
        trust: Modules that may be imported because the file names them, see
            `jaxrod.envs.importing.check_trusted`; what is as by default needs none.

    Raises:
        ValueError: One is not of its kind.
        UntrustedError: One is a function that is not trusted.
        ImportError: A function is not found.
    """
    known = {field.name for field in dataclasses.fields(defaults)}
    return dataclasses.replace(
        defaults,
        **{
            name: _restored(name, value, getattr(defaults, name), trust)
            for name, value in stored.items()
            if name in known
        },
    )


def plain(value: Any) -> Any:
    """A value as JSON holds it; what JSON cannot hold stays what it is."""
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    arrays = (jax.Array, np.ndarray, np.generic)
    return value.tolist() if isinstance(value, arrays) else value


def is_function(default: Any) -> bool:
    """Whether a setting with this default is a function, or None for the usual one."""
    return default is None or callable(default)


def find_function(name: str, path: Any, trust: Collection[str] | None = None) -> Any:
    """The function that a setting names.

    Args:
        name: Of the setting.
        path: Its import path; None stands for itself.
        trust: For a path that a file holds, see `restored`; None for what the user
            names.

    Raises:
        ValueError: It is no import path, or not that of a function.
        UntrustedError: A file names it, and it is not trusted.
        ImportError: It is not found.
    """
    if path is None:
        return None
    if not isinstance(path, str):
        raise ValueError(f"{name} must be {FUNCTION}, got {path!r:.60}")
    try:
        found = find_object(path, trust)
    except UntrustedError as error:
        raise UntrustedError(f"{name}: {error}") from error
    except ValueError as error:
        raise ValueError(f"{name} must be {FUNCTION}: {error}") from error
    if not callable(found):
        raise ValueError(f"{name} must be {FUNCTION}, {path} is {found!r:.60}")
    return found


def _recorded(name: str, value: Any) -> Any:
    if not callable(value):
        return _checked(name, plain(value))
    path = import_path(value)
    if path is None:
        raise ValueError(
            f"{name} must be a function or class at the top level of a module that can "
            "be imported, so that the run can be resumed and evaluated, got "
            f"{value!r:.80}"
        )
    return path


def _checked(name: str, value: Any) -> Any:
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be a number, text, or a tuple of such, so that config.json "
            f"can hold it, got {value!r:.80}"
        ) from None
    return value


def _restored(name: str, value: Any, default: Any, trust: Collection[str]) -> Any:
    """A stored value, of the same kind as the default."""
    if is_function(default):
        usual = callable(default) and value == import_path(default)
        return default if usual else find_function(name, value, trust)
    kind = type(default)
    if kind is float and type(value) is int:
        return float(value)
    if kind is tuple and type(value) is list:
        value = tuple(value)
        kinds = {type(one) for one in default} or {int}
        fits = {type(one) for one in value} <= kinds
    else:
        fits = type(value) is kind
    if not fits:
        wanted = KINDS.get(kind, f"a {kind.__name__}")
        raise ValueError(f"{name} must be {wanted}, got {value!r:.60}")
    return value
