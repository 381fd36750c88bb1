"""Networks of the learners, as flax modules.

If a configuration has a `network`, a function `(role, output_size) -> flax module`,
that function makes the policy and critic networks. Otherwise they are multilayer
perceptrons.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float, Key

from jaxrod.structure import pytree, static
from jaxrod.training.normalisation import RunningMoments, normalise
from jaxrod.training.policy import OUTPUTS
from jaxrod.training.settings import LearnerConfig, NetworkFactory

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": jnp.tanh,
    "relu": nn.relu,
    "elu": nn.elu,
}
"""Activation functions of the hidden layers, by name."""


class MultilayerPerceptron(nn.Module):
    """Dense layers, with an activation after each but the last.

    Attributes:
        hidden_sizes: Widths of the hidden layers.
        output_size: Width of the last layer.
        output_scale: Gain of the orthogonal initial weights of the last layer.
        activation: A name in `ACTIVATIONS`.
        dtype: Dtype of the weights and of the arithmetic.
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
        """Outputs of the network; the last axis of `inputs` holds the components."""

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
    """Normal distribution over actions, with a state-independent standard deviation."""

    mean: nn.Module
    """Network of the mean action."""
    action_size: int
    """Number of actions."""
    initial_log_std: float | Float[Array, ""] = 0.0
    """Initial logarithm of the standard deviation."""
    dtype: DTypeLike = jnp.float32
    """Dtype of the logarithm."""

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> tuple[Float[Array, "*batch action"], Float[Array, " action"]]:
        """Returns the mean action and the logarithm of the standard deviation."""
        mean = self.mean(observation).astype(observation.dtype)
        log_std = self.param(
            "log_std",
            lambda key: jnp.full(self.action_size, self.initial_log_std, self.dtype),
        )
        return mean, log_std


def make_network(
    config: LearnerConfig,
    role: str,
    output_size: int,
    *,
    activation: str,
    dtype: DTypeLike,
) -> nn.Module:
    """The flax module for a role, without weights.

    Args:
        config: Configuration of a learner. Its `network` makes the module; None stands
            for a multilayer perceptron with its `hidden_sizes`. The last layer of a
            policy starts with gain 0.01, so that the first actions are near 0.
        role: "policy" or "critic".
        output_size: Number of outputs of the network.
        activation: Activation function of the perceptron.
        dtype: Dtype of the perceptron.

    Raises:
        ValueError: The result of `network` is no flax module.
    """
    if config.network is None:
        return MultilayerPerceptron(
            config.hidden_sizes,
            output_size,
            output_scale=0.01 if role == "policy" else 1.0,
            activation=activation,
            dtype=dtype,
        )
    return own_network(config.network, role, output_size)


def own_network(network: NetworkFactory, role: str, output_size: int) -> nn.Module:
    """The flax module that a user's function makes for a role, without weights.

    Raises:
        ValueError: The function's result is no flax module.
    """
    module: Any = network(role, output_size)
    if not isinstance(module, nn.Module):
        raise ValueError(
            "network must make flax modules (flax.linen.Module), for "
            f"{role!r} it made a {type(module).__name__}"
        )
    # Weights are stored under the names given here; a module's own name would hide
    # them.
    return module if module.name is None else module.copy(name=None)


def initial_weights(network: nn.Module, key: Key[Array, ""], inputs: Array) -> Any:
    """Initial weights of a network, with the dtype of the inputs.

    Args:
        network: A flax module.
        key: Typed random key.
        inputs: One input, of shape (size,); its values do not matter.

    Raises:
        ValueError: The network has other variables than weights, such as running
            statistics.
    """
    variables = network.init(key, inputs)
    others = sorted(set(variables) - {"params"})
    if others:
        raise ValueError(
            "network must keep weights ('params') and nothing else, got "
            f"{', '.join(others)}"
        )

    def one(leaf: Array) -> Array:
        floating = jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf.astype(inputs.dtype) if floating else leaf

    return jax.tree.map(one, variables.get("params", {}))


def check_outputs(
    network: nn.Module, weights: Any, inputs: Array, output_size: int
) -> None:
    """Raises ValueError unless a network has `output_size` outputs, batched or not.

    Args:
        network: A flax module.
        weights: Parameters of the network.
        inputs: One input, of shape (size,); its values do not matter.
        output_size: Required number of outputs for one input.
    """
    # The second batch size differs from every other dimension.
    for leading in ((), (inputs.size + output_size + 1,)):
        found = jax.eval_shape(
            lambda x: network.apply({"params": weights}, x),
            jax.ShapeDtypeStruct((*leading, inputs.size), inputs.dtype),
        )
        shape = getattr(found, "shape", None)
        if shape != (*leading, output_size):
            raise ValueError(
                f"network must map inputs of shape {(*leading, inputs.size)} to "
                f"outputs of shape {(*leading, output_size)}, "
                f"{type(network).__name__} makes "
                f"{'several arrays' if shape is None else shape} of them"
            )


def layers(params: Mapping[str, Any]) -> tuple[tuple[Array, Array], ...]:
    """Pairs (kernel, bias) of a `MultilayerPerceptron`, first layer first."""
    count = sum(name.startswith("hidden_") for name in params)
    names = [f"hidden_{i}" for i in range(count)] + ["output"]
    return tuple((params[name]["kernel"], params[name]["bias"]) for name in names)


@pytree
class NetworkPolicy:
    """Deterministic policy: a user's network applied to normalised observations.

    Example:
        >>> from flax import linen
        >>> def network(role, outputs):
        ...     hidden = linen.Dense(32), linen.relu
        ...     return linen.Sequential([*hidden, linen.Dense(outputs)])
        >>> config = training.PPOConfig(network=network)
        >>> policy = training.untrained_policy(envs.make("trivial"), config=config)
        >>> type(policy).__name__, policy.action_size
        ('NetworkPolicy', 1)
    """

    moments: RunningMoments
    """Mean and variance for normalising observations."""
    limit: Float[Array, ""]
    """Bound to which normalised observations are clipped, either way."""
    weights: Any
    """Parameters of the network."""
    network: NetworkFactory = static()
    """Function of the user that makes the network."""
    output_size: int = static()
    """Number of outputs of the network."""
    action_size: int = static()
    """Number of actions; they are the first outputs of the network."""
    output: str = static(default="clip")
    """Function that bounds actions to [-1, 1]: "clip" or "tanh"."""
    action_repeat: int = static(default=1)
    """Control steps for which an action is held, as in training."""

    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them."""
        network = own_network(self.network, "policy", self.output_size)
        seen = normalise(self.moments, observation, self.limit)
        output = network.apply({"params": self.weights}, seen).astype(seen.dtype)
        return OUTPUTS[self.output](output[..., : self.action_size])
