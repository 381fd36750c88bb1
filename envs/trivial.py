"""A point on a line that should stay at zero: a task that is solved in seconds.

It exists to test learners. The best policy and its return are known in closed form, an
episode can end both ways (time limit, running off the line), and a step costs almost
nothing.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxrod.envs.checking import action_of_size, check_key
from jaxrod.envs.protocol import Channel, Step
from jaxrod.structure import pytree


@pytree
class TrivialParams:
    """Parameters of the trivial task: step length and end of the line."""

    stride: float | Float[Array, ""] = 0.2
    """Distance by which an action of 1 moves the point [m]."""
    edge: float | Float[Array, ""] = 2.0
    """Distance from zero beyond which the episode is terminated [m]."""


@pytree
class TrivialState:
    """State of the trivial task: position of the point, and a step count."""

    position: Float[Array, ""]
    """Position of the point [m]."""
    steps: Int[Array, ""]
    """Control steps since reset."""


@dataclasses.dataclass(frozen=True)
class Trivial:
    """Moves a point to zero: x' = x + stride a, reward 1 - x'^2, |x_0| <= 1 m.

    The best action is `clip(-x / stride, -1, 1)`. With the default parameters its mean
    return is `optimal_return`. Without motion the mean reward is 2/3 per step. A point
    farther than `edge` from zero is lost: the episode is terminated.
    """

    episode_length: int = 20
    """Control steps per episode."""
    name: str = "trivial"
    """Name of the task."""
    observation_size: int = 1
    """Length of the observation."""
    action_size: int = 1
    """Length of the action."""

    observation_channels = (Channel(1, "position", "m"),)
    action_channels = (Channel(1, "share of the largest stride, 0.2 m", "1"),)

    @property
    def optimal_return(self) -> float:
        """Mean return of the best policy at the default parameters [1].

        After k steps |x| = max(0, |x_0| - stride k). The mean of its square over |x_0|
        uniform in [0, 1] is (1 - stride k)^3 / 3 if 1 > stride k, otherwise 0.
        """
        lost = (max(0.0, 1 - 0.2 * k) ** 3 / 3 for k in range(1, 6))
        return self.episode_length - sum(list(lost)[: self.episode_length])

    def default_params(self) -> TrivialParams:
        """Default parameters, for which `optimal_return` holds."""
        return TrivialParams()

    def reset(
        self, key: Key[Array, ""], params: TrivialParams
    ) -> tuple[Float[Array, " observation"], TrivialState]:
        """Starts the point uniformly in [-1, 1] m."""
        check_key(key)
        position = jax.random.uniform(key, minval=-1.0, maxval=1.0)
        return position[None], TrivialState(position, jnp.zeros((), jnp.int32))

    def step(
        self,
        key: Key[Array, ""],
        state: TrivialState,
        action: Float[Array, " action"],
        params: TrivialParams,
    ) -> Step:
        """Moves the point: x' = x + stride a, with reward 1 - x'^2."""
        action = action_of_size(action, self.action_size)
        position = state.position + params.stride * action[0]
        steps = state.steps + 1
        terminated = jnp.abs(position) > params.edge
        truncated = steps >= self.episode_length
        info = {"distance": jnp.abs(position)}
        state = TrivialState(position, steps)
        return position[None], state, 1 - position**2, terminated, truncated, info

    def predict(
        self,
        state: TrivialState,
        action: Float[Array, " action"],
        params: TrivialParams,
        control_steps: int = 1,
    ) -> TrivialState:
        """Predicts the state under a held action: x + control_steps stride a."""
        position = state.position + control_steps * params.stride * action[0]
        return TrivialState(position, state.steps + control_steps)

    def residuals(
        self,
        state: TrivialState,
        action: Float[Array, " action"],
        params: TrivialParams,
    ) -> Float[Array, "1"]:
        """Residual for planners: position of the point, whose square is the cost."""
        del action, params
        return state.position[None]

    def cost(
        self,
        state: TrivialState,
        action: Float[Array, " action"],
        params: TrivialParams,
    ) -> Float[Array, ""]:
        """Cost for planners: squared position x^2; the reward is 1 - cost."""
        return jnp.sum(self.residuals(state, action, params) ** 2)
