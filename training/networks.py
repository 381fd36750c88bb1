"""Networks of the learners, as flax modules.

If a configuration has a `network`, a function `(role, output_size) -> network`, that
function makes the policy and critic networks: flax modules, or pairs of functions.
Otherwise they are multilayer perceptrons, which may have a gated recurrent unit.

A module with a memory has two methods:
- `initial_memory(batch, dtype) -> memory`: memory at the start of an episode, any
  pytree of arrays whose first axes are `batch`;
- `__call__(inputs, memory, starts=None) -> (outputs, memory)`: outputs for a sequence
  of inputs, shape (steps, *batch, inputs), and the memory after it. Where `starts`,
  shape (steps, *batch), is true, an episode begins with this input.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, DTypeLike, Float, Key

from jaxrod.structure import pytree, static
from jaxrod.training.normalisation import RunningMoments, normalise
from jaxrod.training.policy import bounded
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
    dtype: DTypeLike | None = jnp.float32

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


class RecurrentPerceptron(nn.Module):
    """Gated recurrent unit, and a perceptron that sees its state beside the inputs.

    With inputs x and the state h, which is 0 at the start of an episode,

        r = sigmoid(W_r x + U_r h + b_r),  z = sigmoid(W_z x + U_z h + b_z),
        n = tanh(W_n x + b_n + r (U_n h + c)),  h' = (1 - z) n + z h.

    Attributes:
        units: Number of components of h.
        perceptron: Network of the outputs; its inputs are x and h'.
        dtype: Dtype of the weights and of the arithmetic; None for that of the inputs.

    Source: Cho et al., "Learning phrase representations using RNN encoder-decoder for
    statistical machine translation", 2014.
    """

    units: int
    perceptron: MultilayerPerceptron
    dtype: DTypeLike | None = jnp.float32

    def initial_memory(self, batch: tuple[int, ...], dtype: DTypeLike) -> Array:
        """State h = 0 of a batch, shape (*batch, units)."""
        return jnp.zeros((*batch, self.units), dtype)

    @nn.compact
    def __call__(
        self,
        inputs: Float[Array, "steps *batch inputs"],
        memory: Float[Array, "*batch units"],
        starts: Bool[Array, "steps *batch"] | None = None,
    ) -> tuple[Float[Array, "steps *batch outputs"], Float[Array, "*batch units"]]:
        """Outputs for a sequence, and the state after it."""
        kernel_init = nn.initializers.orthogonal()
        kernels = [
            self.param(f"recurrent_{gate}", kernel_init, 2 * (self.units,), self.dtype)
            for gate in ("reset", "update", "new")
        ]
        kernel = jnp.concatenate(kernels, axis=1)
        shift = self.param("shift", nn.initializers.zeros, (self.units,), self.dtype)
        # The products of all inputs are one product, outside of the loop over time.
        driven = nn.Dense(
            3 * self.units,
            kernel_init=kernel_init,
            dtype=self.dtype,
            param_dtype=self.dtype,
            name="input",
        )(inputs)

        def step(state: Array, now: tuple[Array, Array | None]) -> tuple[Array, Array]:
            gates, start = now
            if start is not None:
                state = jnp.where(start[..., None], 0, state)
            driven_r, driven_z, driven_n = jnp.split(gates, 3, axis=-1)
            recalled_r, recalled_z, recalled_n = jnp.split(state @ kernel, 3, axis=-1)
            reset = nn.sigmoid(driven_r + recalled_r)
            kept = nn.sigmoid(driven_z + recalled_z)
            shifted = recalled_n + jnp.expand_dims(shift, tuple(range(state.ndim - 1)))
            new = jnp.tanh(driven_n + reset * shifted)
            state = ((1 - kept) * new + kept * state).astype(state.dtype)
            return state, state

        memory, states = jax.lax.scan(step, memory, (driven, starts))
        seen = jnp.concatenate([inputs, states.astype(inputs.dtype)], axis=-1)
        return self.perceptron(seen), memory


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

    def initial_memory(self, batch: tuple[int, ...], dtype: DTypeLike) -> Any:
        """Memory of the network of the mean; None if it has none."""
        return initial_memory(self.mean, batch, dtype)

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*batch observation"], *recalled: Any
    ) -> tuple[Float[Array, "*batch action"], Float[Array, " action"]]:
        """Returns the mean action and the logarithm of the standard deviation.

        `recalled` are memory and starts, for a network of the mean that has a memory.
        """
        output = self.mean(observation, *recalled)
        mean = (output[0] if recalled else output).astype(observation.dtype)
        log_std = self.param(
            "log_std",
            lambda key: jnp.full(self.action_size, self.initial_log_std, self.dtype),
        )
        return mean, log_std


class FunctionPair(nn.Module):
    """Pair of functions as a flax module.

    Attributes:
        make: Function (key, input) -> weights, any pytree of arrays; the input is zero.
        call: Function (weights, inputs) -> outputs, for any leading axes.
    """

    make: Callable[[Array, Array], Any]
    call: Callable[[Any, Array], Array]

    @nn.compact
    def __call__(self, inputs: Float[Array, "*batch inputs"]) -> Array:
        """Outputs of the network; the last axis of `inputs` holds the components."""
        one = jnp.zeros(inputs.shape[-1:], inputs.dtype)
        return self.call(self.param("weights", self.make, one), inputs)


@dataclasses.dataclass(frozen=True)
class BuiltInNetwork:
    """Function that makes the built-in networks, as a `NetworkFactory`.

    The last layer of a policy starts with gain 0.01, so that the first actions are near
    0.
    """

    hidden_sizes: tuple[int, ...]
    """Widths of the hidden layers of the perceptron."""
    units: int
    """Number of recurrent units; 0 for a perceptron alone."""
    activation: str
    """Activation function of the perceptron, a name in `ACTIVATIONS`."""
    dtype: DTypeLike | None = None
    """Dtype of the weights and of the arithmetic; None for that of the inputs."""

    def __call__(self, role: str, output_size: int) -> nn.Module:
        """The network for a role, "policy" or "critic"."""
        perceptron = MultilayerPerceptron(
            self.hidden_sizes,
            output_size,
            output_scale=0.01 if role == "policy" else 1.0,
            activation=self.activation,
            dtype=self.dtype,
        )
        if not self.units:
            return perceptron
        return RecurrentPerceptron(self.units, perceptron, dtype=self.dtype)


def network_factory(
    config: LearnerConfig,
    role: str,
    activation: str,
    dtype: DTypeLike | None = None,
) -> NetworkFactory:
    """The function that makes the network for a role: the user's, or the built-in one.

    Args:
        config: Configuration of a learner.
        role: "policy" or "critic".
        activation: Activation function of the built-in network.
        dtype: Dtype of the built-in network; None for that of its inputs.
    """
    if config.network is not None:
        return config.network
    units = config.recurrent_units(role)
    return BuiltInNetwork(config.hidden_sizes, units, activation, dtype)


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
            for the built-in network.
        role: "policy" or "critic".
        output_size: Number of outputs of the network.
        activation: Activation function of the built-in network.
        dtype: Dtype of the built-in network.

    Raises:
        ValueError: The result of `network` is no network.
    """
    factory = network_factory(config, role, activation, dtype)
    return own_network(factory, role, output_size)


