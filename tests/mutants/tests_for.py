"""Test files that could see a fault in a source file, the likeliest first.

A test file speaks of a module where it imports it or uses what the module gives to
others; also where it uses what stands on the module, which counts less. What few test
files use says more than what many do.
"""

from __future__ import annotations

import ast
import math
import re
from collections import Counter
from pathlib import Path

FOLDERS = {
    "jaxrod/systems": ("systems",),
    "jaxrod/assemblies": ("systems",),
    "jaxrod/control": ("control",),
    "jaxrod/lanes": ("lanes",),
    "jaxrod/jax_internals": ("jax_internals", "lanes"),
    "jaxrod/viz": ("viz",),
    "jaxrod/cli": ("cli",),
    "jaxrod/tradeoff": ("tradeoff", "benchmarks"),
    "jaxrod/installation": (),
    "envs": ("envs",),
    "training": ("training",),
    "jaxrod": ("physics",),
}
"""Folders of tests for rooms, and for the rooms within them."""
NOT_TRIED = ("mutants", "test_rooms.py", "test_packaging.py", "test_types.py")
"""About files and their places: a copy of the tree is no checkout."""
STEPS = (1.0, 0.3, 0.1)
"""Weights of the names of a module, and of modules that stand on it."""
WORD = re.compile(r"[A-Za-z_][A-Za-z_0-9]+")


class Likely:
    """Orders the test files of a tree for each of its source files."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.words = {
            path.relative_to(root).as_posix(): Counter(WORD.findall(path.read_text()))
            for path in sorted((root / "tests").rglob("*.py"))
            if not any(part in NOT_TRIED for part in path.relative_to(root).parts)
        }
        self.tests = [t for t in self.words if Path(t).name.startswith("test_")]
        self.used_by = Counter(w for t in self.tests for w in self.words[t])
        self.modules: dict[str, str] = {}
        for top in ("jaxrod", "envs", "training"):
            for path in (root / top).rglob("*.py"):
                file = path.relative_to(root).as_posix()
                dotted = file.removesuffix(".py").replace("/", ".")
                dotted = dotted.removesuffix(".__init__")
                self.modules[dotted if top == "jaxrod" else f"jaxrod.{dotted}"] = file
        self._given: dict[str, frozenset[str]] = {}
        self.standing_on: dict[str, set[str]] = {}
        for file in self.modules.values():
            for under in self._imports(file):
                self.standing_on.setdefault(under, set()).add(file)

    def _imports(self, file: str) -> set[str]:
        found = set()
        for node in ast.walk(ast.parse((self.root / file).read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                for name in node.names:
                    whole = f"{node.module}.{name.name}"
                    under = self.modules.get(whole) or self.modules.get(node.module)
                    if under and not under.endswith("__init__.py"):
                        found.add(under)
        return found

    def _names(self, file: str) -> frozenset[str]:
        """Public names of a module."""
        if file not in self._given:
            tree = ast.parse((self.root / file).read_text())
            self._given[file] = frozenset(
                node.name
                for node in tree.body
                if isinstance(node, ast.FunctionDef | ast.ClassDef)
                and not node.name.startswith("_")
            )
        return self._given[file]

    def score(self, test: str, file: str) -> float:
        """A measure of how much a test file is about a source file."""
        stem, own = Path(file).stem, Path(test).stem.removeprefix("test_")
        total = 0.0
        if stem in (own, f"{own}s") or own == f"{stem}s":
            total += 20
        elif stem in own or (own in stem and len(own) > 3):
            total += 5
        total += 2 * (self.words[test][stem] > 0 and self.used_by[stem] < 8)
        level, seen = {file}, {file}
        for weight in STEPS:
            for name in {n for f in level for n in self._names(f)}:
                count = self.words[test][name]
                if count:
                    rare = 1 / self.used_by[name]
                    total += weight * 10 * rare * math.log2(1 + count)
            level = {s for f in level for s in self.standing_on.get(f, ())} - seen
            seen |= level
        if self._in_room(test, file):
            total *= 1.5
        return total

    def _in_room(self, test: str, file: str) -> bool:
        return Path(test).parent.name in self.room_folders(file)

    def room_folders(self, file: str) -> tuple[str, ...]:
        """Folders of tests of the room of a file."""
        here = Path(file).parent
        while str(here) not in FOLDERS:
            here = here.parent
        return FOLDERS[str(here)]

    def first(self, file: str, most: int = 5) -> list[str]:
        """The likeliest few."""
        scored = sorted((-self.score(t, file), t) for t in self.tests)
        return [test for score, test in scored[:most] if score < 0]

    def rest(self, file: str, tried: list[str], most: int) -> list[str]:
        """The other files of its room, then whatever else speaks of the module."""
        scored = [(self.score(t, file), t) for t in self.tests if t not in tried]
        order = sorted(
            (not self._in_room(test, file), -score, test)
            for score, test in scored
            if score > 0 or self._in_room(test, file)
        )
        return [test for _, _, test in order][:most]
