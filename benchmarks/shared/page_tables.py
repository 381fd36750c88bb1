"""Tables of a page, between the marks that name them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from jaxrod.files import write_atomically
from jaxrod.installation.machine import processor_and_versions


def measured_table(
    page: Path, table: str, head: str, rows: Callable[[], Iterable[str]], *, dry: bool
) -> None:
    """Measures a table, prints it row by row, and writes it into its page.

    Args:
        page: The page.
        table: Its name, in `<!-- name -->` and `<!-- end name -->`.
        head: Its first two lines.
        rows: Measures the others.
        dry: Whether to leave the page as it is.
    """
    lines = []
    print(head, flush=True)
    for line in rows():
        print(line, flush=True)
        lines.append(line)
    if dry:
        return
    begin, end = f"<!-- {table} -->\n", f"<!-- end {table} -->"
    before, rest = page.read_text().split(begin)
    _, after = rest.split(end)
    machine = f"Measured on: {processor_and_versions()}."
    body = "\n".join([head, *lines, "", machine, ""])
    write_atomically(page, (before + begin + body + end + after).encode())
