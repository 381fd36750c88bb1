"""The comparison of rows with XLA: it sees differences, and its record has none."""

import json

import numpy as np
import pytest

from lanes.equality import (
    CHAOTIC,
    GRADIENT,
    RECORD,
    STATE,
    Programs,
    all_names,
    compared,
    equal,
    nudged,
    read,
    states_apart,
)


def test_a_difference_is_seen():
    one = {"rod": {"positions": np.full((3, 2), 2.0), "spins": np.zeros(3)}}
    other = {"rod": {"positions": np.full((3, 2), 2.0), "spins": np.zeros(3)}}
    assert states_apart(one, other, one)[0] == 0
    other["rod"]["positions"][1, 1] += 1e-9
    apart, where = states_apart(other, one, one)
    assert apart == pytest.approx(5e-10, rel=1e-6) and "positions" in where
    other["rod"]["positions"][1, 1] = np.nan
    assert states_apart(other, one, one)[0] == np.inf


def test_a_nudge_is_one_unit_in_the_last_place_or_two_by_rounding():
    state = {"positions": np.linspace(1, 1.9, 7), "count": np.arange(3)}
    off = nudged(state, 0)
    np.testing.assert_array_equal(off["count"], state["count"])
    apart = np.abs(np.asarray(off["positions"]) - state["positions"])
    assert set(apart / 2.0**-52) <= {1, 2}


def test_what_differs_is_called_so():
    line = {"what": "scene", "apart": 3 * STATE, "one_ulp": STATE / 300}
    assert not equal(line)
    assert equal(line | {"one_ulp": STATE})
    assert not equal({"apart": 0.0, "one_ulp": 0.0, "gradient": 2 * GRADIENT})


def test_the_record_has_no_difference():
    lines = read(RECORD)
    for what in ("scene", "system"):
        own = [x for x in lines if x["what"] == what and "apart" in x]
        own = [x for x in own if x["one_ulp"] <= CHAOTIC]
        assert len(own) >= 100
        assert all(map(equal, own))
        assert {name for x in own for name in x["names"]} == all_names(what)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["scene", "system"])
def test_the_record_is_made_again(what):
    """Its first line, to rounding."""
    line = next(x for x in read(RECORD) if x["what"] == what and "apart" in x)
    programs = Programs("rows"), Programs("never")
    again = compared(what, line["seed"], line["draw"], programs, slopes=False)
    assert equal(json.loads(json.dumps(again))) and again["left"] == line["left"]
