"""Sentences and rows of pages that quote numbers, and how they are compared."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from jaxrod.files import write_atomically

WORDS = "zero one two three four five six seven eight nine ten eleven twelve".split()
"""Small numbers as they are written in sentences."""
NUMBER = (
    r"(?<![\d.,])([-−+]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?"
    rf"|{'|'.join(WORDS)})(?!\d|[.,]\d)"
)
"""A whole number, and not a part of one."""


@dataclass(frozen=True)
class Quote:
    """A piece of a page, with `{}` in place of each number.

    Attributes:
        page: Path in the checkout.
        text: The piece; it may be broken over lines in another way on the page.
        numbers: The numbers of the record, as the page has to write them.
    """

    page: str
    text: str
    numbers: tuple[str, ...]

    def __post_init__(self) -> None:
        """Checks that there is a place for each number."""
        if self.text.count("{}") != len(self.numbers):
            raise ValueError(
                f"{self.text!r} has {self.text.count('{}')} places for "
                f"{len(self.numbers)} numbers"
            )

    def found(self, page: str) -> re.Match[str] | None:
        """The only place of the page that has this piece, with any numbers."""
        words = [re.escape(word) for word in self.text.split()]
        pattern = r"\s+".join(words).replace(re.escape("{}"), NUMBER)
        places = list(re.finditer(pattern, page))
        return places[0] if len(places) == 1 else None

    def difference(self, page: str) -> str:
        """The difference of the page from the record; empty if there is none."""
        place = self.found(page)
        if place is None:
            return f"{self.page} does not have once: {self.text}"
        if place.groups() == self.numbers:
            return ""
        said = " ".join(place[0].split())
        record = self.text.format(*self.numbers)
        return f"{self.page} says: {said}\n    its record: {record}"

    def written(self, page: str) -> str:
        """The page with the numbers of the record, if it has this piece."""
        place = self.found(page)
        if place is None:
            return page
        # From the last to the first, so that places stay where they are.
        for index in reversed(range(len(self.numbers))):
            start, end = place.span(index + 1)
            page = page[:start] + self.numbers[index] + page[end:]
        return page


def differences(root: Path, quotes: Iterable[Quote]) -> list[str]:
    """Differences of the pages of a checkout from the records."""
    found = (quote.difference(_read(root / quote.page)) for quote in quotes)
    return [difference for difference in found if difference]


def write(root: Path, quotes: Iterable[Quote]) -> None:
    """Writes the numbers of the records into the pages of a checkout."""
    for quote in quotes:
        page = _read(root / quote.page)
        written = quote.written(page)
        if written != page:
            write_atomically(root / quote.page, written.encode())


def _read(file: Path) -> str:
    return file.read_text(encoding="utf-8")
