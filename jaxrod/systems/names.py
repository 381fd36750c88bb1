"""Members that couplings name: found, or refused in words."""

from __future__ import annotations

from collections.abc import Iterable


def check_named(name: str, members: Iterable[str], where: str = "") -> None:
    """Raises a `ValueError` if no member has a name.

    Args:
        name: The name.
        members: Names of all members.
        where: What asks, for the message.
    """
    known = list(members)
    if name not in known:
        raise ValueError(
            f"{where and where + ': '}no member is called {name!r}; there are "
            + ", ".join(map(repr, known))
        )
