"""Parsing of command line words: settings NAME=VALUE, counts and paths."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

from jaxrod.spelling import meant_or_listed

_WIDTH = 88
"""Width of the listing of settings [characters]."""
_USUAL = "default"
"""Word that stands for a setting that is None, such as the default network."""


def configure(
    defaults: Any,
    stored: Mapping[str, Any],
    words: Sequence[str],
    trust: Collection[str] = (),
) -> Any:
    """Returns the configuration from defaults, stored settings and NAME=VALUE words.

    A word takes precedence over a stored setting, and a stored setting over a default.

    Args:
        defaults: Default settings of the learner.
        stored: Settings from a file, by name.
        words: Settings that the user typed, whose modules are trusted.
        trust: Modules that may be imported because the file names them.

    Raises:
        ValueError: A name is unknown or a value has the wrong type.
        UntrustedError: A stored setting is a function that is not trusted.
    """
    from jaxrod.training.runs.recorded_settings import restored

    known = {field.name for field in dataclasses.fields(defaults)}
    settings = restored(defaults, stored, trust)
    changes = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise ValueError(f"--set needs NAME=VALUE, got {word!r}")
        if name not in known:
            listed = f"there are {', '.join(sorted(known))}"
            raise ValueError(
                f"there is no setting {name!r}: {meant_or_listed(name, known, listed)}"
            )
        changes[name] = _parse(name, text, getattr(defaults, name))
    return dataclasses.replace(settings, **changes)


def _parse(name: str, text: str, default: Any) -> Any:
    """Converts the text of a setting to a value of the same type as its default."""
    from jaxrod.training.runs.recorded_settings import KINDS, find_function, is_function

    if is_function(default):
        return find_function(name, None if text == _USUAL else text)
    try:
        if isinstance(default, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(default, tuple):
            kind = type(default[0]) if default else int
            return tuple(kind(part) for part in text.split(",") if part)
        if isinstance(default, int):
            return count(text)
        if isinstance(default, float):
            return float(text)
        return text
    except (ValueError, KeyError, argparse.ArgumentTypeError) as error:
        wanted = KINDS.get(type(default), f"a {type(default).__name__}")
        raise ValueError(f"{name} must be {wanted}, got {text!r:.60}") from error


def word_of(value: Any) -> str:
    """Text of a setting in the form that `--set` reads; not for functions."""
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def options(words: Sequence[str]) -> dict[str, Any]:
    """Returns the options of a task from NAME=VALUE words.

    A value is read as JSON or Python: a number, true, none or a list. Anything else is
    text.

    Raises:
        ValueError: A word is not of the form NAME=VALUE.
    """
    found = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or not name.isidentifier():
            raise ValueError(f"--option needs NAME=VALUE, got {word!r}")
        constants = {"true": True, "false": False, "none": None, "null": None}
        try:
            found[name] = constants.get(text.lower(), ast.literal_eval(text))
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            found[name] = constants.get(text.lower(), text)
    return found


def randomisation(file: Path) -> dict[str, Any]:
    """Reads a randomisation from a TOML file; returns its validated record.

    Raises:
        ValueError: The file is not TOML, or an option or a number is invalid.
        OSError: The file cannot be read.
    """
    from jaxrod.envs import Randomisation

    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
        return Randomisation.from_record(content).record()
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def listing(defaults: Any) -> str:
    """Lines NAME=DEFAULT MEANING for every setting, as `--set help` prints them."""
    from jaxrod.envs.importing import import_path
    from jaxrod.training.runs.recorded_settings import is_function

    meanings = field_meanings(type(defaults))
    rows = []
    for field in dataclasses.fields(defaults):
        value = getattr(defaults, field.name)
        shown = ",".join(map(str, value)) if isinstance(value, tuple) else value
        if is_function(value):
            shown = _USUAL if value is None else import_path(value) or value
        rows.append((f"{field.name}={shown}", meanings.get(field.name, "")))
    return _columns(rows)


def listing_of_options(build: Callable[..., Any]) -> str:
    """Lines NAME=DEFAULT MEANING for every option, as `--option help` prints them.

    Args:
        build: Callable that makes a task. Meanings are in the section `Args:` of its
            docstring, or of the docstring of its `__init__`, or follow its fields.
    """
    meanings = field_meanings(build) if isinstance(build, type) else {}
    for text in (build.__doc__, getattr(build.__init__, "__doc__", None)):
        meanings |= _argument_meanings(text or "")
    rows = []
    for one in inspect.signature(build).parameters.values():
        if one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD):
            continue
        usual = "" if one.default is one.empty else _option_word(one.default)
        rows.append((f"{one.name}={usual}", meanings.get(one.name, "")))
    return _columns(rows) if rows else "the task has no options"


def _option_word(value: Any) -> str:
    """Text of an option in the form that `--option` reads."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else str(value)


