"""Trained policies: pure functions from observations to actions that are pytrees."""

from __future__ import annotations

from typing import Protocol

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.structure import pytree, static
from jaxrod.training.normalisation import RunningMoments, normalise

ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": lambda x: jnp.maximum(x, 0),
    "elu": lambda x: jnp.where(x > 0, x, jnp.expm1(jnp.minimum(x, 0))),
}
"""Activation functions by name, without a framework."""
OUTPUTS = {"clip": lambda x: jnp.clip(x, -1, 1), "tanh": jnp.tanh}
"""Bounds of actions by name."""


class Policy(Protocol):
    """Deterministic policy: observation -> action in [-1, 1].

    A pytree of plain arrays, callable, made by an `Algorithm`. Where it has an
    attribute `action_repeat`, evaluations and replays hold its actions for so many
    control steps.
    """

    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them."""


@pytree
class MLPPolicy:
    """Multilayer perceptron on normalised observations; needs no framework."""

    moments: RunningMoments
    """Mean and variance that observations are normalised by."""
    limit: Float[Array, ""]
    """Normalised observations are clipped to +- this."""
    layers: tuple[tuple[Array, Array], ...]
    """(kernel, bias) of each layer, kernel of shape (inputs, outputs)."""
    activation: str = static(default="tanh")
    """A name in `ACTIVATIONS`, between the layers."""
    output: str = static(default="clip")
    """A name in `OUTPUTS`: what bounds the action."""
    action_repeat: int = static(default=1)
    """Control steps for which an action is to be held, as in training."""

    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them."""
        hidden = normalise(self.moments, observation, self.limit)
        for i, (kernel, bias) in enumerate(self.layers):
            if i > 0:
                hidden = ACTIVATIONS[self.activation](hidden)
            bias = jnp.expand_dims(bias, tuple(range(hidden.ndim - 1)))
            hidden = hidden @ kernel + bias
        return OUTPUTS[self.output](hidden)
