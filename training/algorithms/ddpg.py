"""Deep deterministic policy gradients: TD3 without its three safeguards.

Source: Lillicrap et al., "Continuous control with deep reinforcement learning", 2016.
"""

from __future__ import annotations

import dataclasses

from jaxrod.structure import pytree, static
from jaxrod.training.algorithms.td3 import TD3, TD3Config
from jaxrod.training.settings import Scalar


@pytree
class DDPGConfig(TD3Config):
    """Settings of DDPG: those of TD3 with one critic, no delay and no target smoothing.

    `jaxrod.training.TD3Config` describes the settings.
    """

    policy_delay: int = static(default=1)
    critics: int = static(default=1)
    policy_learning_rate: Scalar = 3e-4
    target_noise: Scalar = 0.0


DDPG = dataclasses.replace(TD3, name="ddpg", config_type=DDPGConfig)
"""DDPG for the shared loop."""
