"""The meanings of a dataclass's fields, read from its source."""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import Any


def field_meanings(kind: type) -> dict[str, str]:
    """The string under each field of a class and its bases, on one line.

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
    """Text of a statement that is a string; empty for any other statement."""
    if not isinstance(statement, ast.Expr):
        return ""
    value: Any = statement.value
    is_text = isinstance(value, ast.Constant) and isinstance(value.value, str)
    return value.value if is_text else ""
