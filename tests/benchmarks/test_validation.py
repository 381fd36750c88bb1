"""The page of validation: rows of runs, and sections of earlier ones that stay."""

import pytest

from benchmarks.validation import run as validation

RUN = """<testsuites><testsuite>
<testcase file="tests/physics/test_time.py" name="a" line="3"><properties>
<property name="validation" value="('Sine', '2', 2.01, '1.9 to 2.1')"/>
</properties></testcase>
<testcase file="tests/physics/test_words.py" name="b" line="1"/>
<testcase file="tests/cli/test_help.py" name="c" line="1"/>
</testsuite></testsuites>"""
EARLIER = """# Validation

All 7 tests passed.

## Time

| Feature | Reference | Measured | Limit |
|---|---|---:|---:|
| Sine | 2 | 1.95 | 1.9 to 2.1 |

## Actuation

| Feature | Reference | Measured | Limit |
|---|---|---:|---:|
| Spline | scipy | 1e-15 | ≤ 1e-12 |

## A file that is gone

| Feature | Reference | Measured | Limit |
|---|---|---:|---:|
| Old | 0 | 1e-15 | ≤ 1e-12 |
"""


def test_sections_without_new_rows_stay_in_the_order_of_the_files(tmp_path):
    run = tmp_path / "run.xml"
    run.write_text(RUN)
    rows = validation.Rows()
    rows.kept = validation.sections(EARLIER)
    rows.read([run])
    text = "\n".join(rows.text())
    assert "All 2 tests passed. Sections of earlier runs: 1." in text
    assert text.index("## Actuation") < text.index("## Time")
    assert "| Sine | 2 | 2.01 | 1.9 to 2.1 |" in text and "1.95" not in text
    assert "| Spline | scipy | 1e-15 | ≤ 1e-12 |\n" in text
    assert "gone" not in text
    again = validation.Rows()
    again.kept = validation.sections(text)
    again.read([run])
    assert "\n".join(again.text()) == text


def test_the_page_has_no_section_twice_and_none_without_its_file():
    text = (validation.ROOT / "docs" / "validation.md").read_text()
    titles = [line[3:] for line in text.splitlines() if line.startswith("## ")]
    assert sorted(titles) == sorted(validation.in_order(titles))


def test_runs_of_other_tests_are_refused(tmp_path):
    run = tmp_path / "run.xml"
    run.write_text("<testsuites/>")
    with pytest.raises(ValueError, match="no test of"):
        validation.Rows().read([run])
