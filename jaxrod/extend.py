"""Base classes and helpers for effects, couplings, methods and members of your own.

An effect acts on one rod, a coupling on members of a system, a method steps a scene,
and a member is a part of a system that is neither a rod nor a rigid body. Each is a
subclass, decorated with `pytree`, that overrides the hooks it needs; docs/extending.md
describes all four.
"""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.contacts.bodies import Solid
from jaxrod.effects.base import Effect, Reaction, StabilityBound
from jaxrod.effects.ends import Held, Wall
from jaxrod.geometry import rotations, vectors
from jaxrod.loaded_rod import LoadedRod, Method
from jaxrod.model import Stepper
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Layout
from jaxrod.structure import Leaf, memory, pytree, static
from jaxrod.systems.coupling import Coupling, Parts, Seen
from jaxrod.systems.joints.anchors import Anchors, anchors, spring_bounds
from jaxrod.systems.joints.places import sum_of_loads
from jaxrod.systems.members.member import Member
from jaxrod.systems.members.steppers import MemberStepper
from jaxrod.validation import as_array

__all__ = [
    "Anchors",
    "Coupling",
    "Effect",
    "Held",
    "Layout",
    "Leaf",
    "LoadedRod",
    "Loads",
    "Member",
    "MemberStepper",
    "Method",
    "Motion",
    "Parts",
    "Reaction",
    "Seen",
    "Solid",
    "StabilityBound",
    "Stepper",
    "Wall",
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

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
