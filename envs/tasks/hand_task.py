"""Base class of tasks in which a hand moves the held end of a rod.

Actions are velocities of the hand, renewed every 0.1 s. When a numerical health flag
rises everything is frozen at its last sound state, the reward of the step is 0 and the
episode is truncated. `success` is 1 once the goal has been kept for half a second
without a break.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from jaxrod.envs.checking import action_of_size
from jaxrod.envs.protocol import Step
from jaxrod.envs.soft_bodies.hand import Glide, Hand
from jaxrod.envs.soft_bodies.held_rope import HeldRope

CONTROL_PERIOD = 0.1
"""Time between actions [s]."""
HELD_STEPS = 5
"""Control steps at the end of an episode during which the goal must be kept."""
N_POINTS = 4
"""Number of observed points along the rod."""


@dataclasses.dataclass(frozen=True)
class HandTask(ABC):
    """Steps and predictions of a task with a hand; a subclass has the goal."""

    n_elements: int
    substeps: int
    episode_length: int = 60

    action_size = 3
    """3 numbers: velocity of the hand along x, y and z."""

    control_period = CONTROL_PERIOD
    """Time between actions [s]."""

    @abstractmethod
    def observe(self, state: Any, params: Any) -> Float[Array, " observation"]:
        """Observation vector."""

    @abstractmethod
    def is_there(self, state: Any, params: Any) -> Bool[Array, ""]:
        """Whether the state is the goal."""

    @abstractmethod
    def judged(
        self, state: Any, params: Any
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Score from 0 to 100, and lengths and angles to tell in `info`."""

    @abstractmethod
    def residuals(
        self, state: Any, action: Float[Array, " action"], params: Any
    ) -> Float[Array, " residuals"]:
        """Residuals for planners; their squares sum to the cost."""

    def body_in(self, state: Any, params: Any) -> HeldRope:
        """The held rod with everything that acts on it in a state."""
        del state
        body: HeldRope = params.body
        return body

    def step(
        self,
        key: Key[Array, ""],
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> Step:
        """Advances one control step; the hand's velocity follows the action."""
        del key
        state, flagged = self.moved(state, action, params)
        score, told = self.judged(state, params)
        info = {
            **told,
            "score": score,
            "success": (state.held >= HELD_STEPS).astype(score.dtype),
            "flagged": flagged,
        }
        return (
            self.observe(state, params),
            state,
            jnp.where(flagged, 0, score / self.episode_length),
            jnp.zeros((), bool),
            (state.steps >= self.episode_length) | flagged,
            info,
        )

    def moved(
        self, state: Any, action: Float[Array, " action"], params: Any
    ) -> tuple[Any, Bool[Array, ""]]:
        """Returns the state one control step later, and whether a health flag rose."""
        action = action_of_size(action, self.action_size)
        hand, period = params.hand, self.substeps * params.dt
        coordinates, velocity = hand.moved(
            state.coordinates, state.velocity, action, period
        )
        first, first_velocity = _carried(hand, state.coordinates, state.velocity)
        last, last_velocity = _carried(hand, coordinates, velocity)
        path = Glide(first, last, first_velocity, last_velocity, period)
        body, flagged = self.body_in(state, params).advance(
            state.body, path, params.dt, self.substeps
        )
        # The hand is frozen with the rod: a NaN action must not reach it.
        after = dataclasses.replace(
            state,
            body=body,
            coordinates=jnp.where(flagged, state.coordinates, coordinates),
            velocity=jnp.where(flagged, state.velocity, velocity),
            steps=state.steps + 1,
        )
        there = self.is_there(after, params) & ~flagged
        held = jnp.where(there, state.held + 1, 0)
        return dataclasses.replace(after, held=held), flagged

    def predict(
        self,
        state: Any,
        action: Float[Array, " action"],
        params: Any,
        control_steps: int = 1,
    ) -> Any:
        """Predicts the state under a held action; nothing in this task is random.

        Args:
            state: Current state.
            action: In [-1, 1].
            params: Parameters of the task.
            control_steps: Number of control steps for which the action is held.
        """

        def again(state: Any, _: None) -> tuple[Any, None]:
            return self.moved(state, action, params)[0], None

        return jax.lax.scan(again, state, length=control_steps)[0]

    def cost(
        self, state: Any, action: Float[Array, " action"], params: Any
    ) -> Float[Array, ""]:
        """Smooth cost for planners: sum of the squared residuals [1]."""
        return jnp.sum(self.residuals(state, action, params) ** 2)

    def points(self, dtype: Any) -> Float[Array, "1 points n+1"]:
        """Weights that interpolate node values at the observed points."""
        nodes = np.linspace(0.0, 1.0, self.n_elements + 1)
        points = np.arange(1, N_POINTS + 1) / N_POINTS
        weights = np.maximum(1 - self.n_elements * np.abs(points[:, None] - nodes), 0)
        return jnp.asarray(weights[None], dtype)


def _carried(hand: Hand, coordinates: Array, velocity: Array) -> tuple[Array, Array]:
    """Position and velocity of the held end, world frame [m, m/s]."""
    place, change = jax.jvp(hand.place, (coordinates,), (velocity,))
    return place, change
