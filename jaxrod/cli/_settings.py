"""Settings of an algorithm, as words on the command line: NAME=VALUE."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any


def configure(defaults: Any, stored: Mapping[str, Any], words: Sequence[str]) -> Any:
    """The configuration: defaults, then the stored settings, then NAME=VALUE words.

    Raises:
        ValueError: a name is unknown or a value is not of its kind.
    """
    known = {field.name for field in dataclasses.fields(defaults)}
    changes = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in stored.items()
        if name in known
    }
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise ValueError(f"--set needs NAME=VALUE, got {word!r}")
        if name not in known:
            raise ValueError(
                f"there is no setting {name!r}; there are {', '.join(sorted(known))}"
            )
        changes[name] = _parse(name, text, getattr(defaults, name))
    return dataclasses.replace(defaults, **changes)


def _parse(name: str, text: str, default: Any) -> Any:
    """Reads a value of the same kind as the default."""
    try:
        if isinstance(default, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(default, tuple):
            return tuple(int(part) for part in text.split(",") if part)
        if isinstance(default, int):
            return count(text)
        if isinstance(default, float):
            return float(text)
        return text
    except (ValueError, KeyError, argparse.ArgumentTypeError) as error:
        kinds = {
            "bool": "true or false",
            "tuple": "integers with commas between",
            "int": "an integer",
            "float": "a number",
        }
        kind = kinds[type(default).__name__]
        raise ValueError(f"{name} must be {kind}, got {text!r}") from error


def listing(defaults: Any) -> str:
    """Every setting with its default."""
    lines = []
    for field in dataclasses.fields(defaults):
        value = getattr(defaults, field.name)
        shown = ",".join(map(str, value)) if isinstance(value, tuple) else value
        lines.append(f"{field.name}={shown}")
    return "\n".join(lines)


def count(text: str) -> int:
    """Reads a count such as 300, 500k, 10M or 1e7.

    Raises:
        argparse.ArgumentTypeError: it is none; of all errors the one whose words
            argparse passes on.
    """
    sizes = {"k": 1_000, "M": 1_000_000, "G": 1_000_000_000}
    number, size = (text[:-1], sizes[text[-1]]) if text[-1:] in sizes else (text, 1)
    try:
        value = Decimal(number) * size  # In binary 4.1 million is no whole number.
        whole = int(value)
    except (ArithmeticError, ValueError):
        raise argparse.ArgumentTypeError(f"{text} is not a number") from None
    if value != whole:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number")
    return whole
