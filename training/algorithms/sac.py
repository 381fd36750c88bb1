"""Soft actor-critic: twin critics, a tanh-Gaussian policy, a learned temperature.

Source: Haarnoja et al., "Soft actor-critic algorithms and applications", 2018.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxrod.envs import Environment
from jaxrod.structure import pytree
from jaxrod.training.algorithm import Algorithm, Metrics, steps_per_update
from jaxrod.training.algorithms.actor_critic import (
    Learner,
    apply_gradient,
    critic_step,
    critic_values,
    initial_critics,
    initial_policy,
    optimiser,
    policy_network,
    polyak_update,
)
from jaxrod.training.algorithms.off_policy import (
    Batch,
    OffPolicyConfig,
    OffPolicyState,
    act_and_store,
    check_off_policy,
    deterministic_policy,
    learn,
    partition,
    start,
)
from jaxrod.training.settings import Scalar, check_finite, check_positive

LOG_STD_LIMITS = (-20.0, 2.0)
"""Bounds of the log standard deviation of u, the action before the tanh."""
LARGEST_ENTROPY = math.log(2)
"""Largest entropy of a random number in [-1, 1]: log 2, for a uniform density."""


def split_output(
    output: Float[Array, "*batch outputs"],
) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch action"]]:
    """Splits the output of the policy network into mean and bounded log std."""
    mean, log_std = jnp.split(output, 2, axis=-1)
    return mean, jnp.clip(log_std, *LOG_STD_LIMITS)


def tanh_gaussian(
    mean: Float[Array, "*batch action"],
    log_std: Float[Array, "*batch action"],
    noise: Float[Array, "*batch action"],
) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch"]]:
    """Action a = tanh(u) with u = mean + std z, and the logarithm of its density.

    log p(a) = sum(log N(u) - log(1 - tanh(u)^2)). The last term is evaluated as 2 (log
    2 - u - softplus(-2 u)), which loses no digits where tanh is flat.

    Args:
        mean: Mean of u.
        log_std: Logarithm of the standard deviation of u.
        noise: Standard normal noise z.

    Source: Haarnoja et al., "Soft actor-critic algorithms and applications", 2018,
    appendix C.
    """
    raw = mean + jnp.exp(log_std) * noise
    normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    slope = 2 * (math.log(2) - raw - jax.nn.softplus(-2 * raw))
    return jnp.tanh(raw), jnp.sum(normal - slope, axis=-1)


OUTPUTS_PER_ACTION = 2
"""Outputs of the policy network per action: mean and log standard deviation."""


@pytree
class SACConfig(OffPolicyConfig):
    """Settings of SAC; more are in `OffPolicyConfig` and `LearnerConfig`.

    Example:
        >>> config = training.SACConfig(entropy_per_action=-0.5)
        >>> config.entropy_per_action, config.action_repeat
        (-0.5, 1)
    """

    temperature_learning_rate: Scalar = 3e-3
    """Step size of Adam for the logarithm of the temperature."""
    initial_temperature: Scalar = 0.02
    """Initial temperature: the weight of the entropy in the objective."""
    entropy_per_action: Scalar = -1.0
    """Target entropy of the policy per action component, below log 2. The temperature
    is adapted to reach it."""


def validate(config: SACConfig, num_devices: int = 1) -> None:
    """Validates a configuration on the host.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_off_policy(config, num_devices)
    check_positive(config, "temperature_learning_rate", "initial_temperature")
    check_finite(config, "entropy_per_action")
    if config.entropy_per_action >= LARGEST_ENTROPY:
        raise ValueError(
            "entropy_per_action must be less than log 2 = 0.693, that of actions "
            f"spread evenly over [-1, 1], got {config.entropy_per_action}"
        )


