"""The numbers that README and the pages quote, from their records."""

from __future__ import annotations

from benchmarks.numbers import claims, learning, speed, tasks
from benchmarks.numbers.quoting import Quote


def quotes() -> list[Quote]:
    """All quotes."""
    return [*speed.quotes(), *learning.quotes(), *tasks.quotes(), *claims.quotes()]
