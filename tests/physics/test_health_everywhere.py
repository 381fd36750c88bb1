"""Sound states are not flagged and unsound ones are, wherever and however seen."""

import functools
from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxrod
from physics.states import SOUND, UNSOUND
from physics.worlds import HERE, WORLDS

DT = 3e-4
FLAGS = ("stretch", "joint_angle", "speed", "spin", "norm", "violation", "energy")
UNITS = {
    "smallest_stretch": {},
    "largest_stretch": {},
    "largest_joint_angle": {},
    "largest_norm_error": {},
    "largest_violation": {},
    "largest_speed": {"length": 1, "time": -1},
    "largest_spin": {"time": -1},
}
examine = jax.jit(jaxrod.health)


def raised(report):
    flags = {name for name in FLAGS if getattr(report, name)}
    return flags if report.finite else flags | {"finite"}


@pytest.fixture(params=WORLDS)
def world(request, dtype):
    return replace(WORLDS[request.param], dtype=dtype.name)


@functools.cache
def made(case):
    return case()


def report(world, case, tie):
    rod, state, home = made(case)
    scene = jaxrod.make_scene(world.rod(rod), *tie(home, world))
    return examine(scene, world.state(state), world.cast(DT * world.time))


@pytest.mark.fast_sets(1)
def test_unsound_states_are_flagged(world):
    for name, (case, tie, flag) in UNSOUND.items():
        assert flag in raised(report(world, case, tie)), name


@pytest.mark.fast_sets(1)
def test_sound_states_are_not_flagged(world):
    for name, (case, tie) in SOUND.items():
        assert raised(report(world, case, tie)) == set(), name


@pytest.mark.fast_sets(1)
def test_the_numbers_are_the_same_everywhere(world):
    """To the rounding of coordinates, which 1 km away is a thousandth of an element."""
    tolerance = 1e-9
    if world.dtype == "float32":
        tolerance = 3e-3 if max(map(abs, world.shift)) == 1000 else 2e-4
    for name, (case, tie) in SOUND.items():
        seen, known = report(world, case, tie), report(HERE, case, tie)
        for number, powers in UNITS.items():
            np.testing.assert_allclose(
                getattr(seen, number) / world.unit(**powers),
                getattr(known, number),
                rtol=tolerance,
                atol=tolerance,
                err_msg=f"{number}, {name}",
            )
