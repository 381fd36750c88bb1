"""Names for effects, couplings and methods of your own.

An effect acts on one rod, a coupling on members of a system, a method steps a scene.
Each is a subclass, decorated with `pytree`, that overrides the hooks it needs;
docs/extending.md describes all three.
"""

from jaxrod.composite import Stepper
from jaxrod.effects.base import Effect, Reaction, StabilityBound
from jaxrod.geometry import rotations, vectors
from jaxrod.rods.motion import Loads, Motion
from jaxrod.scene import Method
from jaxrod.structure import Leaf, memory, pytree, static
from jaxrod.systems.joints.anchors import Anchors, anchors, spring_bounds
from jaxrod.systems.sites.coupling import Coupling
from jaxrod.systems.sites.rows import sum_of_loads
from jaxrod.validation import as_array

__all__ = [
    "Anchors",
    "Coupling",
    "Effect",
    "Leaf",
    "Loads",
    "Method",
    "Motion",
    "Reaction",
    "StabilityBound",
    "Stepper",
    "anchors",
    "as_array",
    "memory",
    "pytree",
    "rotations",
    "spring_bounds",
    "static",
    "sum_of_loads",
    "vectors",
]