def own_network(network: NetworkFactory, role: str, output_size: int) -> nn.Module:
    """The flax module that a user's function makes for a role, without weights.

    Raises:
        ValueError: The function's result is no network.
    """
    module: Any = network(role, output_size)
    if isinstance(module, tuple) and len(module) == 2 and all(map(callable, module)):
        module = FunctionPair(*module)
    if not isinstance(module, nn.Module):
        raise ValueError(
            "network must make flax modules (flax.linen.Module) or pairs of functions "
            f"(init, apply), but for {role!r} it made a {type(module).__name__}"
        )
    # Weights are stored under the names given here; a module's own name would hide
    # them.
    return module if module.name is None else module.copy(name=None)


def initial_memory(network: Any, batch: tuple[int, ...], dtype: DTypeLike) -> Any:
    """Memory of a network at the start of a batch of episodes; None without memory."""
    make = getattr(network, "initial_memory", None)
    return None if make is None else make(batch, dtype)


def apply_once(
    network: nn.Module, weights: Any, inputs: Float[Array, "*batch size"], memory: Any
) -> tuple[Float[Array, "*batch outputs"], Any]:
    """Outputs for one input of each sequence, and the memory after it.

    Args:
        network: A flax module.
        weights: Weights of the network.
        inputs: The inputs.
        memory: Memory before the inputs; None for a network without memory.
    """
    if memory is None:
        return network.apply({"params": weights}, inputs), None
    outputs, memory = network.apply({"params": weights}, inputs[None], memory)
    return outputs[0], memory


def apply_to_samples(
    network: nn.Module,
    weights: Any,
    inputs: Float[Array, "steps batch size"],
    memory: Any,
    starts: Bool[Array, "steps batch"],
) -> Float[Array, "samples outputs"]:
    """Outputs for all inputs of a batch of sequences, step after step.

    Args:
        network: A flax module.
        weights: Weights of the network.
        inputs: The inputs.
        memory: Memory before the first step; None for a network without memory.
        starts: Whether an episode begins with an input.
    """
    if memory is None:
        flat = inputs.reshape(-1, inputs.shape[-1])
        return network.apply({"params": weights}, flat)
    outputs, _ = network.apply({"params": weights}, inputs, memory, starts)
    return outputs.reshape(-1, outputs.shape[-1])


