"""A test that is skipped for a reason that is not listed counts as failed."""

from types import SimpleNamespace

import pytest

from conftest import MAY_BE_SKIPPED, refused_skip


def skipped(reason):
    """A report of a skipped test, as pytest makes it."""
    where = ("test_it.py", 1, f"Skipped: {reason}")
    return SimpleNamespace(skipped=True, longrepr=where, outcome="skipped")


@pytest.mark.parametrize("reason", MAY_BE_SKIPPED)
def test_a_listed_skip_stays_one(reason):
    assert refused_skip(skipped(f"{reason} here")).outcome == "skipped"


@pytest.mark.parametrize(
    "reason",
    ["llvmlite is not installed", "jaxlib's header has another layout", ""],
)
def test_any_other_skip_is_a_failure_that_says_why(reason):
    report = refused_skip(skipped(reason))
    assert report.outcome == "failed" and f"({reason})" in report.longrepr
