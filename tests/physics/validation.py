"""A test's measured value and its bar: asserted here, tabulated in docs/validation.md.

`python -m benchmarks validation` runs the tests and collects what they recorded.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

Record = Callable[..., None]


@pytest.fixture
def record(record_property: Callable[[str, object], None]) -> Record:
    """Asserts that a measured value keeps its bar, and notes both down."""

    def check(
        feature: str,
        reference: str,
        measured: float,
        *,
        at_most: float | None = None,
        between: tuple[float, float] | None = None,
    ) -> None:
        low, high = (0.0, at_most) if between is None else between
        bar = f"≤ {at_most:g}" if between is None else f"{low:g} to {high:g}"
        record_property("validation", (feature, reference, float(measured), bar))
        assert low <= measured <= high, f"{feature}: {measured:.4g}, bar {bar}"

    return check