def initial_weights(
    network: nn.Module, key: Key[Array, ""], inputs: Array, *, recurrent: bool = False
) -> Any:
    """Initial weights of a network, with the dtype of the inputs.

    Args:
        network: A flax module.
        key: Typed random key.
        inputs: One input, of shape (size,); its values do not matter.
        recurrent: Whether the network may have a memory.

    Raises:
        ValueError: The network has other variables than weights, such as running
            statistics, or a memory for which the learner has no use.
    """
    memory = initial_memory(network, (), inputs.dtype)
    if memory is None:
        variables = network.init(key, inputs)
    elif recurrent:
        variables = network.init(key, inputs[None], memory)
    else:
        raise ValueError(
            "network must have no memory (initial_memory): only ppo trains networks "
            "with memory"
        )
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
        memory = initial_memory(network, leading, inputs.dtype)
        found, after = jax.eval_shape(
            lambda x, memory: apply_once(network, weights, x, memory),
            jax.ShapeDtypeStruct((*leading, inputs.size), inputs.dtype),
            memory,
        )
        shape = getattr(found, "shape", None)
        if shape != (*leading, output_size):
            raise ValueError(
                f"network must map inputs of shape {(*leading, inputs.size)} to "
                f"outputs of shape {(*leading, output_size)}, but "
                f"{type(network).__name__} returns "
                f"{'several arrays' if shape is None else shape}"
            )
        before = jax.eval_shape(lambda memory: memory, memory)
        if before != after:
            raise ValueError(
                "network must keep the form of its memory: "
                f"{type(network).__name__} turns {before} into {after}"
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
    action_std: Float[Array, " action"] | None = None
    """Standard deviation of the noise in training, as in `MLPPolicy`."""
    quiet_action: str = static(default="median")
    """Action without noise, "median" or "mean", as in `MLPPolicy`."""

    def __call__(
        self,
        observation: Float[Array, "*batch observation"],
        noise: Float[Array, "*batch action"] | None = None,
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them.

        `noise` is added before the action is bounded.
        """
        network = own_network(self.network, "policy", self.output_size)
        seen = normalise(self.moments, observation, self.limit)
        output = network.apply({"params": self.weights}, seen).astype(seen.dtype)
        return bounded(self, output[..., : self.action_size], noise)


@pytree
class RecurrentPolicy:
    """Deterministic policy with memory: a network that remembers what it has seen.

    It is a `jaxrod.envs.MemoryPolicy` that does not look at the state.

    Example:
        >>> env, config = envs.make("trivial"), training.PPOConfig(gru_units=8)
        >>> sizes = training.untrained_policy(env, config=config)
        >>> policy = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), sizes)
        >>> seen = jnp.zeros((5, 1))  # one observation of each of five episodes
        >>> action, memory = policy.act(policy.init(seen, None), seen, None)
        >>> action.shape, memory.shape
        ((5, 1), (5, 8))
    """

    moments: RunningMoments
    """Mean and variance for normalising observations."""
    limit: Float[Array, ""]
    """Bound to which normalised observations are clipped, either way."""
    weights: Any
    """Parameters of the network."""
    network: NetworkFactory = static()
    """Function that makes the network."""
    action_size: int = static()
    """Number of actions, which are the outputs of the network."""
    output: str = static(default="clip")
    """Function that bounds actions to [-1, 1]: "clip" or "tanh"."""
    action_repeat: int = static(default=1)
    """Control steps for which an action is held, as in training."""
    action_std: Float[Array, " action"] | None = None
    """Standard deviation of the noise in training, as in `MLPPolicy`."""
    quiet_action: str = static(default="median")
    """Action without noise, "median" or "mean", as in `MLPPolicy`."""

    def init(self, observation: Float[Array, "batch observation"], state: Any) -> Any:
        """Memory at the start of a batch of episodes."""
        del state
        network = own_network(self.network, "policy", self.action_size)
        return initial_memory(network, observation.shape[:-1], observation.dtype)

    def act(
        self,
        memory: Any,
        observation: Float[Array, "batch observation"],
        state: Any,
        noise: Float[Array, "batch action"] | None = None,
    ) -> tuple[Float[Array, "batch action"], Any]:
        """Returns the actions, and the memory after the observations.

        `noise` is added before the actions are bounded.
        """
        del state
        network = own_network(self.network, "policy", self.action_size)
        seen = normalise(self.moments, observation, self.limit)
        output, memory = apply_once(network, self.weights, seen, memory)
        return bounded(self, output.astype(seen.dtype), noise), memory
