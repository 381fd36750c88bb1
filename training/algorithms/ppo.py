"""Proximal policy optimisation with a clipped objective.

Source: Schulman et al., "Proximal policy optimization algorithms", 2017.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key

from jaxrod.envs import Environment
from jaxrod.envs.wrappers import EnvironmentWrapper
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import (
    Algorithm,
    Metrics,
    mean_over_devices,
    steps_per_update,
)
from jaxrod.training.algorithms.on_policy import (
    ACTIVATION,
    Experience,
    OnPolicyConfig,
    OnPolicyState,
    check_on_policy,
    deterministic_policy,
    gather_experience,
    gaussian_entropy,
    log_density,
    partition,
    policy_network,
    standardised,
    start,
    value_network,
)
from jaxrod.training.algorithms.preparation import along_the_run
from jaxrod.training.networks import apply_to_samples, initial_memory, make_network
from jaxrod.training.settings import (
    Scalar,
    check_counts,
    check_not_negative,
    check_positive,
    check_units,
)


@pytree
class PPOConfig(OnPolicyConfig):
    """Settings of PPO; more are in `OnPolicyConfig` and `LearnerConfig`.

    Example:
        >>> config = training.PPOConfig(num_envs=64, learning_rate=3e-4)
        >>> config.num_envs * config.rollout_steps // config.minibatches  # decisions
        1024
    """

    epochs: int = static(default=8)
    """Number of passes over the experience of one update."""
    minibatches: int = static(default=8)
    """Number of gradient steps in one pass; divides `rollout_steps`, or with a memory
    the environments of one device."""
    gru_units: int = static(default=0)
    """Number of gated recurrent units of the built-in networks, by which the policy
    remembers what it has seen in an episode; 0 for a policy without memory."""
    privileged_critic: bool = static(default=False)
    """Whether the critic also sees the task's privileged observation, see
    `jaxrod.envs.Privileged`. The built-in critic then has no memory."""
    learning_rate: Scalar = 1e-3
    """Step size of Adam at the start."""
    final_learning_rate: Scalar = 5e-5
    """Step size of Adam at the end of the run; it falls linearly."""
    clip: Scalar = 0.2
    """Clipping range epsilon: the probability ratio is clipped to 1 +- epsilon."""
    discount: Scalar = 0.98
    value_weight: Scalar = 0.5
    """Weight of the value loss in the total loss."""
    gradient_norm: Scalar = 0.5
    """Largest norm of a gradient; longer gradients are scaled down to it."""

    def recurrent_units(self, role: str) -> int:
        """Number of recurrent units of a built-in network."""
        return 0 if role == "critic" and self.privileged_critic else self.gru_units


def validate(config: PPOConfig, num_devices: int = 1) -> None:
    """Checks a configuration on the host.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_on_policy(config, num_devices)
    check_counts(config, "epochs", "minibatches")
    check_units("gru_units", config.gru_units)
    if not isinstance(config.privileged_critic, bool):
        raise ValueError(
            f"privileged_critic must be true or false, got {config.privileged_critic!r}"
        )
    if _has_memory(config):
        of, samples = "the environments of a device", config.num_envs // num_devices
    else:
        of, samples = "rollout_steps", config.rollout_steps
    if samples % config.minibatches:
        raise ValueError(
            f"minibatches must divide {of}, {samples}, got {config.minibatches}"
        )
    check_positive(
        config, "learning_rate", "final_learning_rate", "clip", "gradient_norm"
    )
    check_not_negative(config, "value_weight")


def _has_memory(config: PPOConfig) -> bool:
    """Whether the policy or the critic has a memory."""
    made = (
        make_network(config, role, 1, activation=ACTIVATION, dtype=float)
        for role in ("policy", "critic")
    )
    return any(initial_memory(network, (), float) is not None for network in made)


