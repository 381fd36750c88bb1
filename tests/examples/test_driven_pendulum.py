"""`examples/driven_pendulum.py`: upside down is stable above a frequency, not below."""

import pytest

from examples.loading import load

pendulum = load("driven_pendulum")


@pytest.mark.slow
@pytest.mark.parametrize(("share", "stands"), [(0.5, False), (1.6, True)])
def test_a_rod_shaken_fast_enough_stands_up(share, stands):
    tilt, energy, work = pendulum.simulate(share, seconds=0.5)
    gap = abs(work[-1] - (energy[-1] - energy[0]))
    assert gap < 2e-3 * (energy.max() - energy.min())
    assert (float(abs(tilt).max()) < 1.5 * pendulum.TILT) == stands
