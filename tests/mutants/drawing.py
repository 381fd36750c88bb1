"""Drawing of faults: as many from every room as it has places for them."""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from .mutations import NO_NUMBERS, Fault, faults

TOPS = ("jaxrod", "envs", "training")


@dataclass(frozen=True)
class Drawn:
    """A fault in a file."""

    name: str
    file: str
    fault: Fault


def room(file: str) -> str:
    """The folder of a file."""
    return str(Path(file).parent)


@cache
def all_faults(root: Path) -> dict[str, list[tuple[str, Fault]]]:
    """Faults of every room, with their files."""
    rooms: dict[str, list[tuple[str, Fault]]] = {}
    for top in TOPS:
        for path in sorted((root / top).rglob("*.py")):
            file = path.relative_to(root).as_posix()
            if path.name in NO_NUMBERS or path.is_symlink():
                continue
            found = faults(path.read_text())
            rooms.setdefault(room(file), []).extend((file, fault) for fault in found)
    return {name: found for name, found in sorted(rooms.items()) if found}


def shares(sizes: dict[str, int], count: int) -> dict[str, int]:
    """`count` shared out in proportion, what is left over to the largest remainders."""
    total = sum(sizes.values())
    exact = {name: count * size / total for name, size in sizes.items()}
    given = {name: int(share) for name, share in exact.items()}
    left = sorted(exact, key=lambda name: (given[name] - exact[name], name))
    for name in left[: count - sum(given.values())]:
        given[name] += 1
    return given


def drawn(root: Path, count: int, seed: int) -> list[Drawn]:
    """Faults drawn with a seed, no two in one function, in an order drawn too."""
    rooms = all_faults(root)
    sizes = {name: len(found) for name, found in rooms.items()}
    chooser = random.Random(seed)
    chosen: list[tuple[str, Fault]] = []
    for name, share in shares(sizes, count).items():
        order = list(rooms[name])
        chooser.shuffle(order)
        taken: set[tuple[str, str]] = set()
        for file, fault in order:
            if len(taken) == share:
                break
            if (file, fault.function) not in taken:
                taken.add((file, fault.function))
                chosen.append((file, fault))
    # Whoever stops early has a sample of all rooms.
    chooser.shuffle(chosen)
    return [
        Drawn(f"d{number:02d}", file, fault)
        for number, (file, fault) in enumerate(chosen, 1)
    ]
