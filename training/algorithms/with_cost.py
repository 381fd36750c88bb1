"""An environment that reports its smooth cost."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxtyping import Array, Float, Key

from jaxrod.envs import Environment


@dataclasses.dataclass(frozen=True)
class WithCost:
    """The environment with its cost in `info`, for the state before any restart.

    Raises:
        ValueError: The environment has no cost.
    """

    env: Environment
    """The environment."""

    def __post_init__(self) -> None:
        """Checks that the environment has a cost."""
        if not hasattr(self.env, "cost"):
            raise ValueError(
                f"{type(self.env).__name__} has no cost (jaxrod.envs.Plannable): "
                "let the objective be the reward"
            )

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.env.name

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """Length of the action vector."""
        return self.env.action_size

    @property
    def episode_length(self) -> int:
        """Control steps after which an episode is truncated."""
        return self.env.episode_length

    def default_params(self) -> Any:
        """Parameters of the environment."""
        return self.env.default_params()

    def reset(self, key: Key[Array, ""], params: Any) -> tuple[Array, Any]:
        """Starts an episode."""
        return self.env.reset(key, params)

    def step(
        self,
        key: Key[Array, ""],
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> Any:
        """The environment's step, with `"cost"` in its `info`."""
        *most, info = self.env.step(key, state, action, params)
        env: Any = self.env
        return (*most, info | {"cost": env.cost(most[1], action, params)})
