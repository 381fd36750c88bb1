"""Common parts of PPO, TRPO and SHAC: train state, rollouts, advantages, value fit.

The observations of a rollout are normalised by the moments that were used while acting.

A run may start from an existing policy instead of a random one (`warm_start`). A policy
that imitates a planner can be no better than the planner's cost and the observation
allow; learning from rewards alone takes long to find the first rewards. Imitation
followed by learning from rewards has neither problem.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, DTypeLike, Float, Int, Key

from jaxrod.envs import Environment, EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.envs.wrappers import repeating
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import Algorithm, mean_over_devices, steps_per_update
from jaxrod.training.algorithms.preparation import (
    SPREAD,
    LearnerState,
    along_the_run,
    canonicalise,
    network_policy,
    restart_phase,
    spread_over_devices,
    started,
)
from jaxrod.training.networks import (
    GaussianPolicy,
    apply_once,
    check_outputs,
    initial_memory,
    initial_weights,
    layers,
    make_network,
)
from jaxrod.training.normalisation import (
    batch_moments,
    merge_moments,
    no_moments,
    normalise,
)
from jaxrod.training.policy import MLPPolicy, check_quiet_action
from jaxrod.training.settings import (
    LearnerConfig,
    Scalar,
    check_finite,
    check_fractions,
    check_learner,
    check_not_negative,
)

ACTIVATION = "tanh"
"""Activation function of the hidden layers in PPO, TRPO and SHAC."""


@pytree
class OnPolicyConfig(LearnerConfig):
    """Settings common to PPO, TRPO and SHAC; more are in `LearnerConfig`.

    Example:
        >>> config = training.OnPolicyConfig(num_envs=64, trace_decay=0.9)
        >>> training.steps_per_update(config)
        8192
    """

    trace_decay: Scalar = 0.95
    """Trace decay lambda of generalised advantage estimation."""
    entropy_weight: Scalar = 0.0
    """Weight of the policy's entropy in the objective."""
    initial_log_std: Scalar = 0.0
    """Logarithm of the initial standard deviation of actions."""
    max_log_std: Scalar = 2.0
    """Bound on the logarithm of the standard deviation of actions in the first update.
    Actions are clipped to [-1, 1], so a bound of 2 hardly matters."""
    final_max_log_std: Scalar = 2.0
    """Bound on the logarithm of the standard deviation in the last update; linear in
    between. A bound of -2 at the end makes the policy learn to act without noise."""
    quiet_action: str = static(default="mean")
    """Action of the final policy, which acts without noise. "mean" is the mean of the
    bounded actions that it took in training. "median" is their median: the output of
    the network, bounded. The two differ if the noise often reaches the bounds."""


@pytree
class OnPolicyState(LearnerState):
    """Train state of an on-policy run: everything that is needed to continue it."""

    weights: dict[str, Any]
    """Weights of the networks, under "policy" and "value"; in SHAC also "target"."""
    optimiser: Any
    """State of the optimiser, or of several by name."""
    action_keys: Key[Array, " num_envs"]
    """One key per environment, for the noise of its actions."""
    shuffle_key: Key[Array, ""]
    """Key for the order of the minibatches."""
    memory: dict[str, Any]
    """Memories of the networks, by name as in `weights`, with a first axis of
    environments; None for a network without memory."""
    actor_size: int = static()
    """Number of entries of the observation that the policy sees: the first ones. The
    critic sees all."""


@pytree
class Experience:
    """Samples from which PPO or TRPO learns in one update."""

    observation: Float[Array, "steps num_envs observation"]
    """Normalised observation from which the action was chosen."""
    action: Float[Array, "steps num_envs action"]
    """Action drawn by the policy, before clipping to [-1, 1]."""
    log_prob: Float[Array, "steps num_envs"]
    """Log density of the action under the policy that drew it."""
    advantage: Float[Array, "steps num_envs"]
    """Advantage estimate of the action, not standardised."""
    value_target: Float[Array, "steps num_envs"]
    """Target of the value network: advantage + value, in scaled rewards."""
    value: Float[Array, "steps num_envs"]
    """Value that the network predicted before the update, in scaled rewards."""
    reward: Float[Array, "steps num_envs"]
    """Reward of each decision, not scaled, for the report."""
    starts: Bool[Array, "steps num_envs"]
    """Whether an episode began with this observation, after the first step."""
    memory: dict[str, Any]
    """Memories of the networks before the first step, as in `OnPolicyState`."""


