r"""Short-horizon actor-critic: the policy gradient is taken through the simulation.

All environments act for a short window of $h$ decisions. The return in the window plus
the value of the last state,

$$J = \sum_{k<h} \gamma^k r_k + \gamma^h V(s_h),$$

is differentiated through the simulation with respect to the policy's weights. Each
window, and each episode that starts within it, contributes one such sum. The critic V
is fitted to lambda returns, which are computed with a target critic that follows V
slowly. With V = 0 this is the analytic policy gradient (APG). The terms $r_k$ are minus
the task's smooth cost, or the reward; discontinuities of the reward have no gradient.

If the gradient is not finite, the policy step is skipped, and the metric `skipped`
reports it.

Source: Xu et al., "Accelerated policy learning with parallel differentiable
simulation", 2022.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxrod.envs import Environment, EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.envs.wrappers import EnvironmentWrapper
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import (
    Algorithm,
    Metrics,
    mean_over_devices,
    steps_per_update,
)
from jaxrod.training.algorithms.on_policy import (
    OnPolicyConfig,
    OnPolicyState,
    action_noise,
    check_on_policy,
    deterministic_policy,
    fit_value,
    gaussian_entropy,
    generalised_advantages,
    partition,
    policy_network,
    predicted_value,
    start,
    value_network,
    with_bounded_noise,
)
from jaxrod.training.algorithms.preparation import along_the_run, restart_phase
from jaxrod.training.normalisation import batch_moments, merge_moments, normalise
from jaxrod.training.settings import (
    Scalar,
    check_counts,
    check_fractions,
    check_positive,
)


@pytree
class Window:
    """Samples of one window of `rollout_steps` decisions in every environment."""

    observation: Float[Array, "steps num_envs observation"]
    """Normalised observation from which the action was chosen."""
    final_observation: Float[Array, "steps num_envs observation"]
    """Normalised observation after the decision, before any restart."""
    raw: Float[Array, "steps num_envs observation"]
    """Observation from which the action was chosen, not normalised."""
    earned: Float[Array, "steps num_envs"]
    """Term r_k of the objective: -reward_scale * action_repeat * (cost after the
    decision), or reward_scale * reward."""
    reward: Float[Array, "steps num_envs"]
    """Reward of the decision, not scaled, for the report."""
    terminated: Bool[Array, "steps num_envs"]
    """Whether the task ended in this step."""
    done: Bool[Array, "steps num_envs"]
    """Whether the episode ended in this step, for any reason."""
    episodes: EpisodeRecord
    """Results of the complete episodes that ended."""


def acted(
    state: OnPolicyState, weights: Any, noise: Float[Array, "steps num_envs action"]
) -> tuple[VectorState, Window]:
    """Runs the policy for one window with the given weights.

    Returns the environments after the window, and the window's samples. Both are
    differentiable in the weights.
    """
    config = state.config
    environment = VectorEnvironment(state.env)
    network = policy_network(state.env, config, noise.dtype)
    phase = restart_phase(state.env, config, state.updates)

    def normalised(observation: Array) -> Array:
        return normalise(state.moments, observation, config.observation_limit)

    def decide(environments: VectorState, noise: Array) -> tuple[VectorState, Window]:
        seen = normalised(environments.observation)
        mean, log_std = network.apply({"params": weights}, seen)
        action = jnp.tanh(mean + jnp.exp(log_std)[None] * noise)
        following, outcome = environment.step(
            environments, action, state.env_params, restart_phase=phase
        )
        earned = outcome.reward
        if config.objective == "cost":
            cost = outcome.info["cost"]
            # The cost of a broken arm is unknown, so it counts as zero; the arm is
            # truncated.
            cost = jnp.where(jnp.isfinite(cost), cost, 0)
            earned = -config.action_repeat * cost
        return following, Window(
            observation=seen,
            final_observation=normalised(outcome.final_observation),
            raw=environments.observation,
            earned=config.reward_scale * earned,
            reward=outcome.reward,
            terminated=outcome.terminated,
            done=outcome.terminated | outcome.truncated,
            episodes=outcome.episodes,
        )

    remembered = jax.checkpoint(decide, prevent_cse=False)
    return jax.lax.scan(remembered, state.environments, noise)


def objective(
    window: Window, following: Float[Array, "steps num_envs"], discount: Scalar
) -> Float[Array, ""]:
    """Objective: sum of J over the starts of windows and of episodes, per decision.

    J is the sum of gamma^k r_k from such a start to the end of the window or of the
    episode, plus the discounted value there (0 if the task ended).

    Args:
        window: Samples of the window.
        following: Value of the observation after each decision, before any restart.
        discount: Discount factor gamma.

    Returns:
        The sum of J divided by steps * num_envs.
    """

    def backwards(later: Array, step: Any) -> tuple[Array, Array]:
        earned, terminated, done, value = step
        after = jnp.where(done, jnp.where(terminated, 0, value), later)
        total = earned + discount * after
        return total, total

    steps = (window.earned, window.terminated, window.done, following)
    totals = jax.lax.scan(backwards, following[-1], steps, reverse=True)[1]
    begins = jnp.concatenate([jnp.ones_like(window.done[:1]), window.done[:-1]])
    return jnp.sum(jnp.where(begins, totals, 0)) / window.done.size


def target_value(
    state: OnPolicyState, observation: Float[Array, "*batch observation"]
) -> Float[Array, "*batch"]:
    """Target critic's values of normalised observations; 0 without a critic."""
    if not state.config.critic:
        return jnp.zeros_like(observation[..., 0])
    network = value_network(state.config, observation.dtype)
    return predicted_value(network, state.weights["target"], observation)


