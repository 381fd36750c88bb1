"""A policy, its critics, and their gradient steps."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, DTypeLike, Float, Key

from jaxrod.envs import Environment
from jaxrod.structure import pytree
from jaxrod.training.algorithms.device_mean import mean_over_devices
from jaxrod.training.algorithms.replay import Transition
from jaxrod.training.networks import MultilayerPerceptron
from jaxrod.training.settings import Scalar

ACTIVATION = "relu"
"""Activation of all hidden layers, as in the reference implementation."""


@pytree
class Learner:
    """Weights and optimiser states that gradient steps change."""

    weights: dict[str, Any]
    """Weights of the networks and other learned numbers, by name."""
    optimiser: dict[str, Any]
    """States of the optimisers, by name."""


def policy_network(
    hidden_sizes: tuple[int, ...], output_size: int, dtype: DTypeLike
) -> MultilayerPerceptron:
    """The policy network; its output starts near 0, undecided."""
    return MultilayerPerceptron(
        hidden_sizes,
        output_size,
        output_scale=0.01,
        activation=ACTIVATION,
        dtype=dtype,
    )


def critic_values(
    hidden_sizes: tuple[int, ...],
    weights: tuple[Any, ...],
    observation: Float[Array, "batch observation"],
    action: Float[Array, "batch action"],
) -> Float[Array, "critics batch"]:
    """Values of the actions by every critic."""
    inputs = jnp.concatenate([observation, action], axis=-1)
    network = _critic_network(hidden_sizes, inputs.dtype)
    return jnp.stack([network.apply({"params": w}, inputs)[:, 0] for w in weights])


def initial_critics(
    key: Key[Array, ""],
    env: Environment,
    hidden_sizes: tuple[int, ...],
    count: int,
    dtype: DTypeLike,
) -> tuple[Any, ...]:
    """Weights of `count` independent critics."""
    dummy = jnp.zeros(env.observation_size + env.action_size, dtype)
    network = _critic_network(hidden_sizes, dtype)
    return tuple(network.init(k, dummy)["params"] for k in jax.random.split(key, count))


def critic_loss(
    weights: tuple[Any, ...],
    hidden_sizes: tuple[int, ...],
    transition: Transition,
    following_value: Float[Array, " batch"],
    discount: Scalar,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Half the mean squared Bellman error, summed over the critics.

    The target is r + gamma V', and V' is 0 only where the task ended: an episode cut
    short is continued by the value of its final observation.

    Args:
        weights: of the critics.
        hidden_sizes: of the critics.
        transition: a batch.
        following_value: V', the value of what follows; no gradient goes through it.
        discount: gamma.

    Returns:
        The loss, and what to report of it.
    """
    following_value = jnp.where(transition.terminated, 0, following_value)
    target = jax.lax.stop_gradient(transition.reward + discount * following_value)
    value = critic_values(
        hidden_sizes, weights, transition.observation, transition.action
    )
    error = jnp.mean((value - target[None]) ** 2, axis=1)
    report = {"critic_error": jnp.mean(error), "value": jnp.mean(value)}
    return 0.5 * jnp.sum(error), report


def descend(
    learner: Learner,
    name: str,
    gradient: Any,
    learning_rate: Scalar,
    axis_name: str | None,
) -> Learner:
    """One step of Adam on the weights called `name`."""
    gradient = mean_over_devices(gradient, axis_name)
    direction, memory = optimiser().update(gradient, learner.optimiser[name])
    weights = jax.tree.map(
        lambda w, d: w - learning_rate * d, learner.weights[name], direction
    )
    return Learner(
        learner.weights | {name: weights}, learner.optimiser | {name: memory}
    )


def follow(learner: Learner, target: str, name: str, rate: Scalar) -> Learner:
    """Moves the weights called `target` by `rate` of the way to those of `name`."""
    moved = jax.tree.map(
        lambda old, new: old + rate * (new - old),
        learner.weights[target],
        learner.weights[name],
    )
    return dataclasses.replace(learner, weights=learner.weights | {target: moved})


def optimiser() -> optax.GradientTransformation:
    """Adam's direction; the step size comes later."""
    return optax.scale_by_adam()


def _critic_network(
    hidden_sizes: tuple[int, ...], dtype: DTypeLike
) -> MultilayerPerceptron:
    return MultilayerPerceptron(hidden_sizes, 1, activation=ACTIVATION, dtype=dtype)
