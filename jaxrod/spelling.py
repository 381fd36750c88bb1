"""Messages that name what was meant by a misspelt or guessed name."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import NoReturn

ALIKE = 0.66
"""Similarity by `difflib`, without case, above which a name counts as misspelt."""


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The public name that is spelt most like a name; `None` if none is like it."""
    # Only for a mistake: `import jaxrod` loads as little as possible.
    from difflib import get_close_matches

    by_lower_case = {one.lower(): one for one in known if not one.startswith("_")}
    meant = get_close_matches(name.lower(), by_lower_case, 1, ALIKE)
    return by_lower_case[meant[0]] if meant else None


def meant_or_listed(name: str, known: Iterable[str], listed: str) -> str:
    """A question for the name that was meant; a list if no name is like it.

    Args:
        name: Name that is not among the known ones.
        known: The known names.
        listed: Text for a name that is like none of them.
    """
    meant = nearest(name, known)
    return f"did you mean {meant!r}?" if meant else listed


def no_such_name(module: str, name: str) -> NoReturn:
    """`__getattr__` of a namespace, which answers with the name that was meant.

    Its `_GUESSES` has hints for names that users of other tools guess.

    Args:
        module: Import path of the namespace.
        name: Name that it does not have.

    Raises:
        AttributeError: Always raised.
    """
    space = vars(sys.modules[module])
    hint = space.get("_GUESSES", {}).get(name)
    # Python itself asks for names with underscores.
    meant = None if hint or name.startswith("_") else nearest(name, space["__all__"])
    if meant:
        hint = f"did you mean {module}.{meant}?"
    raise AttributeError(
        f"module {module!r} has no attribute {name!r}: "
        f"{hint or f'help({module}) lists the names'}"
    )
