"""No value becomes another one on its way into a scene; none is refused wordlessly."""

import pytest

from extremes.factories import QUICK, all_cases, fault_of


def faults(labels):
    found = ((case, fault_of(case, wrong)) for case, wrong in all_cases(labels))
    return [f"{case}: {fault}" for case, fault in found if fault]


@pytest.mark.default_precision
def test_bad_and_extreme_values_are_refused_by_name_or_kept():
    assert not faults(QUICK)


@pytest.mark.slow
@pytest.mark.default_precision
def test_more_bad_and_extreme_values():
    assert not faults(None)
