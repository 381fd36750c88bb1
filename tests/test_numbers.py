"""README and the pages quote the numbers of the records."""

import json
import re
from functools import cache
from pathlib import Path

import pytest

from benchmarks.numbers.quotes import quotes
from benchmarks.numbers.quoting import Quote, differences, write
from benchmarks.numbers.records import at_least, digits, whole

ROOT = Path(__file__).parents[1]
QUOTES = quotes()


@cache
def text(page):
    return (ROOT / page).read_text()


def test_pages_quote_the_numbers_of_the_records():
    """`python -m benchmarks numbers --write` mends the pages after a measurement."""
    assert len(QUOTES) > 70
    assert "\n".join(differences(ROOT, QUOTES)) == ""


def test_each_row_of_numbers_in_the_readme_is_quoted_from_a_record():
    page = text("README.md")
    block = page.partition("<!-- numbers -->")[2].partition("<!-- end of numbers -->")
    pieces = [x for x in block[0].splitlines() if x.startswith("| ")][1:]
    pieces.append(block[0].rpartition("\n\nOn an NVIDIA")[2])
    ours = [quote for quote in QUOTES if quote.page == "README.md"]
    assert len(pieces) == 6
    assert [x for x in pieces if not any(quote.found(x) for quote in ours)] == []


def changed(number):
    """The number with another last digit."""
    places = [place.start() for place in re.finditer(r"\d", number)]
    if not places:
        return "two" if number != "two" else "three"
    last = places[-1]
    return f"{number[:last]}{(int(number[last]) + 1) % 10}{number[last + 1 :]}"


@pytest.mark.parametrize("page", sorted({quote.page for quote in QUOTES}))
def test_a_changed_number_is_seen_and_written_again(page):
    for quote in (quote for quote in QUOTES if quote.page == page):
        place = quote.found(text(page))
        for index, number in enumerate(quote.numbers):
            start, end = place.span(index + 1)
            other = text(page)[:start] + changed(number) + text(page)[end:]
            assert quote.difference(other)
            assert quote.written(other) == text(page)


def test_pages_are_written_from_the_records(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("An arm is 5 m\nlong, a rope nine.\n")
    said = [
        Quote("page.md", "An arm is {} m long", ("6.5",)),
        Quote("page.md", "a rope {}.", ("ten",)),
    ]
    assert [
        line.partition("its record: ")[2] for line in differences(tmp_path, said)
    ] == [
        "An arm is 6.5 m long",
        "a rope ten.",
    ]
    write(tmp_path, said)
    assert page.read_text() == "An arm is 6.5 m\nlong, a rope ten.\n"
    assert differences(tmp_path, said) == []


def test_a_sentence_that_is_not_there_or_there_twice_is_named(tmp_path):
    (tmp_path / "page.md").write_text("A rod is 5 m long.\nAn arm is 5 m\nlong.\n")
    said = [Quote("page.md", f"{x} is {{}} m long", ("5",)) for x in ("arm", "rope")]
    assert differences(tmp_path, said) == [
        "page.md does not have once: rope is {} m long"
    ]
    twice = Quote("page.md", "is {} m long", ("5",))
    assert differences(tmp_path, [twice]) == [
        "page.md does not have once: is {} m long"
    ]
    with pytest.raises(ValueError, match="has 1 places for 2 numbers"):
        Quote("page.md", "is {} m", ("5", "6"))


def test_numbers_are_written_as_pages_write_them():
    assert [digits(x) for x in (444.8, 0.35, 8.8, 12345)] == [
        "440",
        "0.35",
        "8.8",
        "12,000",
    ]
    assert [whole(838_708, 1000), whole(-79.6)] == ["839,000", "−80"]
    assert (at_least(10_703), at_least(0.0399)) == (10_000, pytest.approx(0.039))


def test_the_record_of_a_row_is_the_one_that_the_readme_names():
    """README's first row is the batch of 1024 rods in float32, in the default law."""
    record = json.loads(text("benchmarks/rod_steps/records/rod_steps.json"))
    (row,) = [
        row
        for row in record["rows"]
        if (row["batch"], row["dtype"], row["mode"]) == (1024, "float32", "consistent")
    ]
    ratio = row["rod_steps_per_s"] / record["pyelastica_steps_per_s"]
    assert ratio == pytest.approx(row["times_pyelastica"])
    millions = f"{row['rod_steps_per_s'] / 1e6:.1f} million per second"
    assert f"in a batch of 1024 rods | {millions}" in text("README.md")
