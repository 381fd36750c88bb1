"""The networks of the learners: the one file that knows flax."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": jnp.tanh,
    "relu": nn.relu,
    "elu": nn.elu,
}
"""Activation functions by name."""


class MultilayerPerceptron(nn.Module):
    """Dense layers, an activation after each but the last.

    Attributes:
        hidden_sizes: widths of the hidden layers.
        output_size: width of the last layer.
        output_scale: gain of the orthogonal initial weights of the last layer.
        activation: a name in `ACTIVATIONS`.
        dtype: type of the weights and of the arithmetic.
    """

    hidden_sizes: tuple[int, ...]
    output_size: int
    output_scale: float = 1.0
    activation: str = "tanh"
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self, inputs: Float[Array, "*batch inputs"]
    ) -> Float[Array, "*batch outputs"]:
        """Applies the network to the last axis."""

        def dense(size: int, gain: float, name: str) -> nn.Dense:
            return nn.Dense(
                size,
                kernel_init=nn.initializers.orthogonal(gain),
                dtype=self.dtype,
                param_dtype=self.dtype,
                name=name,
            )

        hidden = inputs
        for i, size in enumerate(self.hidden_sizes):
            layer = dense(size, 2**0.5, f"hidden_{i}")
            hidden = ACTIVATIONS[self.activation](layer(hidden))
        return dense(self.output_size, self.output_scale, "output")(hidden)


class GaussianPolicy(nn.Module):
    """Normal distribution over actions whose spread does not depend on the state.

    The mean starts near 0 (gain 0.01), so that learning begins undecided.

    Attributes:
        hidden_sizes: widths of the hidden layers of the mean.
        action_size: number of actions.
        initial_log_std: logarithm of the standard deviation at the start.
        dtype: type of the weights and of the arithmetic.
    """

    hidden_sizes: tuple[int, ...]
    action_size: int
    initial_log_std: float | Float[Array, ""] = 0.0
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> tuple[Float[Array, "*batch action"], Float[Array, " action"]]:
        """Returns the mean action and the logarithm of the standard deviation."""
        mean = MultilayerPerceptron(
            self.hidden_sizes,
            self.action_size,
            output_scale=0.01,
            dtype=self.dtype,
            name="mean",
        )(observation)
        log_std = self.param(
            "log_std",
            lambda key: jnp.full(self.action_size, self.initial_log_std, self.dtype),
        )
        return mean, log_std


def layers(params: Mapping[str, Any]) -> tuple[tuple[Array, Array], ...]:
    """Weights of a `MultilayerPerceptron` as (kernel, bias), first layer first."""
    count = sum(name.startswith("hidden_") for name in params)
    names = [f"hidden_{i}" for i in range(count)] + ["output"]
    return tuple((params[name]["kernel"], params[name]["bias"]) for name in names)
