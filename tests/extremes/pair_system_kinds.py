"""Kinds of random systems: members, how they are joined, what else there is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

ROD_JOINTS = ("tie", "weld", "ball", "hinge", "rigid", "spring")
BODY_JOINTS = ("attach", "attach turning", "ball", "hinge", "rigid", "spring")
SHAPES = ("sphere", "box", "capsule", "cylinder")
CONTACTS = ("none", "rods", "rods, lists", "crossings", "crossings, lists")
LOSSES = ("none", "damping", "stokes", "internal")


@dataclass(frozen=True)
class Kind:
    """All of a random system that is not a number."""

    members: tuple[Any, ...]
    """For each member, the number of elements of a rod or the shape of a body."""
    relations: tuple[tuple[str, int, int], ...]
    """For all but the first, a joint, "beside" or "glue", and to which rod and node."""
    sections: tuple[str, ...]
    losses: tuple[str, ...]
    contact: str
    rigid: str
    """Contact of bodies: "none", "bodies" or "ground", which is fixed."""
    rubs: bool
    falls: bool
    held: str
    posed: bool
    method: str
    flat = False
    anywhere = True
    any_order = True
    twists = True

    @property
    def reversible(self) -> bool:
        """Whether it can be told from the first rod's other end.

        A joint at a node within a rod holds the element after it.
        """
        return all(
            parent or how in ("beside", "glue", "tie") or node == self.members[0]
            for how, parent, node in self.relations
        )

    @property
    def exact_parts(self) -> bool:
        """Whether two runs one after the other are one to rounding."""
        attached = any(how.startswith("attach") for how, *_ in self.relations)
        round_ones = set(self.sections) == {"round"} and "box" not in self.members
        return round_ones and not attached


def random_system(random: np.random.Generator) -> Kind:
    """Kind of a system of two to four members, the first of them a rod."""
    members: list[Any] = [int(random.integers(3, 7))]
    relations: list[tuple[str, int, int]] = []
    method = str(
        random.choice(("consistent", "consistent", "consistent", "pyelastica"))
    )
    for _ in range(int(random.choice((1, 1, 2, 2, 3)))):
        rods = [k for k, kind in enumerate(members) if isinstance(kind, int)]
        parent = int(random.choice(rods))
        taken = {r[1:] for r in relations}
        nodes = [n for n in range(1, members[parent] + 1) if (parent, n) not in taken]
        node = int(random.choice(nodes))
        is_rod = bool(random.random() < 0.6)
        if is_rod:
            how = str(
                random.choice((*ROD_JOINTS, "beside", "beside", "beside", "glue"))
            )
            size = members[parent] if how == "glue" else int(random.integers(3, 7))
            members.append(size)
        else:
            how = str(random.choice((*BODY_JOINTS, "beside", "beside", "beside")))
            members.append(str(random.choice(SHAPES)))
        relations.append((how, parent, node))
    rods = [k for k in members if isinstance(k, int)]
    return Kind(
        tuple(members),
        tuple(relations),
        tuple(
            str(random.choice(("round", "round", "round", "rectangle"))) for _ in rods
        ),
        tuple(str(random.choice(LOSSES)) for _ in members),
        str(random.choice(CONTACTS)) if len(rods) > 1 else "none",
        str(random.choice(("none", "bodies", "ground"))),
        bool(random.random() < 0.6),
        bool(random.random() < 0.5),
        str(random.choice(("none", "none", "clamp", "pin"))),
        bool(random.random() < 0.3),
        method,
    )
