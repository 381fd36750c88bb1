"""The tasks for Gymnasium: import this module, then `gymnasium.make("jaxrod/...")`.

The ids are `jaxrod/TASK-VARIANT-v0`, for example `jaxrod/tracking-paper-v0`; `ids()`
lists them. Keyword arguments of `make` and `make_vec` go to the task, for example
`controls=4` to `structured`. An id's version rises when its results change.
"""

from __future__ import annotations

try:
    import gymnasium
except ModuleNotFoundError as missing:
    if missing.name != "gymnasium":
        raise
    raise ModuleNotFoundError(
        'jaxrod.envs.gym needs gymnasium; install it with: pip install "jaxrod[gym]"',
        name="gymnasium",
    ) from missing

from jaxrod.envs.adapters.gymnasium_env import GymnasiumEnv
from jaxrod.envs.adapters.gymnasium_vector_env import GymnasiumVectorEnv

__all__ = ["GymnasiumEnv", "GymnasiumVectorEnv", "ids"]

VARIANTS = {
    "tracking": ("paper", "clean"),
    "reaching": ("paper", "clean"),
    "structured": ("paper", "clean"),
    "unstructured": ("paper", "clean"),
    "snake": ("clean",),
    "octopus": ("clean",),
    "gripper": ("clean",),
    "following": ("clean",),
}
"""The tasks, and the variants of each."""


def ids() -> tuple[str, ...]:
    """Returns the registered ids."""
    return tuple(_id(task, variant) for task in VARIANTS for variant in VARIANTS[task])


def _id(task: str, variant: str) -> str:
    return f"jaxrod/{task}-{variant}-v0"


for _task, _variants in VARIANTS.items():
    for _variant in _variants:
        gymnasium.register(
            id=_id(_task, _variant),
            entry_point="jaxrod.envs.gym:GymnasiumEnv",
            vector_entry_point="jaxrod.envs.gym:GymnasiumVectorEnv",
            kwargs={"task": _task, "variant": _variant},
        )
