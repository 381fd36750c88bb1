"""Rooms of the package, and the imports between them: one way, and not many."""

import ast
import functools
import re
from pathlib import Path

import pytest

from walk_of_a_scene import files_entered

ROOT = Path(__file__).parents[1]
MOST_ARROWS = 353
"""Between rooms; there were 541 between 123 when most files were rooms of their own.
The base class of users' tasks, which steps and examines scenes, has three of them, and
names that are misspelt in five rooms have one helper."""

MOST_WITHIN_SYSTEMS = 129
"""Between files of `jaxrod.systems`, without `__init__`; the old house had 220. Health,
reactions and regridding of joints, which are files of their own, have ten of them."""
MOST_WITHIN_CONTROL = 45
"""Between files of `jaxrod.control`, without `__init__`; the old house had 74."""


def modules():
    """Every module of the package by its import name, with its file."""
    found = {}
    for top in ("jaxrod", "envs", "training"):
        for file in (ROOT / top).rglob("*.py"):
            parts = file.relative_to(ROOT).with_suffix("").parts
            parts = parts if top == "jaxrod" else ("jaxrod", *parts)
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join(parts)] = file
    return found


def room(module):
    """A folder, or a file that lies beside the folders."""
    parts = module.split(".")
    return ".".join(parts[: 3 if parts[1:2] in (["envs"], ["training"]) else 2])


@functools.cache
def arrows():
    """Pairs of modules of which the first imports the second, be it for types alone."""
    known = modules()
    pairs = set()
    for module, file in known.items():
        tree = ast.parse(file.read_text())
        for node in ast.walk(tree):
            if not isinstance(node, ast.ImportFrom):
                continue
            for name in node.names:
                whole = f"{node.module}.{name.name}"
                imported = whole if whole in known else node.module
                if imported in known and imported != module:
                    pairs.add((module, imported))
    return frozenset(pairs)


def on_circles(pairs):
    """The pairs left when all that imports nothing, or only such, is taken away."""
    left = set(pairs)
    while True:
        sources = {a for a, _ in left}
        kept = {(a, b) for a, b in left if b in sources}
        if kept == left:
            return kept
        left = kept


def test_files_do_not_import_each_other_in_circles():
    assert on_circles(arrows()) == set()


def test_rooms_do_not_import_each_other_in_circles():
    between = {(room(a), room(b)) for a, b in arrows()}
    between = {(a, b) for a, b in between if a != b}
    assert on_circles(between) == set()
    assert len(between) <= MOST_ARROWS


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("jaxrod.systems", MOST_WITHIN_SYSTEMS),
        ("jaxrod.control", MOST_WITHIN_CONTROL),
    ],
)
def test_files_of_a_room_import_few_others_of_it(name, most):
    within = {(a, b) for a, b in arrows() if room(a) == room(b) == name and a != name}
    assert 0 < len(within) <= most


def test_dependencies_point_one_way():
    floors = {"envs": 1, "training": 2, "cli": 3}

    def floor(module):
        return floors.get(module.split(".")[1] if "." in module else "", 0)

    # The root package finds everything by name, when it is asked for.
    upward = {(a, b) for a, b in arrows() if floor(a) < floor(b) and a != "jaxrod"}
    assert upward == {("jaxrod.__main__", "jaxrod.cli")}


def drawn_lines():
    """Lines of the picture in docs/architecture.md, counted from the top, by room."""
    picture = (ROOT / "docs" / "rooms.svg").read_text()
    lines = re.findall(r'<text class="rooms">(.*)</text>', picture)
    words = [re.sub("<.*?>", " ", line).split() for line in lines]
    return {name: k for k, names in enumerate(words) for name in names}


def test_rooms_import_as_they_are_drawn():
    """From their own line and those below, but for the root package and its main."""
    line = drawn_lines()

    def place(module):
        return room(module).removeprefix("jaxrod.").split(".")[0]

    pairs = {(place(a), place(b)) for a, b in arrows()}
    pairs = {(a, b) for a, b in pairs if not {a, b} & {"jaxrod", "__main__"}}
    rooms = {name for pair in pairs for name in pair}
    assert set(line) == rooms - {"data"}
    assert {(a, b) for a, b in pairs if line[a] > line[b]} == set()


def test_scenes_are_composed_without_knowing_methods_but_the_default():
    known = {b for a, b in arrows() if a == "jaxrod.scene"}
    methods = {module for module in known if module.startswith("jaxrod.methods")}
    assert methods == {"jaxrod.methods.consistent", "jaxrod.methods.drag_kick"}


def test_no_module_name_begins_with_an_underscore():
    names = {name for module in modules() for name in module.split(".")}
    assert {name for name in names if name.startswith("_")} == {"__main__"}


@pytest.mark.slow
def test_a_scene_enters_few_files_on_its_way_to_a_step():
    """`python tests/walk_of_a_scene.py` prints them."""
    assert len(files_entered()) <= 8
