"""Policy and critic networks of off-policy learners, and their gradient steps."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, DTypeLike, Float, Key

from jaxrod.envs import Environment
from jaxrod.structure import pytree
from jaxrod.training.algorithm import mean_over_devices
from jaxrod.training.algorithms.replay import Transition
from jaxrod.training.networks import check_outputs, initial_weights, make_network
from jaxrod.training.settings import LearnerConfig, Scalar

ACTIVATION = "relu"
"""Activation function of the hidden layers in SAC, TD3 and DDPG."""


@pytree
class Learner:
    """Weights and optimiser states of a learner, which gradient steps change."""

    weights: dict[str, Any]
    """Weights of the networks and other learned numbers, by name."""
    optimiser: dict[str, Any]
    """States of the optimisers, by name of the weights that they change."""


def policy_network(
    config: LearnerConfig, output_size: int, dtype: DTypeLike
) -> nn.Module:
    """The policy network as a flax module; its weights are in the train state."""
    return make_network(
        config, "policy", output_size, activation=ACTIVATION, dtype=dtype
    )


def initial_policy(
    key: Key[Array, ""],
    env: Environment,
    config: LearnerConfig,
    output_size: int,
    dtype: DTypeLike,
) -> Any:
    """Validates the policy network's output size and returns its initial weights."""
    dummy = jnp.zeros(env.observation_size, dtype)
    network = policy_network(config, output_size, dtype)
    weights = initial_weights(network, key, dummy)
    check_outputs(network, weights, dummy, output_size)
    return weights


def critic_values(
    config: LearnerConfig,
    weights: tuple[Any, ...],
    observation: Float[Array, "batch observation"],
    action: Float[Array, "batch action"],
) -> Float[Array, "critics batch"]:
    """Values Q_i of all critics i at actions and normalised observations."""
    inputs = jnp.concatenate([observation, action], axis=-1)
    network = _critic_network(config, inputs.dtype)
    values = [network.apply({"params": w}, inputs)[:, 0] for w in weights]
    return jnp.stack(values).astype(inputs.dtype)


def initial_critics(
    key: Key[Array, ""],
    env: Environment,
    config: LearnerConfig,
    count: int,
    dtype: DTypeLike,
) -> tuple[Any, ...]:
    """Initial weights of `count` critics, drawn independently."""
    dummy = jnp.zeros(env.observation_size + env.action_size, dtype)
    network = _critic_network(config, dtype)
    keys = jax.random.split(key, count)
    weights = tuple(initial_weights(network, k, dummy) for k in keys)
    check_outputs(network, weights[0], dummy, 1)
    return weights


def critic_loss(
    weights: tuple[Any, ...],
    config: LearnerConfig,
    transition: Transition,
    next_value: Float[Array, " batch"],
    discount: Scalar,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Half the mean squared Bellman error, summed over the critics.

    L = 1/2 sum_i mean((Q_i - y)^2) with the target y = r + gamma V'. V' counts as 0
    only where the task ended. Where an episode was truncated it is the value of the
    final observation.

    Args:
        weights: Weights of the critics.
        config: Configuration of the learner, from which the critic network is made.
        transition: A batch of transitions.
        next_value: Value V' of the next observation; no gradient flows through it.
        discount: Discount factor gamma.

    Returns:
        The loss, and for the report the mean squared error and the mean value of the
        critics.
    """
    next_value = jnp.where(transition.terminated, 0, next_value)
    target = jax.lax.stop_gradient(transition.reward + discount * next_value)
    value = critic_values(config, weights, transition.observation, transition.action)
    error = jnp.mean((value - target[None]) ** 2, axis=1)
    report = {"critic_error": jnp.mean(error), "value": jnp.mean(value)}
    return 0.5 * jnp.sum(error), report


def critic_step(
    learner: Learner,
    config: Any,
    transition: Transition,
    next_value: Float[Array, " batch"],
    axis_name: str | None,
) -> tuple[Learner, dict[str, Array]]:
    """One step of Adam on the critics; also returns the report of `critic_loss`."""
    gradient, report = jax.grad(critic_loss, has_aux=True)(
        learner.weights["critics"], config, transition, next_value, config.discount
    )
    rate = config.critic_learning_rate
    return apply_gradient(learner, "critics", gradient, rate, axis_name), report


def apply_gradient(
    learner: Learner,
    name: str,
    gradient: Any,
    learning_rate: Scalar,
    axis_name: str | None,
) -> Learner:
    """One step of Adam on the weights called `name`.

    Args:
        learner: Weights and optimiser states.
        name: Key of the weights in `learner.weights`.
        gradient: Gradient of the loss on this device.
        learning_rate: Step size.
        axis_name: Mapped device axis over which the gradient is averaged; None without
            one.
    """
    gradient = mean_over_devices(gradient, axis_name)
    direction, memory = optimiser().update(gradient, learner.optimiser[name])
    weights = optax.tree.add_scale(learner.weights[name], -learning_rate, direction)
    return Learner(
        learner.weights | {name: weights}, learner.optimiser | {name: memory}
    )


def polyak_update(learner: Learner, target: str, name: str, rate: Scalar) -> Learner:
    """Polyak averaging: w_target <- w_target + rate (w_name - w_target).

    `target` and `name` are keys of `learner.weights`.
    """
    moved = jax.tree.map(
        lambda old, new: old + rate * (new - old),
        learner.weights[target],
        learner.weights[name],
    )
    return dataclasses.replace(learner, weights=learner.weights | {target: moved})


def optimiser() -> optax.GradientTransformation:
    """Adam without a step size, which `apply_gradient` applies."""
    return optax.scale_by_adam()


def _critic_network(config: LearnerConfig, dtype: DTypeLike) -> nn.Module:
    return make_network(config, "critic", 1, activation=ACTIVATION, dtype=dtype)