def _argument_meanings(docstring: str) -> dict[str, str]:
    """Descriptions of arguments in a docstring of Google's style, by name."""
    _, _, after = inspect.cleandoc(docstring).partition("Args:\n")
    section = re.split(r"^\S", after, maxsplit=1, flags=re.MULTILINE)[0]
    entries = re.split(
        r"^ {4}\*{0,2}(\w+)(?: \([^)]*\))?: ", section, flags=re.MULTILINE
    )
    return {
        name: " ".join(text.split())
        for name, text in zip(entries[1::2], entries[2::2], strict=True)
    }


def _columns(rows: Sequence[tuple[str, str]]) -> str:
    """Lines with a setting and its meaning, which is wrapped below itself."""
    width = max(len(setting) for setting, _ in rows) + 2
    lines = [
        textwrap.wrap(
            f"{setting:<{width}}{meaning}",
            _WIDTH,
            subsequent_indent=" " * width,
            drop_whitespace=True,
        )
        for setting, meaning in rows
    ]
    return "\n".join(itertools.chain.from_iterable(lines))


def count(text: str) -> int:
    """Reads a count such as 300, 500k, 10M or 1e7.

    Raises:
        argparse.ArgumentTypeError: The text is not a count. Argparse shows only the
            messages of this error type.
    """
    sizes = {"k": 1_000, "M": 1_000_000, "G": 1_000_000_000}
    number, size = (text[:-1], sizes[text[-1]]) if text[-1:] in sizes else (text, 1)
    shown = f"{text:.40}"
    try:
        value = Decimal(number)  # In binary 4.1 million is no whole number.
        if value.is_finite() and value.adjusted() > _DIGITS:
            raise argparse.ArgumentTypeError(f"{shown} is too large")
        value *= size
        whole = int(value)
    except (ArithmeticError, ValueError):
        raise argparse.ArgumentTypeError(f"{shown} is not a number") from None
    if value != whole:
        raise argparse.ArgumentTypeError(f"{shown} is not a whole number")
    return whole


_DIGITS = 30
"""Largest decimal exponent of a count."""


def path(text: str) -> Path:
    """Reads the path of a file or folder.

    Raises:
        argparse.ArgumentTypeError: The text is empty. An empty path usually comes from
            an unset variable of the shell, and would mean the current folder.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError(f"must name a file or folder, got {text!r}")
    return Path(text)


def field_meanings(kind: type) -> dict[str, str]:
    """Docstrings of the fields of a class and its bases, by field, each on one line.

    Python keeps no docstrings of fields, so they are read from the source. A class
    without source (typed into an interpreter) has none.
    """
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        found |= _own_meanings(base)
    return found


def _own_meanings(kind: type) -> dict[str, str]:
    try:
        source = textwrap.dedent(inspect.getsource(kind))
    except (OSError, TypeError):
        return {}
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    pairs = zip(definition.body, definition.body[1:], strict=False)
    return {
        before.target.id: " ".join(text.split())
        for before, after in pairs
        if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name)
        if (text := _text(after))
    }


def _text(statement: ast.stmt) -> str:
    """Text of a statement that is only a string; empty for other statements."""
    if not isinstance(statement, ast.Expr):
        return ""
    value: Any = statement.value
    is_text = isinstance(value, ast.Constant) and isinstance(value.value, str)
    return value.value if is_text else ""
