"""Programs made at random: lanes and XLA come to the same numbers."""

import pytest
from lanes.programs import difference


@pytest.mark.parametrize("seed", range(6))
def test_a_random_program_is_the_same_by_lanes(seed):
    worst, _ = difference(seed)
    assert worst is not None and worst <= 1


@pytest.mark.slow
def test_many_random_programs_are_the_same_by_lanes(record):
    found = [difference(seed)[0] for seed in range(1000, 1300)]
    assert all(worst is not None for worst in found)
    record(
        "lanes: random programs",
        "XLA; differences beyond rounding, of 300",
        sum(worst > 1 for worst in found),
        at_most=0,
    )
