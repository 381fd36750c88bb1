"""Counts where code asks what class or kind an object is, instead of asking the object.

    python tests/class_questions.py [ROOT]

Of jaxrod's own classes: `isinstance`, `issubclass` and cases of `match`. Beside them,
of anything: `hasattr`, comparisons of classes (`type(a) is B`) and of a method's `law`,
and `.ndim` of the fields of a member or a rod.
"""

from __future__ import annotations

import ast
import collections
import sys
from collections.abc import Iterator
from pathlib import Path

FOLDERS = ("jaxrod", "envs", "training")
LEADING_AXES = ("rest_lengths", "masses", "positions")
"""Fields whose number of axes tells one rod from several."""


def own_classes(root: Path) -> set[str]:
    """Names of all classes that the product defines, and of unions of them."""
    found: set[str] = set()
    unions: dict[str, set[str]] = {}
    for path in files(root):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                found.add(node.name)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.BinOp):
                for target in node.targets:
                    if isinstance(target, ast.Name):
                        unions[target.id] = set(names(node.value))
    return found | {name for name, parts in unions.items() if parts & found}


def files(root: Path) -> list[Path]:
    """All files of the product."""
    return sorted(p for folder in FOLDERS for p in (root / folder).rglob("*.py"))


def names(node: ast.AST) -> Iterator[str]:
    """Last names of all names and attributes within a node."""
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            yield part.id
        if isinstance(part, ast.Attribute):
            yield part.attr


def questions(source: str, own: set[str]) -> Iterator[tuple[int, str]]:
    """Lines and kinds of questions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            if node.func.id in ("isinstance", "issubclass"):
                if set(names(node.args[1])) & own:
                    yield node.lineno, "class"
            if node.func.id == "hasattr":
                yield node.lineno, "hasattr"
        if isinstance(node, ast.MatchClass) and set(names(node.cls)) & own:
            yield node.lineno, "class"
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            calls = [side for side in sides if isinstance(side, ast.Call)]
            if any("type" in names(call.func) for call in calls):
                yield node.lineno, "compared classes"
            attributes = [s.attr for s in sides if isinstance(s, ast.Attribute)]
            if "law" in attributes:
                yield node.lineno, "compared laws"
        if isinstance(node, ast.Attribute) and node.attr == "ndim":
            if set(names(node.value)) & set(LEADING_AXES):
                yield node.lineno, "leading axes"


def counted(root: Path) -> dict[str, collections.Counter[str]]:
    """Numbers of questions by kind, for each folder of the second level."""
    own = own_classes(root)
    found: dict[str, collections.Counter[str]] = collections.defaultdict(
        collections.Counter
    )
    for path in files(root):
        folder = "/".join(path.relative_to(root).parts[:-1][:2])
        for _, kind in questions(path.read_text(), own):
            found[folder][kind] += 1
            found["all of jaxrod" if folder.startswith("jaxrod") else "others"][
                kind
            ] += 1
    return found


def main() -> None:
    """Prints the numbers."""
    root = Path(sys.argv[1] if len(sys.argv) > 1 else __file__).resolve()
    root = root if root.is_dir() else root.parents[1]
    for folder, counts in sorted(counted(root).items()):
        print(f"{folder}: {dict(counts)}")


if __name__ == "__main__":
    main()
