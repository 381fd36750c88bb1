"""Smooth costs of the arm's tasks, for planners: least where the reward is greatest."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

COST_WIDTH = 0.1
"""Distance from the target beyond which the cost of a plan grows linearly [m]."""


class CostOfResiduals:
    """Part of a task: the cost is the sum of the residuals' squares."""

    @abstractmethod
    def residuals(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        width: float = COST_WIDTH,
    ) -> Float[Array, " residuals"]:
        """Numbers that plans make small; arguments as of `cost`."""

    def cost(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        width: float = COST_WIDTH,
    ) -> Float[Array, ""]:
        """Smooth cost of a state, least where the reward is greatest [1].

        Args:
            state: After the control step.
            action: That led there.
            params: Numbers of the task.
            width: Distance from the target beyond which it grows linearly [m].
        """
        return jnp.sum(self.residuals(state, action, params, width) ** 2)


def tip_residuals(
    way: Float[Array, "3"], touching: Array, width: float | Array
) -> Float[Array, "3"]:
    r"""Smooth stand-in for the reward's distance, whose squares are the cost [1].

    With $s = |way|/width$ the squares add up to
    $2\,(width/touching)^2\,(\sqrt{1 + s^2} - 1)$: about $(|way|/touching)^2$ nearby,
    linear far away, with a slope everywhere but at the target. The reward's bonuses are
    steps, which have none.

    Args:
        way: From the target to the tip [m].
        touching: Distance that costs about one [m].
        width: Distance beyond which the cost grows linearly [m].
    """
    root = jnp.sqrt(1 + jnp.sum(way**2) / width**2)
    # (root - 1) / s^2 without the difference of near numbers.
    return way / touching * jnp.sqrt(2 / (1 + root))
