"""docs/algorithms.md tells the default of every setting of every algorithm."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from jaxrod.training import algorithm_names, find_algorithm

PAGE = Path(__file__).parents[2] / "docs" / "algorithms.md"


def documented():
    """(algorithm, setting) -> what the page says its default is; may be repeated."""
    said = []
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if not line.startswith("| ") or not cells[1].startswith("`"):
            continue
        names = cells[0].strip("| ").split(", ")
        value = cells[3] if len(cells) == 5 else cells[2]
        for name in algorithm_names() if names == ["all"] else names:
            said.append(((name, cells[1].strip("`")), value.strip("| ")))
    return said


@pytest.mark.parametrize("name", algorithm_names())
def test_every_setting_is_documented_once_with_its_default(name):
    config = find_algorithm(name).config_type()
    defaults = {
        field.name: getattr(config, field.name) for field in dataclasses.fields(config)
    }
    told = [(setting, value) for (who, setting), value in documented() if who == name]
    assert sorted(setting for setting, _ in told) == sorted(defaults)
    for setting, value in told:
        default = defaults[setting]
        if isinstance(default, bool):
            assert value == str(default).lower(), setting
        elif isinstance(default, tuple):
            assert tuple(int(part) for part in value.split(",")) == default, setting
        else:
            assert float(value) == default, setting