def learner(
    key: Key[Array, ""], env: Environment, config: SACConfig, dtype: Any
) -> Learner:
    """Initial weights of policy, critics, temperature and targets, and Adam states."""
    keys = jax.random.split(key)
    outputs = OUTPUTS_PER_ACTION * env.action_size
    critics = initial_critics(keys[1], env, config, 2, dtype)
    weights = {
        "policy": initial_policy(keys[0], env, config, outputs, dtype),
        "critics": critics,
        "log_temperature": jnp.log(jnp.asarray(config.initial_temperature, dtype)),
    }
    memory = {name: optimiser().init(part) for name, part in weights.items()}
    return Learner(weights | {"target_critics": critics}, memory)


init = functools.partial(start, make_learner=learner)
"""Function that makes the train state before the first update, see
`off_policy.start`."""


def update(
    state: OffPolicyState, axis_name: str | None = None
) -> tuple[OffPolicyState, Metrics]:
    """One update: acts, stores the transitions, and makes the gradient steps.

    Args:
        state: The train state.
        axis_name: Mapped device axis over which the environments are split, if any.
    """
    config: SACConfig = state.config
    dtype = state.environments.observation.dtype
    outputs = OUTPUTS_PER_ACTION * state.env.action_size
    network = policy_network(config, outputs, dtype)

    def act(weights: Any, observation: Array, noise: Array) -> tuple[Array, Array]:
        output = network.apply({"params": weights}, observation).astype(dtype)
        return tanh_gaussian(*split_output(output), noise)

    def next_value(weights: dict[str, Any], batch: Batch) -> Array:
        observation = batch.transition.next_observation
        action, log_prob = act(weights["policy"], observation, batch.noise[0])
        values = critic_values(config, weights["target_critics"], observation, action)
        return jnp.min(values, axis=0) - jnp.exp(weights["log_temperature"]) * log_prob

    def policy_loss(
        policy: Any, weights: dict[str, Any], batch: Batch
    ) -> tuple[Array, dict[str, Array]]:
        observation = batch.transition.observation
        action, log_prob = act(policy, observation, batch.noise[1])
        values = critic_values(config, weights["critics"], observation, action)
        temperature = jnp.exp(weights["log_temperature"])
        loss = jnp.mean(temperature * log_prob - jnp.min(values, axis=0))
        return loss, {"entropy": -jnp.mean(log_prob)}

    def gradient_step(
        learner: Learner, batches: list[Batch]
    ) -> tuple[Learner, dict[str, Array]]:
        (batch,) = batches
        value = next_value(learner.weights, batch)
        learner, report = critic_step(
            learner, config, batch.transition, value, axis_name
        )
        gradient, about_policy = jax.grad(policy_loss, has_aux=True)(
            learner.weights["policy"], learner.weights, batch
        )
        learner = apply_gradient(
            learner, "policy", gradient, config.policy_learning_rate, axis_name
        )
        # The loss of the temperature is linear in its logarithm.
        wanted = config.entropy_per_action * state.env.action_size
        excess = about_policy["entropy"] - wanted
        learner = apply_gradient(
            learner,
            "log_temperature",
            excess,
            config.temperature_learning_rate,
            axis_name,
        )
        learner = polyak_update(
            learner, "target_critics", "critics", config.target_rate
        )
        report |= about_policy
        report["temperature"] = jnp.exp(learner.weights["log_temperature"])
        return learner, report

    policy = state.learner.weights["policy"]
    state, acted = act_and_store(
        state, lambda observation, noise: act(policy, observation, noise)[0], axis_name
    )
    return learn(
        state,
        gradient_step,
        acted,
        batches_per_step=1,
        noises=2,
        axis_name=axis_name,
    )


SAC = Algorithm(
    name="sac",
    config_type=SACConfig,
    validate=validate,
    steps_per_update=steps_per_update,
    init=init,
    update=update,
    partition=partition,
    policy=functools.partial(
        deterministic_policy, outputs_per_action=OUTPUTS_PER_ACTION
    ),
)
"""SAC as an `Algorithm`, for `jaxrod.training.train`."""
