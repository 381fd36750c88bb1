"""Conversion of a learner's settings to the JSON of `config.json` and back."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping
from typing import Any

import jax
import numpy as np

from jaxrod.envs.importing import find_object, import_path
from jaxrod.files import UntrustedError

KINDS: dict[type, str] = {
    bool: "true or false",
    tuple: "integers with commas between",
    int: "an integer",
    float: "a number",
    str: "text",
}
"""Descriptions of the values of a setting by the type of its default, for messages."""
FUNCTION = "the import path of a function, module:NAME"
"""Description of the value of a setting that is a function, for messages."""


def recorded(settings: Any) -> dict[str, Any]:
    """Settings of a learner by name, as JSON values; functions as import paths.

    Raises:
        ValueError: A setting is a function that another process could not find, or a
            value that JSON cannot hold.
    """
    return {
        field.name: _recorded(field.name, getattr(settings, field.name))
        for field in dataclasses.fields(settings)
    }


def restored(
    defaults: Any, stored: Mapping[str, Any], trust: Collection[str] = ()
) -> Any:
    """Settings of a learner restored from `config.json`.

    Args:
        defaults: Default settings of the learner, used for settings that are not
            stored.
        stored: Stored settings; entries that are not settings of the learner are
            ignored.
        trust: Modules that may be imported because the file names them, see
            `jaxrod.envs.importing.check_trusted`; default values need none.

    Raises:
        ValueError: A setting has the wrong type.
        UntrustedError: A setting is a function that is not trusted.
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
    """Converts arrays to numbers or lists, and tuples to lists, at any depth."""
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    arrays = (jax.Array, np.ndarray, np.generic)
    return value.tolist() if isinstance(value, arrays) else value


def is_function(default: Any) -> bool:
    """Whether a setting with this default is a function or None."""
    return default is None or callable(default)


def find_function(name: str, path: Any, trust: Collection[str] | None = None) -> Any:
    """Imports the function that a setting names.

    Args:
        name: Name of the setting.
        path: Import path of the function; None returns None.
        trust: Trusted modules if the path was read from a file, see `restored`; None if
            the user typed the path.

    Raises:
        ValueError: `path` is not an import path, or its object is not a function.
        UntrustedError: The path was read from a file and its module is not trusted.
        ImportError: The function is not found.
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
        raise ValueError(f"{name} must be {FUNCTION}, but {path} is {found!r:.60}")
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
            f"{name} must be a number, text, or a tuple of these, so that config.json "
            f"can hold it, got {value!r:.80}"
        ) from None
    return value


def _restored(name: str, value: Any, default: Any, trust: Collection[str]) -> Any:
    """Converts a JSON value to a setting, which must have the type of the default."""
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
