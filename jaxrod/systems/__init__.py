"""Systems of rods and rigid bodies: bodies, joints, contact, neighbour lists."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.systems.contact.body_contact import BodyContact, body_contact
from jaxrod.systems.contact.crossing_contact import CrossingContact, crossing_contact
from jaxrod.systems.contact.neighbour_lists import (
    NeighbourLists,
    NeighbourRecord,
    neighbour_lists,
)
from jaxrod.systems.contact.rigid_contact import RigidContact, rigid_contact
from jaxrod.systems.contact.rod_contact import RodContact, rod_contact
from jaxrod.systems.health import SystemHealth
from jaxrod.systems.joints.glue import Glue, glue
from jaxrod.systems.joints.hinges import fixed_joint, hinge_joint
from jaxrod.systems.joints.pose_springs import (
    PoseSpring,
    pose_spring,
    pose_spring_reactions,
)
from jaxrod.systems.joints.rings import ring
from jaxrod.systems.joints.springs import ball_joint, spring
from jaxrod.systems.joints.ties import tie
from jaxrod.systems.joints.welds import attach, weld
from jaxrod.systems.members.rigid_bodies import RigidBodies, rigid_body, stacked_bodies
from jaxrod.systems.members.rigid_stepper import BodyState
from jaxrod.systems.neighbour_counts import Neighbours, neighbours
from jaxrod.systems.reactions import SystemReactions, free_body
from jaxrod.systems.settling import Settled, settled

__all__ = [
    "BodyContact",
    "BodyState",
    "CrossingContact",
    "Glue",
    "NeighbourLists",
    "NeighbourRecord",
    "Neighbours",
    "PoseSpring",
    "RigidBodies",
    "RigidContact",
    "RodContact",
    "Settled",
    "SystemHealth",
    "SystemReactions",
    "attach",
    "ball_joint",
    "body_contact",
    "crossing_contact",
    "fixed_joint",
    "free_body",
    "glue",
    "hinge_joint",
    "neighbour_lists",
    "neighbours",
    "pose_spring",
    "pose_spring_reactions",
    "rigid_body",
    "rigid_contact",
    "ring",
    "rod_contact",
    "settled",
    "spring",
    "stacked_bodies",
    "tie",
    "weld",
]

_GUESSES = {
    **dict.fromkeys(
        ("FreeJoint", "connect", "join", "joint"),
        "jaxrod.systems.tie joins rods that may turn, jaxrod.systems.weld rods that "
        "may not, and jaxrod.systems.attach joins rods to rigid bodies",
    ),
    **dict.fromkeys(("BallJoint", "ball"), "it is jaxrod.systems.ball_joint"),
    **dict.fromkeys(("FixedJoint", "fixed"), "it is jaxrod.systems.weld"),
    **dict.fromkeys(("HingeJoint", "hinge"), "it is jaxrod.systems.hinge_joint"),
    **dict.fromkeys(("Cylinder", "body"), "it is jaxrod.systems.rigid_body"),
    **dict.fromkeys(
        ("RodSelfContact", "self_contact"),
        "it is jaxrod.systems.rod_contact(name, self_contact=True)",
    ),
    "RodRodContact": "it is jaxrod.systems.rod_contact",
    "make_system": "it is jaxrod.make_system",
}
"""Hints for names that users of other tools guess, by the guess."""

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