def policy_network(
    env: Environment, config: OnPolicyConfig, dtype: DTypeLike
) -> GaussianPolicy:
    """The policy network as a flax module; its weights are in the train state."""
    size = env.action_size
    mean = make_network(config, "policy", size, activation=ACTIVATION, dtype=dtype)
    return GaussianPolicy(mean, size, config.initial_log_std, dtype=dtype)


def value_network(config: OnPolicyConfig, dtype: DTypeLike) -> nn.Module:
    """The value network as a flax module; its weights are in the train state."""
    return make_network(config, "critic", 1, activation=ACTIVATION, dtype=dtype)


def predicted_value(
    network: nn.Module,
    weights: Any,
    observation: Float[Array, "*batch observation"],
    memory: Any = None,
    starts: Bool[Array, "*batch"] | None = None,
) -> Float[Array, "*batch"]:
    """Values V of normalised observations: the single output of the value network.

    Args:
        network: The network.
        weights: Weights of the network.
        observation: Observations; for a network with memory of shape (steps, batch,
            observation).
        memory: Memory before the first step; None for a network without memory.
        starts: Whether an episode begins with an observation; only used with a memory.
    """
    recalled = () if memory is None else (memory, starts)
    output = network.apply({"params": weights}, observation, *recalled)
    output = output[0] if recalled else output
    return output[..., 0].astype(observation.dtype)


def log_density(
    standardised: Float[Array, "*batch action"], log_std: Float[Array, " action"]
) -> Float[Array, "*batch"]:
    """Log density of an action mean + std z: -sum(z^2/2 + log std + log(2 pi)/2).

    Args:
        standardised: z = (action - mean) / std.
        log_std: Logarithm of the standard deviation.
    """
    log_std = jnp.expand_dims(log_std, tuple(range(standardised.ndim - 1)))
    terms = 0.5 * standardised**2 + log_std + 0.5 * jnp.log(2 * jnp.pi)
    return -jnp.sum(terms.astype(standardised.dtype), axis=-1)


def gaussian_entropy(log_std: Float[Array, " action"]) -> Float[Array, ""]:
    """Entropy of a normal distribution: sum(log std) + n/2 log(2 pi e)."""
    constant = 0.5 * log_std.shape[0] * math.log(2 * math.pi * math.e)
    return jnp.sum(log_std) + constant


