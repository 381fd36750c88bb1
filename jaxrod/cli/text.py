"""Text from files and errors, made safe to print on a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    """One line of text, with control characters shown as escapes."""
    line = " ".join(text.split("\n"))
    return "".join(
        sign if sign.isprintable() else sign.encode("unicode_escape").decode()
        for sign in line
    )
