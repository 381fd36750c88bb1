"""Twin delayed deep deterministic policy gradients.

A deterministic policy maximises the value of the first of its critics. Three safeguards
keep it from exploiting the errors of the critics: targets use the smaller value of two
critics, target actions carry clipped noise (target policy smoothing), and the policy is
updated less often than the critics.

Source: Fujimoto et al., "Addressing function approximation error in actor-critic
methods", 2018.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxrod.envs import Environment
from jaxrod.structure import pytree, static
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
from jaxrod.training.algorithms.preparation import along_the_run
from jaxrod.training.settings import (
    Scalar,
    check_counts,
    check_fractions,
    check_not_negative,
)


@pytree
class TD3Config(OffPolicyConfig):
    """Settings of TD3; more are in `OffPolicyConfig` and `LearnerConfig`.

    Example:
        >>> config = training.TD3Config(exploration_noise=0.2)
        >>> config.critics, config.policy_delay
        (2, 2)
    """

    policy_delay: int = static(default=2)
    """Critic steps per step of the policy and the targets; divides `gradient_steps`."""
    critics: int = static(default=2)
    """Number of critics; the smallest of their values is used in the target."""
    exploration_noise: Scalar = 0.1
    """Standard deviation of the noise added to actions while acting [1]."""
    exploration_decay: Scalar = 0.0
    """Fraction by which the exploration noise decreases over the run, linearly."""
    target_noise: Scalar = 0.2
    """Standard deviation of the noise of target policy smoothing [1]."""
    target_noise_limit: Scalar = 0.5
    """Bound to which the noise of target policy smoothing is clipped, either way."""


def validate(config: TD3Config, num_devices: int = 1) -> None:
    """Validates a configuration on the host.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_off_policy(config, num_devices)
    check_counts(config, "policy_delay", "critics")
    if config.gradient_steps % config.policy_delay:
        raise ValueError(
            f"policy_delay must divide gradient_steps, {config.gradient_steps}, "
            f"got {config.policy_delay}"
        )
    check_not_negative(
        config, "exploration_noise", "target_noise", "target_noise_limit"
    )
    check_fractions(config, "exploration_decay")


def learner(
    key: Key[Array, ""], env: Environment, config: TD3Config, dtype: Any
) -> Learner:
    """Initial weights of policy, critics and their targets, and Adam states."""
    keys = jax.random.split(key)
    weights: dict[str, Any] = {
        "policy": initial_policy(keys[0], env, config, env.action_size, dtype),
        "critics": initial_critics(keys[1], env, config, config.critics, dtype),
    }
    memory = {name: optimiser().init(part) for name, part in weights.items()}
    targets = {f"target_{name}": part for name, part in weights.items()}
    return Learner(weights | targets, memory)


init = functools.partial(start, make_learner=learner)
"""Function that makes the train state before the first update, see
`off_policy.start`."""


def smoothed_target_action(
    action: Float[Array, "*batch action"],
    noise: Float[Array, "*batch action"],
    spread: Scalar,
    limit: Scalar,
) -> Float[Array, "*batch action"]:
    """Target policy smoothing: adds clipped noise to actions, and clips to [-1, 1].

    Args:
        action: Actions in [-1, 1].
        noise: Standard normal noise.
        spread: Standard deviation of the noise before clipping.
        limit: Bound to which the noise is clipped, either way.
    """
    return jnp.clip(action + jnp.clip(spread * noise, -limit, limit), -1, 1)


def update(
    state: OffPolicyState, axis_name: str | None = None
) -> tuple[OffPolicyState, Metrics]:
    """One update: acts, stores the transitions, and makes the gradient steps.

    Args:
        state: The train state.
        axis_name: Mapped device axis over which the environments are split, if any.
    """
    config: TD3Config = state.config
    dtype = state.environments.observation.dtype
    network = policy_network(config, state.env.action_size, dtype)

    spread = along_the_run(
        state,
        config.exploration_noise,
        config.exploration_noise * (1 - config.exploration_decay),
        dtype,
    )

    def act(weights: Any, observation: Array) -> Array:
        output = network.apply({"params": weights}, observation).astype(dtype)
        return jnp.tanh(output)

    def explore(observation: Array, noise: Array) -> Array:
        action = act(state.learner.weights["policy"], observation)
        return action + spread * noise

    def next_value(weights: dict[str, Any], batch: Batch) -> Array:
        observation = batch.transition.next_observation
        action = smoothed_target_action(
            act(weights["target_policy"], observation),
            batch.noise[0],
            config.target_noise,
            config.target_noise_limit,
        )
        values = critic_values(config, weights["target_critics"], observation, action)
        return jnp.min(values, axis=0)

    def policy_loss(policy: Any, critics: tuple[Any, ...], batch: Batch) -> Array:
        observation = batch.transition.observation
        action = act(policy, observation)
        return -jnp.mean(critic_values(config, critics[:1], observation, action))

    def gradient_step(
        learner: Learner, batches: list[Batch]
    ) -> tuple[Learner, dict[str, Array]]:
        for batch in batches:
            value = next_value(learner.weights, batch)
            learner, report = critic_step(
                learner, config, batch.transition, value, axis_name
            )
        gradient = jax.grad(policy_loss)(
            learner.weights["policy"], learner.weights["critics"], batches[-1]
        )
        learner = apply_gradient(
            learner, "policy", gradient, config.policy_learning_rate, axis_name
        )
        for name in ("policy", "critics"):
            learner = polyak_update(learner, f"target_{name}", name, config.target_rate)
        return learner, report

    state, acted = act_and_store(state, explore, axis_name)
    return learn(
        state,
        gradient_step,
        acted,
        batches_per_step=config.policy_delay,
        noises=1,
        axis_name=axis_name,
    )


TD3 = Algorithm(
    name="td3",
    config_type=TD3Config,
    validate=validate,
    steps_per_update=steps_per_update,
    init=init,
    update=update,
    partition=partition,
    policy=deterministic_policy,
)
"""TD3 as an `Algorithm`, for `jaxrod.training.train`."""


@pytree
class DDPGConfig(TD3Config):
    """Settings of DDPG: those of TD3 with one critic, no delay and no target smoothing.

    The default step size of the policy is also smaller than that of TD3.
    `jaxrod.training.TD3Config` describes the settings.

    Source: Lillicrap et al., "Continuous control with deep reinforcement learning",
    2016.

    Example:
        >>> training.DDPGConfig().critics, training.TD3Config().critics
        (1, 2)
    """

    policy_delay: int = static(default=1)
    critics: int = static(default=1)
    policy_learning_rate: Scalar = 3e-4
    target_noise: Scalar = 0.0


DDPG = dataclasses.replace(TD3, name="ddpg", config_type=DDPGConfig)
"""DDPG as an `Algorithm`, for `jaxrod.training.train`."""
