"""Check of the names of members that couplings give."""

from __future__ import annotations

from collections.abc import Iterable


def check_named(name: str, members: Iterable[str], where: str = "") -> None:
    """Raises a `ValueError` if no member has the given name.

    Args:
        name: The name.
        members: Names of all members.
        where: Name of the argument or caller, for the message.
    """
    known = list(members)
    if name not in known:
        raise ValueError(
            f"{where and where + ': '}no member is called {name!r}; there are "
            + ", ".join(map(repr, known))
        )
