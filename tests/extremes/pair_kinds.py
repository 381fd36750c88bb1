"""Kinds of random scenes of one rod: methods, supports and effects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

METHODS = (
    *("consistent",) * 6,
    *("pyelastica",) * 3,
    *("planar",) * 2,
    "planar pyelastica",
    *("torsion free",) * 2,
    "implicit",
)
SUPPORTS = ("none", "clamp", "fixed end", "pin", "hinge", "driven", "two clamps")
EFFECTS = (
    "gravity",
    "end load",
    "follower",
    "uniform load",
    "follower load",
    "exponential damping",
    "stokes",
    "quadratic",
    "slender body",
    "buoyancy",
    "internal damping",
    "short waves",
    "laplacian filter",
    "linear damper",
    "contact",
    "contact of many",
    "near contact",
    "muscle",
    "helical muscle",
    "muscle across",
    "fast muscle",
    "chamber",
    "wound chamber",
    "tendon",
    "anchored tendon",
    "wound up tendon",
    "rubbing tendon",
    "wave",
    "world wave",
    "active shape",
    "magnet",
    "magnet in a gradient",
    "spline couples",
    "relaxing solid",
    "wires that slip",
    "plastic bending",
    "sticking contact",
)
MOVING = {
    "contact": "moving contact",
    "contact of many": "moving contact of many",
    "sticking contact": "moving sticking contact",
}
"""Contact with bodies that move, in place of that with fixed ones."""
ONE_WAY = {
    "tendon",
    "anchored tendon",
    "wound up tendon",
    "rubbing tendon",
    "helical muscle",
    "spline couples",
    "world wave",
}
"""Effects that run along a rod from its start to its finish."""
DISSIPATING = {"internal damping", "short waves", "laplacian filter", "linear damper"}
"""Effects that are solved one after the other: their order matters to second order
in the step."""
SECTIONS = ("round", "tapered", "tube", "rectangle", "ellipse")
DRAGS = {"stokes", "quadratic"}
"""A scene may have one of them."""
PLANAR = {
    "gravity",
    "end load",
    "uniform load",
    "exponential damping",
    "stokes",
    "quadratic",
    "slender body",
    "buoyancy",
    "internal damping",
    "short waves",
    "contact",
    "contact of many",
    "near contact",
    "relaxing solid",
    "wires that slip",
    "plastic bending",
    "sticking contact",
}
FRAMED = {
    "relaxing solid",
    "wires that slip",
    "plastic bending",
    "sticking contact",
}
"""Effects with memory, which need frames of elements."""


@dataclass(frozen=True)
class Kind:
    """All of a random scene that is not a number."""

    method: str
    support: str
    effects: tuple[str, ...]
    n_elements: int
    straight: bool
    section: str
    flow: str
    schedules: bool

    @property
    def flat(self) -> bool:
        """Whether it moves in a plane."""
        return self.method.startswith("planar")

    @property
    def exact_parts(self) -> bool:
        """Whether two runs one after the other are one to rounding."""
        return self.section in ("round", "tapered", "tube") or self.flat

    @property
    def twists(self) -> bool:
        """Whether the frames of elements are more than their directions."""
        return self.method != "torsion free"

    @property
    def reversible(self) -> bool:
        """Whether it can be told from the rod's other end."""
        return not ONE_WAY & set(self.effects)

    @property
    def any_order(self) -> bool:
        """Whether the order of its effects does not matter."""
        return len(DISSIPATING & set(self.effects)) < 2

    @property
    def anywhere(self) -> bool:
        """Whether it loses nothing to rounding far from the origin but places."""
        return "magnet in a gradient" not in self.effects


def random_kind(random: np.random.Generator) -> Kind:
    """Kind of a scene; not all of them can be made."""
    method = str(random.choice(METHODS))
    allowed = list(EFFECTS)
    if method.startswith("planar") or method == "torsion free":
        allowed = [e for e in EFFECTS if e in PLANAR]
    if method == "torsion free":
        allowed = [e for e in allowed if e not in FRAMED]
    if method.endswith("pyelastica"):
        allowed.remove("quadratic")
    elif method != "pyelastica":
        allowed = [e for e in allowed if e not in ("laplacian filter", "linear damper")]
    picked = random.choice(allowed, size=int(random.integers(2, 5)), replace=False)
    drags = [e for e in picked if e in DRAGS]
    kind = Kind(
        method,
        str(random.choice(SUPPORTS[:4] if method == "torsion free" else SUPPORTS)),
        tuple(str(e) for e in picked if e not in drags[1:]),
        int(random.integers(3, 11)),
        bool(random.random() < 0.5) or method == "torsion free",
        str(random.choice(SECTIONS[:3] if method == "torsion free" else SECTIONS)),
        str(random.choice(("none", "even", "field"))),
        bool(random.random() < 0.5),
    )
    # Last, so that all else of a seed is what it was without bodies that move.
    if random.random() < 0.5:
        return kind
    return replace(kind, effects=tuple(MOVING.get(e, e) for e in kind.effects))