@dataclasses.dataclass(frozen=True)
class WithCost(EnvironmentWrapper):
    """Wrapper that adds the cost after each step to `info["cost"]`.

    Raises:
        ValueError: The environment has no cost.
    """

    env: Environment
    """The wrapped environment, which has a method `cost`."""

    def __post_init__(self) -> None:
        """Raises a ValueError if the environment has no cost."""
        if not hasattr(self.env, "cost"):
            raise ValueError(
                f"{type(self.env).__name__} has no cost (jaxrod.envs.Plannable): "
                "set the objective to reward"
            )

    def step(
        self,
        key: Key[Array, ""],
        state: Any,
        action: Float[Array, " action"],
        params: Any,
    ) -> Any:
        """Advances the environment; adds the cost to `info["cost"]`.

        It is the cost of the new state and the action.
        """
        *most, info = self.env.step(key, state, action, params)
        env: Any = self.env
        return (*most, info | {"cost": env.cost(most[1], action, params)})


OBJECTIVES = ("cost", "reward")


@pytree
class SHACConfig(OnPolicyConfig):
    """Settings of SHAC; more are in `OnPolicyConfig` and `LearnerConfig`.

    Example:
        >>> config = training.SHACConfig(rollout_steps=32)
        >>> config.rollout_steps * config.action_repeat  # control steps of a gradient
        128
    """

    num_envs: int = static(default=64)
    rollout_steps: int = static(default=16)
    action_repeat: int = static(default=4)
    objective: str = static(default="cost")
    """Objective: the task's smooth "cost" is minimised, or its "reward" maximised."""
    critic: bool = static(default=True)
    """Whether the objective includes the critic's value at the end of a window. False
    gives the analytic policy gradient (APG)."""
    epochs: int = static(default=8)
    """Number of passes over the samples of one update when the critic is fitted."""
    minibatches: int = static(default=4)
    """Number of gradient steps in one pass; divides `rollout_steps`."""
    learning_rate: Scalar = 2e-3
    """Step size of Adam for the policy at the start."""
    final_learning_rate: Scalar = 2e-4
    """Step size of Adam for the policy at the end of the run; it falls linearly."""
    critic_learning_rate: Scalar = 1e-3
    """Step size of Adam for the critic."""
    target_rate: Scalar = 0.2
    """Rate rho of the target critic: w_target <- w_target + rho (w - w_target)."""
    gradient_norm: Scalar = 1.0
    """Largest norm of a gradient; longer gradients are scaled down to it."""
    initial_log_std: Scalar = -1.0