def start(
    key: Key[Array, ""],
    env: Environment,
    config: Any,
    env_params: Any = None,
    total_steps: int | Int[Array, ""] = 10_000_000,
    *,
    make_optimiser: Callable[[Any], optax.GradientTransformation],
    recurrent: bool = False,
    actor_size: int | None = None,
) -> OnPolicyState:
    """The train state before the first update; pure, so it can be vmapped over keys.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment.
        config: Settings, an `OnPolicyConfig`; their numbers can be vmapped, too.
        env_params: Parameters of the environment, None for its defaults.
        total_steps: Control steps of the run, over which schedules go from their first
            to their last value.
        make_optimiser: Function `config -> optax transformation`, whose initial state
            becomes `optimiser`.
        recurrent: Whether the networks may have a memory.
        actor_size: Number of entries of the observation that the policy sees; None for
            all.

    Raises:
        ValueError: A network cannot be used.
    """
    optimiser = make_optimiser(config)
    updates = -(-total_steps // steps_per_update(config))
    env = repeating(env, config.action_repeat)
    config, env_params, dtype = canonicalise(key, env, config, env_params)
    keys = jax.random.split(key, 5)
    size = env.observation_size if actor_size is None else actor_size
    seen, dummy = jnp.zeros(size, dtype), jnp.zeros(env.observation_size, dtype)
    policy, value = policy_network(env, config, dtype), value_network(config, dtype)
    weights = {
        "policy": initial_weights(policy, keys[0], seen, recurrent=recurrent),
        "value": initial_weights(value, keys[1], dummy, recurrent=recurrent),
    }
    mean_weights = weights["policy"].get("mean", {})
    check_outputs(policy.mean, mean_weights, seen, env.action_size)
    check_outputs(value, weights["value"], dummy, 1)
    return OnPolicyState(
        env=env,
        config=config,
        env_params=env_params,
        weights=weights,
        optimiser=optimiser.init(weights),
        moments=no_moments(env.observation_size, dtype),
        environments=started(keys[2], env, config, env_params, dtype),
        action_keys=jax.random.split(keys[3], config.num_envs),
        shuffle_key=keys[4],
        memory=initial_memories(policy, value, config.num_envs, dtype),
        actor_size=size,
        updates=jnp.zeros((), jnp.int32),
        total_updates=jnp.asarray(updates, jnp.int32),
    )


def initial_memories(
    policy: nn.Module, value: nn.Module, num_envs: int, dtype: DTypeLike
) -> dict[str, Any]:
    """Memories of both networks at the start of an episode in every environment."""
    return {
        "policy": initial_memory(policy, (num_envs,), dtype),
        "value": initial_memory(value, (num_envs,), dtype),
    }


def with_bounded_noise(state: OnPolicyState) -> OnPolicyState:
    """The state with the standard deviation of actions within the schedule's bound."""
    config: OnPolicyConfig = state.config
    policy = state.weights["policy"]
    bound = along_the_run(
        state, config.max_log_std, config.final_max_log_std, policy["log_std"].dtype
    )
    policy = {**policy, "log_std": jnp.minimum(policy["log_std"], bound)}
    return dataclasses.replace(state, weights=state.weights | {"policy": policy})


def gather_experience(
    state: OnPolicyState, axis_name: str | None = None
) -> tuple[OnPolicyState, Experience, EpisodeRecord]:
    """Acts for one rollout with the current policy and estimates the advantages.

    Returns:
        The state with updated environments and moments, the experience, and the
        episodes that ended. The experience is normalised by the earlier moments.
    """
    state = with_bounded_noise(state)
    config: OnPolicyConfig = state.config
    dtype = state.environments.observation.dtype
    policy = policy_network(state.env, config, dtype)
    values = value_network(config, dtype)

    def normalised(observation: Array) -> Array:
        return normalise(state.moments, observation, config.observation_limit)

    weights, log_std = state.weights, state.weights["policy"]["log_std"]

    def act(observation: Array, memory: Any, noise: Array) -> tuple[Array, Any]:
        seen = normalised(observation)
        own = weights["policy"].get("mean", {})
        shown = seen[..., : state.actor_size]
        mean, acted = apply_once(policy.mean, own, shown, memory["policy"])
        _, judged = apply_once(values, weights["value"], seen, memory["value"])
        action = mean.astype(dtype) + jnp.exp(log_std)[None] * noise
        return action, {"policy": acted, "value": judged}

    def value(observation: Array, memory: Any) -> Array:
        seen = normalised(observation)
        output, _ = apply_once(values, weights["value"], seen, memory["value"])
        return output[..., 0].astype(dtype)

    noise = action_noise(state)
    (environments, memory), rollout = collect(
        VectorEnvironment(state.env),
        (state.environments, state.memory),
        state.env_params,
        act,
        value,
        noise,
        restart_phase(state.env, config, state.updates),
        initial_memories(policy, values, noise.shape[1], dtype),
    )
    observation = normalised(rollout.observation)
    starts = jnp.concatenate([jnp.zeros_like(rollout.done[:1]), rollout.done[:-1]])
    predicted = predicted_value(
        values, weights["value"], observation, state.memory["value"], starts
    )
    advantage = generalised_advantages(
        reward=config.reward_scale * rollout.reward,
        value=predicted,
        last_value=value(environments.observation, memory),
        final_value=rollout.final_value,
        terminated=rollout.terminated,
        done=rollout.done,
        discount=config.discount,
        trace_decay=config.trace_decay,
    )
    experience = Experience(
        observation=observation,
        action=rollout.action,
        log_prob=log_density(noise, log_std),
        advantage=advantage,
        value_target=advantage + predicted,
        value=predicted,
        reward=rollout.reward,
        starts=starts,
        memory=state.memory,
    )
    seen = rollout.observation.reshape(-1, rollout.observation.shape[-1])
    state = dataclasses.replace(
        state,
        environments=environments,
        memory=memory,
        moments=merge_moments(state.moments, batch_moments(seen, axis_name)),
    )
    return state, experience, rollout.episodes


def fit_value(
    network: nn.Module,
    learned: tuple[Any, Any],
    optimiser: optax.GradientTransformation,
    samples: tuple[Float[Array, "steps num_envs observation"], Array],
    key: Key[Array, ""],
    passes: tuple[int, int],
    *,
    rate: Scalar,
    weight: float,
    axis_name: str | None,
) -> tuple[Any, Any, Float[Array, ""]]:
    """Fits a value network to targets; a minibatch is a random set of time steps.

    Args:
        network: The network.
        learned: Weights of the network, and the state of the optimiser.
        optimiser: Optimiser without a step size.
        samples: Normalised observations, and their target values.
        key: Key for the order of the minibatches.
        passes: Number of passes over the samples, and of gradient steps in each.
        rate: Step size.
        weight: Factor of the mean squared error in the loss.
        axis_name: Mapped axis over which the environments are spread, if any.

    Returns:
        Weights, state of the optimiser, and the mean loss of the gradient steps.
    """
    observation, target = samples
    epochs, minibatches = passes

    def loss(weights: Any, rows: Int[Array, " rows"]) -> Array:
        value = predicted_value(network, weights, observation[rows])
        return weight * jnp.mean((value - target[rows]) ** 2)

    def step(
        carry: tuple[Any, Any], rows: Int[Array, " rows"]
    ) -> tuple[tuple[Any, Any], Array]:
        weights, memory = carry
        error, gradient = jax.value_and_grad(loss)(weights, rows)
        gradient = mean_over_devices(gradient, axis_name)
        direction, memory = optimiser.update(gradient, memory)
        return (optax.tree.add_scale(weights, -rate, direction), memory), error

    orders = jax.vmap(lambda key: jax.random.permutation(key, target.shape[0]))(
        jax.random.split(key, epochs)
    )
    rows = orders.reshape(epochs * minibatches, -1)
    (weights, memory), errors = jax.lax.scan(step, learned, rows)
    return weights, memory, jnp.mean(errors)


def partition(state: OnPolicyState) -> OnPolicyState:
    """Partition specs: environments and their keys are split over the devices."""
    return spread_over_devices(
        state, environments=SPREAD, action_keys=SPREAD, memory=SPREAD
    )


def deterministic_policy(state: OnPolicyState, output: str = "clip") -> Any:
    """Deterministic policy: mean or median of the bounded actions in training."""
    weights = state.weights["policy"].get("mean", {})
    std = jnp.exp(state.weights["policy"]["log_std"])
    moments = dataclasses.replace(
        state.moments,
        mean=state.moments.mean[: state.actor_size],
        variance=state.moments.variance[: state.actor_size],
    )
    state = dataclasses.replace(state, moments=moments)
    return network_policy(
        state,
        weights,
        ACTIVATION,
        output,
        action_std=std,
        quiet_action=state.config.quiet_action,
    )


def check_on_policy(config: OnPolicyConfig, num_devices: int) -> None:
    """Raises ValueError if a setting is invalid."""
    check_learner(config, num_devices)
    check_fractions(config, "trace_decay")
    check_not_negative(config, "entropy_weight")
    check_finite(config, "initial_log_std", "max_log_std", "final_max_log_std")
    check_quiet_action(config.quiet_action)


def action_noise(state: OnPolicyState) -> Float[Array, "steps num_envs action"]:
    """Standard normal noise of one update, from the action key of each environment."""
    shape = (state.config.rollout_steps, state.env.action_size)
    dtype = state.environments.observation.dtype
    noise = jax.vmap(
        lambda key: jax.random.normal(
            jax.random.fold_in(key, state.updates), shape, dtype
        )
    )(state.action_keys)
    return jnp.swapaxes(noise, 0, 1)


@pytree
class Trajectories:
    """Rollouts of `steps` decisions in each of `num_envs` environments."""

    observation: Float[Array, "steps num_envs observation"]
    """Observation from which the action was chosen, not normalised."""
    action: Float[Array, "steps num_envs action"]
    """Action drawn by the policy, before clipping to [-1, 1]."""
    reward: Float[Array, "steps num_envs"]
    """Reward of the decision, not scaled."""
    terminated: Bool[Array, "steps num_envs"]
    """Whether the task ended in this step."""
    done: Bool[Array, "steps num_envs"]
    """Whether the episode ended in this step, for whatever reason."""
    final_value: Float[Array, "steps num_envs"]
    """Value of the final observation where an episode was truncated, else 0."""
    episodes: EpisodeRecord
    """The complete episodes that ended in each step."""


def collect(
    environment: VectorEnvironment,
    before: tuple[VectorState, Any],
    env_params: Any,
    act: Callable[[Array, Any, Array], tuple[Array, Any]],
    value: Callable[[Array, Any], Array],
    noise: Float[Array, "steps num_envs action"],
    restart_phase: Int[Array, ""] | int = 0,
    initial: Any = None,
) -> tuple[tuple[VectorState, Any], Trajectories]:
    """Acts for `steps` decisions in every environment of a batch.

    Args:
        environment: The batch of environments.
        before: State of the batch, and memory; every leaf has a first axis of
            environments.
        env_params: Parameters of the environment.
        act: Function (observation, memory, noise) -> (action, memory), on a batch.
        value: Function (observation, memory) -> value, on a batch. Called only in steps
            in which an episode is truncated.
        noise: Standard normal noise of the actions.
        restart_phase: Initial elapsed step count of new episodes, as in
            `jaxrod.envs.VectorEnvironment.step`.
        initial: Memory at the start of an episode in every environment.

    Returns:
        State and memory afterwards, and the rollouts.
    """

    def step(
        before: tuple[VectorState, Any], noise: Float[Array, "num_envs action"]
    ) -> tuple[tuple[VectorState, Any], Trajectories]:
        state, memory = before
        action, memory = act(state.observation, memory, noise)
        following, outcome = environment.step(
            state,
            jnp.clip(action, -1, 1),
            env_params,
            restart_phase=restart_phase,
        )
        cut_short = outcome.truncated & ~outcome.terminated
        final_value = jax.lax.cond(
            jnp.any(cut_short),
            lambda observation: jnp.where(cut_short, value(observation, memory), 0),
            lambda observation: jnp.zeros_like(observation[:, 0]),
            outcome.final_observation,
        )
        done = outcome.terminated | outcome.truncated
        memory = jax.tree.map(
            lambda new, old: jnp.where(_along_first(done, old), new, old),
            initial,
            memory,
        )
        return (following, memory), Trajectories(
            observation=state.observation,
            action=action,
            reward=outcome.reward,
            terminated=outcome.terminated,
            done=done,
            final_value=final_value,
            episodes=outcome.episodes,
        )

    return jax.lax.scan(step, before, noise)


def _along_first(mask: Bool[Array, " num_envs"], leaf: Array) -> Array:
    """Mask of the environments with as many axes as a leaf, for `where`."""
    return mask.reshape(mask.shape + (1,) * (leaf.ndim - 1))


def generalised_advantages(
    reward: Float[Array, "steps *batch"],
    value: Float[Array, "steps *batch"],
    last_value: Float[Array, "*batch"],
    final_value: Float[Array, "steps *batch"],
    terminated: Bool[Array, "steps *batch"],
    done: Bool[Array, "steps *batch"],
    discount: float | Float[Array, ""],
    trace_decay: float | Float[Array, ""],
) -> Float[Array, "steps *batch"]:
    """Advantages A_t = sum_k (gamma lambda)^k delta_(t+k) within each episode.

    delta_t = r_t + gamma V'_t - V_t. V'_t is the value of the state after step t. It is
    0 if the task ended there (`terminated`), the value of the final observation if the
    episode was only cut short (`done` but not terminated), and V_(t+1) otherwise. The
    sum stops where `done`.

    Args:
        reward: Reward of each step.
        value: Value of the observation that each step acted on.
        last_value: Value of the observation after the last step.
        final_value: Value of the observation at the end of each step, before any
            restart; used only where an episode was cut short.
        terminated: Whether the task ended in this step.
        done: Whether the episode ended in this step, for whatever reason.
        discount: Discount factor gamma in [0, 1].
        trace_decay: Trace decay lambda in [0, 1].

    Source: Schulman et al., "High-dimensional continuous control using
    generalized advantage estimation", 2016; Pardo et al., "Time limits in
    reinforcement learning", 2018.
    """
    following = jnp.concatenate([value[1:], last_value[None]])
    following = jnp.where(done, jnp.where(terminated, 0, final_value), following)
    delta = reward + discount * following - value
    decay = jnp.where(done, 0, discount * trace_decay).astype(delta.dtype)

    def backwards(
        later: Float[Array, "*batch"], step: tuple[Array, Array]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        delta_t, decay_t = step
        advantage = delta_t + decay_t * later
        return advantage, advantage

    start = jnp.zeros_like(last_value)
    return jax.lax.scan(backwards, start, (delta, decay), reverse=True, unroll=8)[1]


def standardised(
    advantage: Float[Array, "*shape"], axes: tuple[int, ...], axis_name: str | None
) -> Float[Array, "*shape"]:
    """Standardised advantages (A - mean) / (std + 1e-8).

    Args:
        advantage: Advantages of any shape.
        axes: Axes over which mean and variance are taken.
        axis_name: Mapped device axis over which they are also taken, if any.
    """

    def mean(x: Array) -> Array:
        return mean_over_devices(jnp.mean(x, axis=axes, keepdims=True), axis_name)

    centred = advantage - mean(advantage)
    return centred / (jnp.sqrt(mean(centred**2)) + 1e-8)


def warm_start(algorithm: Algorithm, policy: MLPPolicy) -> Algorithm:
    """Copy of an algorithm whose runs begin with a policy that was learned before.

    The network, the observation moments and the bound of normalised observations are
    those of the policy. So a run begins with the same actions, apart from its noise.
    They must be held for the same number of control steps. The exploration noise is
    that of the configuration: `initial_log_std` should be far below 0, or the first
    updates destroy what was learned. With other noise, `quiet_action="mean"` also
    differs near the bounds. The value network starts from random weights.

    With `gru_units` the run trains a recurrent policy. Its perceptron begins as the
    given one, with weights of zero for the memory, which starts from random weights.

    Args:
        algorithm: `PPO`, `TRPO` or `SHAC`, whose configuration must have the policy's
            `hidden_sizes` and `action_repeat`.
        policy: The initial policy, for the same task.

    Raises:
        ValueError: The policy is no perceptron. When the run begins: the algorithm is
            not on-policy, its own policy has another activation, another output or
            layers of other sizes, or `action_repeat` differs.

    Example:
        >>> policy = training.untrained_policy(envs.make("trivial"))  # or of a run
        >>> learner = training.warm_start(training.PPO, policy)
        >>> learner.name, learner.config_type.__name__
        ('ppo_with_policy', 'PPOConfig')
    """
    if not isinstance(policy, MLPPolicy):
        raise ValueError(
            f"the initial policy must be an MLPPolicy, got {type(policy).__name__}"
        )

    def init(
        key: Key[Array, ""],
        env: Environment,
        config: Any,
        env_params: Any = None,
        total_steps: int | Int[Array, ""] = 10_000_000,
    ) -> OnPolicyState:
        state = algorithm.init(key, env, config, env_params, total_steps)
        if not isinstance(state, OnPolicyState):
            raise ValueError(
                f"{algorithm.name} cannot begin with a policy: it does not learn on "
                "policy, as ppo, trpo and shac do"
            )
        if state.config.network is not None:
            raise ValueError("network must be None to begin with an MLPPolicy")
        if state.actor_size < state.env.observation_size:
            raise ValueError(
                "privileged_critic must be false to begin with an MLPPolicy, which has "
                "no moments of the critic's observations"
            )
        own: Any = algorithm.policy(state)
        units = state.config.recurrent_units("policy")
        activation = (own.network if units else own).activation
        if (policy.activation, policy.output) != (activation, own.output):
            raise ValueError(
                f"policy must have activation {activation!r} and output "
                f"{own.output!r}, as {algorithm.name} has; got {policy.activation!r} "
                f"and {policy.output!r}"
            )
        if policy.action_repeat != state.config.action_repeat:
            raise ValueError(
                f"the policy holds its actions for action_repeat = "
                f"{policy.action_repeat}, not for the configuration's "
                f"{state.config.action_repeat} control steps: set action_repeat = "
                f"{policy.action_repeat} in the configuration, or give "
                "dataclasses.replace(policy, action_repeat="
                f"{state.config.action_repeat}) to begin with other holds on purpose"
            )
        return _with_policy(state, policy)

    return dataclasses.replace(
        algorithm, name=f"{algorithm.name}_with_policy", init=init
    )


def _with_policy(state: OnPolicyState, policy: MLPPolicy) -> OnPolicyState:
    """The train state with the policy's network, moments and observation bound."""
    weights: dict[str, Any] = dict(state.weights)
    mean = weights["policy"]["mean"]
    units = state.config.recurrent_units("policy")
    perceptron = mean["perceptron"] if units else mean
    own, given = _sizes(layers(perceptron)), _sizes(policy.layers)
    own[0] = (own[0][0] - units, own[0][1])
    if own != given:
        raise ValueError(
            f"the policy's layers must have the sizes {own}, which follow from "
            f"hidden_sizes and the task, got {given}"
        )
    dtype = state.moments.mean.dtype
    names = [f"hidden_{i}" for i in range(len(own) - 1)] + ["output"]
    begun: dict[str, Any] = {
        name: {"kernel": jnp.asarray(kernel, dtype), "bias": jnp.asarray(bias, dtype)}
        for name, (kernel, bias) in zip(names, policy.layers, strict=True)
    }
    # The perceptron sees the memory after the observation.
    kernel = begun[names[0]]["kernel"]
    begun[names[0]]["kernel"] = jnp.pad(kernel, ((0, units), (0, 0)))
    begun = {**mean, "perceptron": begun} if units else begun
    weights["policy"] = {**weights["policy"], "mean": begun}
    limit = jnp.asarray(policy.limit, state.config.observation_limit.dtype)
    return dataclasses.replace(
        state,
        config=dataclasses.replace(state.config, observation_limit=limit),
        weights=weights,
        moments=jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), policy.moments),
    )


def _sizes(found: tuple[tuple[Array, Array], ...]) -> list[tuple[int, ...]]:
    return [kernel.shape for kernel, _ in found]
