"""Named arms are those of their drawings."""

import numpy as np
import pytest

from jaxrod import twin


def test_the_tentacle_hangs_and_tapers_as_it_is_drawn():
    scene, state = twin.tentacle(n_elements=12)
    np.testing.assert_allclose(state.tip, (0, 0, -0.36), atol=1e-6)
    assert float(scene.rod.radii[0]) == pytest.approx(0.015, abs=5e-4)
    assert float(scene.rod.radii[-1]) == pytest.approx(0.0055, abs=5e-4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"tension": (1.0, -2.0)}, "at least 0|non-negative"),
        ({"tension": (1.0, 2.0, 3.0)}, "shape"),
        ({"n_elements": 2}, "n_elements"),
        ({"damping": -1.0}, "non-negative"),
    ],
)
def test_bad_numbers_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        twin.tentacle(**arguments)