def validate(config: SHACConfig, num_devices: int = 1) -> None:
    """Validates a configuration on the host.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_on_policy(config, num_devices)
    check_counts(config, "epochs", "minibatches")
    if config.rollout_steps % config.minibatches:
        raise ValueError(
            f"minibatches must divide rollout_steps, {config.rollout_steps}, "
            f"got {config.minibatches}"
        )
    if config.objective not in OBJECTIVES:
        raise ValueError(
            f"objective must be one of {', '.join(OBJECTIVES)}; "
            f"got {config.objective!r}"
        )
    if not isinstance(config.critic, bool):
        raise ValueError(f"critic must be true or false, got {config.critic!r}")
    check_positive(
        config,
        "learning_rate",
        "final_learning_rate",
        "critic_learning_rate",
        "gradient_norm",
    )
    check_fractions(config, "target_rate")


def init(
    key: Key[Array, ""],
    env: Environment,
    config: SHACConfig,
    env_params: Any = None,
    total_steps: int | Int[Array, ""] = 10_000_000,
) -> OnPolicyState:
    """The train state before the first update; pure, so it can be vmapped over keys.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment, with a method `cost` if the objective is the cost.
        config: Settings, whose numbers can also be vmapped.
        env_params: Parameters of the environment, None for its defaults.
        total_steps: Control steps of the run, over which the learning rate falls.

    Raises:
        ValueError: The objective is the cost, but the environment has none.
    """
    adam = _optimiser(config)
    if config.objective == "cost":
        env = WithCost(env)
    state = start(key, env, config, env_params, total_steps, make_optimiser=_optimiser)
    return dataclasses.replace(
        state,
        weights=state.weights | {"target": state.weights["value"]},
        optimiser={
            name: adam.init(state.weights[name]) for name in ("policy", "value")
        },
    )


def update(
    state: OnPolicyState, axis_name: str | None = None
) -> tuple[OnPolicyState, Metrics]:
    """One update: one gradient step of the policy, then several of the critic.

    Args:
        state: The train state.
        axis_name: Mapped axis over which the environments are spread, if any.
    """
    state = with_bounded_noise(state)
    config: SHACConfig = state.config
    adam = _optimiser(config)
    dtype = state.environments.observation.dtype
    noise = action_noise(state)

    def loss(policy: Any) -> tuple[Array, tuple[VectorState, Window, Array]]:
        environments, window = acted(state, policy, noise)
        following = target_value(state, window.final_observation)
        gain = objective(window, following, config.discount)
        entropy = gaussian_entropy(policy["log_std"])
        total = -gain - config.entropy_weight * entropy
        return total, (environments, window, following)

    (found, (environments, window, following)), gradient = jax.value_and_grad(
        loss, has_aux=True
    )(state.weights["policy"])
    gradient = mean_over_devices(gradient, axis_name)
    norm = optax.tree.norm(gradient)
    sound = jnp.isfinite(norm)
    rate = along_the_run(state, config.learning_rate, config.final_learning_rate, dtype)
    # NaN times zero is still NaN, so the gradient is replaced before any use.
    gradient = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0), gradient)
    direction, memory = adam.update(gradient, state.optimiser["policy"])
    moved = optax.tree.add_scale(state.weights["policy"], -rate, direction)
    policy, memory = jax.tree.map(
        lambda new, old: jnp.where(sound, new, old),
        (moved, memory),
        (state.weights["policy"], state.optimiser["policy"]),
    )
    shuffle_key, own = jax.random.split(state.shuffle_key)
    critic, critic_memory, error = _fitted(state, window, following, own, axis_name)
    target = jax.tree.map(
        lambda old, new: old + config.target_rate * (new - old),
        state.weights["target"],
        critic,
    )
    seen = window.raw.reshape(-1, window.raw.shape[-1])
    scalars = {
        "objective": -found,
        "reward_mean": jnp.mean(window.reward),
        "value_error": error,
        "action_std": jnp.mean(jnp.exp(policy["log_std"])),
    }
    report = mean_over_devices(scalars, axis_name) | {
        "gradient_norm": jnp.where(sound, norm, 0),
        "skipped": (~sound).astype(dtype),
        "learning_rate": rate,
    }
    state = dataclasses.replace(
        state,
        weights={"policy": policy, "value": critic, "target": target},
        optimiser={"policy": memory, "value": critic_memory},
        moments=merge_moments(state.moments, batch_moments(seen, axis_name)),
        environments=environments,
        shuffle_key=shuffle_key,
        updates=state.updates + 1,
    )
    return state, Metrics(report, window.episodes)


def _fitted(
    state: OnPolicyState,
    window: Window,
    following: Float[Array, "steps num_envs"],
    key: Key[Array, ""],
    axis_name: str | None,
) -> tuple[Any, Any, Float[Array, ""]]:
    """Fits the critic to the lambda returns of a window.

    Args:
        state: The train state before the update.
        window: Samples of the window.
        following: Target value of the observation after each decision.
        key: Key for the order of the minibatches.
        axis_name: Mapped device axis over which the environments are split, if any.

    Returns:
        Weights of the critic, its optimiser state, and its mean squared error.
    """
    config: SHACConfig = state.config
    weights, memory = state.weights["value"], state.optimiser["value"]
    if not config.critic:
        return weights, memory, jnp.zeros((), following.dtype)
    window, following = jax.lax.stop_gradient((window, following))
    adam = _optimiser(config)
    network = value_network(config, following.dtype)
    value = target_value(state, window.observation)
    aim = value + generalised_advantages(
        reward=window.earned,
        value=value,
        # Used only where the last step did not end an episode. Its final observation is
        # then the next one.
        last_value=following[-1],
        final_value=following,
        terminated=window.terminated,
        done=window.done,
        discount=config.discount,
        trace_decay=config.trace_decay,
    )

    return fit_value(
        network,
        (weights, memory),
        adam,
        (window.observation, aim),
        key,
        (config.epochs, config.minibatches),
        rate=config.critic_learning_rate,
        weight=1.0,
        axis_name=axis_name,
    )


def _optimiser(config: SHACConfig) -> optax.GradientTransformation:
    """Gradient clipping, then Adam with b1 = 0.7, b2 = 0.95, without a step size."""
    return optax.chain(
        optax.clip_by_global_norm(config.gradient_norm),
        optax.scale_by_adam(b1=0.7, b2=0.95),
    )


SHAC = Algorithm(
    name="shac",
    config_type=SHACConfig,
    validate=validate,
    steps_per_update=steps_per_update,
    init=init,
    update=update,
    partition=partition,
    policy=functools.partial(deterministic_policy, output="tanh"),
)
"""SHAC as an `Algorithm`, for `jaxrod.training.train`."""
