"""Trained policies: pytrees that are pure functions from observations to actions."""

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
"""Activation functions of the hidden layers by name, in plain JAX."""
OUTPUTS = {"clip": lambda x: jnp.clip(x, -1, 1), "tanh": jnp.tanh}
"""Functions that bound actions to [-1, 1], by name."""


class Policy(Protocol):
    """Deterministic policy: observation -> action in [-1, 1].

    A callable pytree of plain arrays, made by an `Algorithm`. If it has an attribute
    `action_repeat`, evaluations and replays hold its actions for that number of control
    steps.

    Example:
        >>> env = envs.make("trivial")
        >>> sizes = training.untrained_policy(env)
        >>> policy = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), sizes)
        >>> policy(jnp.zeros((5, 1))).shape  # five observations at once
        (5, 1)
    """

    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them."""


@pytree
class MLPPolicy:
    """Deterministic policy: a multilayer perceptron on normalised observations.

    It needs no network library.

    Example:
        >>> policy = training.untrained_policy(envs.make("tracking"))
        >>> [kernel.shape for kernel, bias in policy.layers]
        [(44, 64), (64, 64), (64, 12)]
    """

    moments: RunningMoments
    """Mean and variance for normalising observations."""
    limit: Float[Array, ""]
    """Bound to which normalised observations are clipped, either way."""
    layers: tuple[tuple[Array, Array], ...]
    """Pairs (kernel, bias) of the layers, kernels of shape (inputs, outputs)."""
    activation: str = static(default="tanh")
    """Activation function between the layers, a name in `ACTIVATIONS`."""
    output: str = static(default="clip")
    """Function that bounds actions to [-1, 1], a name in `OUTPUTS`."""
    action_repeat: int = static(default=1)
    """Control steps for which an action is held, as in training."""

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
