"""`nest_speed` finds its nest and measures it."""

import re

import pytest

from benchmarks.nest_speed import run as nest_speed
from benchmarks.shared.files import example


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_small_nest_is_measured(capsys):
    cost = nest_speed.measure(example("nest"), 10, 2)
    assert 0 < cost < 1
    assert re.match(
        r" +10 rods +80 elements: .* flagged False\n", capsys.readouterr()[0]
    )
