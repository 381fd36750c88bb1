"""Named arms are those of their drawings."""

import jax
import numpy as np
import pytest

import jaxrod
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


# Repository mohamad-nouredeen/tdcr-cosserat-robot-platform, experiments/README.md at
# commit e43787a41f07ccf8b91b0602c8223637304b6ca4: heights of the tip that were measured
# at pulls of the tendons 1, 2, 3 [mm], and the error of the makers' own model.
HEIGHTS = {5.0: (233.0, 235.0, 233.0), 10.0: (171.0, 168.0, 169.0)}
PUBLISHED_ERROR = 14.01


def heights_of_the_disk_robot(**numbers):
    """Heights of the tip [mm] at pulls of the first tendon by 5 and by 10 mm."""
    with jax.enable_x64(True):
        found = []
        for pull in HEIGHTS:
            scene, state = twin.disk_robot((1e-3 * pull, 0.0, 0.0), **numbers)
            rest = jaxrod.equilibrium(scene, state)
            found.append(1e3 * float(rest.state.tip[2]))
        return np.array(found)


def distance_from_measured(heights):
    return np.sqrt(np.mean((heights[:, None] - np.array([*HEIGHTS.values()])) ** 2))


@pytest.mark.slow
def test_the_disk_robot_is_as_near_to_its_measured_heights_as_its_makers_say():
    heights = heights_of_the_disk_robot()
    angles = np.array([*HEIGHTS]) / (1e3 * (7.00e-3 + 2 * 7.17e-3) / 3)
    np.testing.assert_allclose(heights, 250 * np.sin(angles) / angles, atol=0.5)
    assert distance_from_measured(heights) < PUBLISHED_ERROR
    # The distance of 6 mm in the makers' model is not that of the drawn disk.
    wrong = heights_of_the_disk_robot(distance=0.006)
    assert distance_from_measured(wrong) > PUBLISHED_ERROR
    soft = heights_of_the_disk_robot(youngs_modulus=3e10)
    np.testing.assert_allclose(soft, heights, atol=0.3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"pull": (1e-3, -1e-3, 0.0)}, "at least 0|non-negative"),
        ({"pull": (1e-3, 0.0)}, "shape"),
        ({"distance": 0.0}, "distance"),
        ({"youngs_modulus": -1.0}, "youngs_modulus"),
        ({"n_elements": 2}, "n_elements"),
    ],
)
def test_bad_numbers_of_the_disk_robot_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        twin.disk_robot(**arguments)