def _optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Gradient clipping, then Adam without a step size, which `update` applies."""
    return optax.chain(
        optax.clip_by_global_norm(config.gradient_norm),
        optax.scale_by_adam(eps=1e-5),
    )


@dataclasses.dataclass(frozen=True)
class WithPrivileged(EnvironmentWrapper):
    """Wrapper that appends the privileged observation to the observation.

    Raises:
        ValueError: The environment has no privileged observation.
    """

    env: Environment
    """The wrapped environment, which has a method `privileged_observation`."""

    def __post_init__(self) -> None:
        """Checks that there is a privileged observation."""
        if getattr(self.env, "privileged_observation", None) is None:
            raise ValueError(
                f"{type(self.env).__name__} has no privileged_observation "
                "(jaxrod.envs.Privileged): set privileged_critic to false"
            )

    @functools.cached_property
    def observation_size(self) -> int:
        """Length of the observation with the privileged one."""
        with jax.ensure_compile_time_eval():
            params = self.env.default_params()
        start = jax.eval_shape(self.reset, jax.random.key(0), params)
        size: int = start[0].shape[0]
        return size

    def reset(self, key: Key[Array, ""], params: Any) -> tuple[Array, Any]:
        """Starts an episode; the privileged observation comes last."""
        observation, state = self.env.reset(key, params)
        return self._extended(observation, state, params), state

    def step(
        self,
        key: Key[Array, ""],
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> Any:
        """Advances the environment; the privileged observation comes last."""
        observation, state, *more = self.env.step(key, state, action, params)
        return (self._extended(observation, state, params), state, *more)

    def _extended(self, observation: Array, state: Any, params: Any) -> Array:
        """The observation, and after it the privileged one."""
        env: Any = self.env
        hidden = env.privileged_observation(state, params)
        return jnp.concatenate([observation, hidden.astype(observation.dtype)])


def init(
    key: Key[Array, ""],
    env: Environment,
    config: PPOConfig,
    env_params: Any = None,
    total_steps: int | Int[Array, ""] = 10_000_000,
) -> OnPolicyState:
    """The train state before the first update; pure, so it can be vmapped over keys.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment, with a privileged observation if the critic shall see it.
        config: Settings; their numbers can be vmapped, too.
        env_params: Parameters of the environment, None for its defaults.
        total_steps: Control steps over which the learning rate falls.

    Raises:
        ValueError: A network cannot be used, or the environment has no privileged
            observation.
    """
    return start(
        key,
        WithPrivileged(env) if config.privileged_critic else env,
        config,
        env_params,
        total_steps,
        make_optimiser=_optimiser,
        recurrent=True,
        actor_size=env.observation_size,
    )


def update(
    state: OnPolicyState, axis_name: str | None = None
) -> tuple[OnPolicyState, Metrics]:
    """One update: acts, estimates advantages, and ascends the clipped objective.

    A minibatch is a random set of time steps, each with all environments. So it does
    not depend on how the environments are split over devices, its samples come from
    independent environments, and it is read in long contiguous blocks of memory.

    With a memory it is a random set of environments, each with all time steps: the
    gradient goes back through time to the start of the rollout or of the episode.

    Args:
        state: The train state.
        axis_name: Mapped axis over which the environments are spread, if any.
    """
    config: PPOConfig = state.config
    state, experience, episodes = gather_experience(state, axis_name)
    optimiser = _optimiser(config)
    recurrent = bool(jax.tree.leaves(state.memory))
    axis = 1 if recurrent else 0
    samples = dataclasses.replace(experience, memory={})
    learning_rate = along_the_run(
        state,
        config.learning_rate,
        config.final_learning_rate,
        experience.advantage.dtype,
    )

    def minibatch_step(
        carry: tuple[Any, Any], chosen: tuple[Int[Array, " rows"], Array]
    ) -> tuple[tuple[Any, Any], dict[str, Array]]:
        weights, moments = carry
        rows, advantage = chosen
        batch = jax.tree.map(lambda leaf: _chosen(leaf, rows, axis), samples)
        memory = jax.tree.map(lambda leaf: leaf[rows], experience.memory)
        batch = dataclasses.replace(batch, advantage=advantage, memory=memory)
        objective = functools.partial(_loss, state=state)
        gradient, report = jax.grad(objective, has_aux=True)(weights, batch)
        gradient = mean_over_devices(gradient, axis_name)
        report["gradient_norm"] = optax.tree.norm(gradient)
        direction, moments = optimiser.update(gradient, moments)
        weights = optax.tree.add_scale(weights, -learning_rate, direction)
        return (weights, moments), report

    def epoch(carry: Any, key: Key[Array, ""]) -> tuple[Any, dict[str, Array]]:
        rows = jax.random.permutation(key, experience.advantage.shape[axis])
        rows = rows.reshape(config.minibatches, -1)
        advantage = jnp.moveaxis(_chosen(experience.advantage, rows, axis), axis, 0)
        advantage = standardised(advantage, (1, 2), axis_name)
        return jax.lax.scan(minibatch_step, carry, (rows, advantage))

    shuffle_key, epochs_key = jax.random.split(state.shuffle_key)
    (weights, moments), reports = jax.lax.scan(
        epoch,
        (state.weights, state.optimiser),
        jax.random.split(epochs_key, config.epochs),
    )
    scalars = jax.tree.map(jnp.mean, reports)
    scalars |= {
        "value_error": jnp.mean((experience.value_target - experience.value) ** 2),
        "return_mean": jnp.mean(experience.value_target),
        "reward_mean": jnp.mean(experience.reward),
        "action_std": jnp.mean(jnp.exp(weights["policy"]["log_std"])),
        "learning_rate": learning_rate,
    }
    state = dataclasses.replace(
        state,
        weights=weights,
        optimiser=moments,
        shuffle_key=shuffle_key,
        updates=state.updates + 1,
    )
    return state, Metrics(mean_over_devices(scalars, axis_name), episodes)


def _chosen(leaf: Array, rows: Int[Array, "*rows"], axis: int) -> Array:
    """Entries `rows` of the first or the second axis of a leaf."""
    return leaf[rows] if axis == 0 else leaf[:, rows]


def _loss(
    weights: dict[str, Any],
    batch: Experience,
    state: OnPolicyState,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Loss of PPO on a batch, and its terms for the report.

    L = -mean(min(q A, clip(q, 1 - clip, 1 + clip) A))
    + value_weight mean((V - value_target)^2) / 2 - entropy_weight H,
    with the probability ratio q, the advantage A and the entropy H. Of the `state`
    only what stays the same in an update is used.
    """
    config: PPOConfig = state.config
    dtype = batch.observation.dtype
    seen, starts, memory = batch.observation, batch.starts, batch.memory
    batch = jax.tree.map(
        lambda leaf: leaf.reshape(-1, *leaf.shape[2:]),
        dataclasses.replace(batch, memory={}),
    )
    own, log_std = weights["policy"].get("mean", {}), weights["policy"]["log_std"]
    network = policy_network(state.env, config, dtype).mean
    shown = seen[..., : state.actor_size]
    mean = apply_to_samples(network, own, shown, memory["policy"], starts)
    mean = mean.astype(dtype)
    standardised = (batch.action - mean) * jnp.exp(-log_std)[None]
    log_ratio = log_density(standardised, log_std) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    gain = jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))

    network = value_network(config, dtype)
    value = apply_to_samples(network, weights["value"], seen, memory["value"], starts)
    value = value[..., 0].astype(dtype)
    value_loss = 0.5 * jnp.mean((value - batch.value_target) ** 2)
    entropy = gaussian_entropy(log_std)
    loss = -gain + config.value_weight * value_loss - config.entropy_weight * entropy
    report = {
        "policy_gain": gain,
        "value_loss": value_loss,
        "entropy": entropy,
        # Schulman's estimator: unbiased, never negative, with little variance.
        "kl": jnp.mean(ratio - 1 - log_ratio),
        "clipped": jnp.mean((jnp.abs(ratio - 1) > config.clip).astype(loss.dtype)),
    }
    return loss, report


PPO = Algorithm(
    name="ppo",
    config_type=PPOConfig,
    validate=validate,
    steps_per_update=steps_per_update,
    init=init,
    update=update,
    partition=partition,
    policy=deterministic_policy,
)
"""PPO as an `Algorithm`, for `jaxrod.training.train`."""
