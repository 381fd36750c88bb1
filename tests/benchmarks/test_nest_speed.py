"""`benchmarks/nest_speed.py` finds its nest and measures it."""

import re

import pytest

from benchmarks import nest_speed


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_small_nest_is_measured(capsys):
    cost = nest_speed.measure(nest_speed.example(), 10, 2)
    assert 0 < cost < 1
    assert re.match(
        r" +10 rods +80 elements: .* flagged False\n", capsys.readouterr()[0]
    )
