"""Episodes cut short in the first part of a run.

If the first moments of an episode decide its outcome, a learner that always waits for
the end sees few first moments: half a million control steps are 140 episodes of Case 3.
Episodes that are cut short are truncated, not terminated, and do not count for the
score.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrod.envs import Environment
from jaxrod.training.algorithm import steps_per_update


def restart_phase(
    env: Environment, config: Any, updates: Int[Array, ""] | int
) -> Int[Array, ""]:
    """Initial clock of the episodes that start now [control steps].

    Args:
        env: The environment.
        config: Configuration with the numbers `short_length`, the control steps of a
            short episode, and `short_steps`, the control steps until which episodes are
            short.
        updates: Number of updates of the run so far.
    """
    phase = jnp.maximum(env.episode_length - config.short_length, 0)
    # Updates are compared, not control steps, which would overflow their integers.
    short = updates < config.short_steps / steps_per_update(config)
    return jnp.where(short, phase, 0).astype(jnp.int32)
