"""Tasks for soft arms: their controls, observations and rewards."""

if __name__ != "jaxrod.envs":
    raise ImportError("import jaxrod.envs, not envs: the folder has this name")

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.envs.arm.robot_hand import RobotHand, robot_hand
from jaxrod.envs.arm.soft_arm import actuated_arm
from jaxrod.envs.checking import check_environment
from jaxrod.envs.memory_policy import (
    MemoryPolicy,
    OneEpisode,
    held_for,
    remembering,
)
from jaxrod.envs.protocol import (
    Channel,
    Drawable,
    Environment,
    GoalConditioned,
    Goals,
    Plannable,
    Privileged,
    Snapshot,
)
from jaxrod.envs.randomisation import Randomisation, posterior
from jaxrod.envs.randomised import (
    Randomised,
    RandomisedParams,
    RandomisedState,
)
from jaxrod.envs.registry import make, names
from jaxrod.envs.rollout import Rollout, rollout
from jaxrod.envs.tasks.scene_task import SceneTask, SceneTaskParams, SceneTaskState
from jaxrod.envs.wrappers import (
    ActionRepeat,
    EpisodeRecord,
    VectorEnvironment,
    VectorState,
    VectorStep,
)

__all__ = [
    "ActionRepeat",
    "Channel",
    "Drawable",
    "Environment",
    "EpisodeRecord",
    "GoalConditioned",
    "Goals",
    "MemoryPolicy",
    "OneEpisode",
    "Plannable",
    "Privileged",
    "Randomisation",
    "Randomised",
    "RandomisedParams",
    "RandomisedState",
    "RobotHand",
    "Rollout",
    "SceneTask",
    "SceneTaskParams",
    "SceneTaskState",
    "Snapshot",
    "VectorEnvironment",
    "VectorState",
    "VectorStep",
    "actuated_arm",
    "check_environment",
    "held_for",
    "make",
    "names",
    "posterior",
    "remembering",
    "robot_hand",
    "rollout",
]

_GUESSES = {
    **dict.fromkeys(("create", "get_environment", "load"), "it is jaxrod.envs.make"),
    **dict.fromkeys(("available", "list"), "it is jaxrod.envs.names"),
    "wrap": "it is jaxrod.envs.VectorEnvironment",
}
"""Hints for names that users of other tools guess, by the guess."""

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
