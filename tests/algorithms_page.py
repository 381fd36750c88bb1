"""The tables of docs/algorithms.md, as the tests compare them with the code."""

from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "algorithms.md"
DIFFERENT = "What differs from the reference"
SAME = "What is as in the reference"
CLEAN_DIFFERENT = "What differs where obstacles are met in the library's physics"


def settings_rows(heading):
    """Rows about settings of the table under a heading, as lists of cells."""
    _, _, rest = PAGE.read_text().partition(f"\n## {heading}\n")
    assert rest, heading
    section, *_ = rest.partition("\n## ")
    rows = [
        [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        for line in section.splitlines()
        if line.startswith("| ") and "| `" in line
    ]
    assert rows, heading
    return rows


def both(left, right):
    """All pairs of what two cells list."""
    pairs = [(a, b) for a in left.split(", ") for b in right.split(", ")]
    assert len(set(pairs)) == len(pairs)
    return pairs
