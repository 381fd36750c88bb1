"""Smooth costs of the arm's tasks for planners: least where the reward is greatest."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

COST_WIDTH = 0.1
"""Distance from the target beyond which the cost of a plan grows linearly [m]."""


class CostOfResiduals:
    """Mixin for a task whose cost is the sum of the squared residuals."""

    @abstractmethod
    def residuals(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        width: float = COST_WIDTH,
    ) -> Float[Array, " residuals"]:
        """Residuals that planners make small; arguments as in `cost`."""

    def cost(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        width: float = COST_WIDTH,
    ) -> Float[Array, ""]:
        """Smooth cost of a state, least where the reward is greatest [1].

        Args:
            state: State after the control step.
            action: Action of that step.
            params: Numbers of the task.
            width: Distance from the target beyond which the cost grows linearly [m].
        """
        return jnp.sum(self.residuals(state, action, params, width) ** 2)


def tip_residuals(
    way: Float[Array, "3"], touching: Array, width: float | Array
) -> Float[Array, "3"]:
    r"""Smooth substitute for the reward's distance; the sum of squares is the cost [1].

    With $s = |way|/width$ the squares sum to $2\,(width/touching)^2\,(\sqrt{1 + s^2} -
    1)$. This is about $(|way|/touching)^2$ nearby and linear far away, with a slope
    everywhere but at the target. The reward's bonuses are steps, which have no slope.

    Args:
        way: Vector from the target to the tip [m].
        touching: Distance that costs about one [m].
        width: Distance beyond which the cost grows linearly [m].
    """
    root = jnp.sqrt(1 + jnp.sum(way**2) / width**2)
    # (root - 1) / s^2 without the cancellation between nearly equal numbers.
    return way / touching * jnp.sqrt(2 / (1 + root))
