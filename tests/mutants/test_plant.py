"""Faults are found, change what they should, and the named ones are still there."""

import ast
import random
from pathlib import Path

import pytest

from mutants import __main__ as program
from mutants.drawing import all_faults, drawn, room, shares
from mutants.mutations import faults
from mutants.named import NAMED
from mutants.record import Row, counts, read, write
from mutants.tests_for import Likely

ROOT = Path(__file__).parents[2]

SOURCE = '''"""Text: 1 + 2 < 3."""
from somewhere import vectors

MOST = 4
SHARE = 0.5


def moved(a: Float[Array, "3 n"], b=2):
    """The change of `3 - 4`."""
    if b < 0:
        raise ValueError(f"b must be {1 + 2} or more")
    assert b > 1
    way = vectors.add(a[0], -b * a[1])
    if b == 3:
        way = max(way, 0.0)
    return way - (SHARE + b)


def check_that(a):
    return a > 3


class Thing:
    size: int = 7

    def __repr__(self):
        return "x" * 3
'''


def test_what_is_no_text_and_no_limit_is_changed():
    found = [(SOURCE[f.start : f.end], f.new, f.kind) for f in faults(SOURCE)]
    assert set(found) == {
        ("0.5", "(2 * 0.5)", "number"),
        ("add", "subtract", "operator"),
        ("vectors.add(a[0], -b * a[1])", "a[0]", "dropped term"),
        ("0", "(1)", "index"),
        ("0", "(-1)", "index"),
        ("-", "", "sign"),
        ("*", "/", "operator"),
        ("1", "(2)", "index"),
        ("1", "(0)", "index"),
        ("==", "!=", "comparison"),
        ("3", "4", "number"),
        ("max", "min", "min and max"),
        ("0.0", "1.0", "number"),
        ("-", "+", "operator"),
        ("- (SHARE + b)", "", "dropped term"),
        ("+", "-", "operator"),
        ("+ b", "", "dropped term"),
    }
    for fault in faults(SOURCE):
        tree = ast.dump(ast.parse(fault.planted(SOURCE)))
        assert tree != ast.dump(ast.parse(SOURCE))
        assert fault.function in ("moved", "")


def test_every_room_has_faults_that_change_its_sources():
    rooms = all_faults(ROOT)
    assert {"jaxrod/systems", "envs/tasks", "training/algorithms"} <= set(rooms)
    chooser = random.Random(0)
    for found in rooms.values():
        for file, fault in chooser.sample(found, min(2, len(found))):
            source = (ROOT / file).read_text()
            tree = ast.parse(fault.planted(source))
            assert ast.dump(tree) != ast.dump(ast.parse(source))


def test_draws_are_those_of_the_seed_and_spread_over_rooms():
    one, again, other = (drawn(ROOT, 60, seed) for seed in (1, 1, 2))
    assert one == again and one != other
    assert len({(d.file, d.fault.function) for d in one}) == len(one) == 60
    sizes = {name: len(found) for name, found in all_faults(ROOT).items()}
    total = sum(sizes.values())
    for name, size in sizes.items():
        made = sum(room(d.file) == name for d in one)
        assert abs(made - 60 * size / total) < 1
    assert shares({"a": 1, "b": 6, "c": 3}, 2) == {"a": 0, "b": 1, "c": 1}


@pytest.mark.parametrize("own", NAMED, ids=lambda own: own.name)
def test_every_named_fault_stands_once_and_changes_its_source(own):
    source = (ROOT / own.file).read_text()
    assert source.count(own.old) == 1
    changed = ast.parse(source.replace(own.old, own.new))
    assert ast.dump(changed) != ast.dump(ast.parse(source))
    assert all((ROOT / test).exists() for test in own.tests)


def test_a_named_fault_that_is_gone_is_an_error_in_words(monkeypatch):
    gone = type(NAMED[0])("m99", "a thing", NAMED[0].file, "no such text", "", ())
    monkeypatch.setattr(program, "NAMED", (gone,))
    with pytest.raises(ValueError, match="m99, a thing: its text stands 0 times in"):
        program.trials(ROOT, 1, 1)


@pytest.mark.slow
def test_files_that_speak_of_a_module_come_first():
    likely = Likely(ROOT)
    assert (
        likely.first("jaxrod/systems/joints/glue.py")[0] == "tests/systems/test_glue.py"
    )
    # What no test names is reached by what stands on it.
    assert "tests/control/test_ilqr.py" in likely.first(
        "jaxrod/control/trajectories/ilqr.py"
    )


def test_a_record_is_read_as_it_was_written(tmp_path):
    rows = [
        Row("d02", "b.py:3", "sign: `-` -> `` in `-x`", "survived", "nothing"),
        Row("d01", "a.py:1", "number: `1` -> `2` in `1`", "killed", "`t.py::test`"),
        Row("m01", "c.py:9", "a ring", "equivalent", "it is even"),
    ]
    path = tmp_path / "record.md"
    write(path, rows, 1, 2)
    assert sorted(map(str, read(path))) == sorted(map(str, rows))
    assert "2 run: 1 killed, 1 survived, 0 equivalent" in path.read_text()
    assert counts(rows).endswith("not equivalent: 50 %.")
    assert list(tmp_path.iterdir()) == [path]
    assert read(tmp_path / "none.md") == []
