r"""DAgger: a network learns to act like a planner, in the states that it visits.

The policy acts; early in the run the planner acts instead in a fraction of the
decisions. In every visited state the planner computes an action, starting from the
policy's action (`better_actions`). The network is fitted by least squares to the stored
actions of the planner. The planner uses the whole state and differentiates the
simulation, but the policy is a function of the observation alone. So the network learns
the planner's mean action over all states with the same observation.

The planner minimises the task's cost, and rewards are not used. So goals that are in
the reward but not in the cost are not learned.

Source: Ross, Gordon & Bagnell, "A reduction of imitation learning and structured
prediction to no-regret online learning", 2011.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key

from jaxrod.control.plans import PlanCost, by_gauss_newton, check_model
from jaxrod.envs import Environment, EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.envs.wrappers import repeating
from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import (
    Algorithm,
    Metrics,
    mean_over_devices,
    steps_per_update,
)
from jaxrod.training.algorithms.preparation import (
    SPREAD,
    SPREAD_MEMORY,
    LearnerState,
    along_the_run,
    canonicalise,
    check_memory,
    network_policy,
    restart_phase,
    slots,
    spread_over_devices,
    started,
)
from jaxrod.training.algorithms.replay import (
    ReplayBuffer,
    append,
    sample,
    sample_indices,
)
from jaxrod.training.networks import (
    check_outputs,
    initial_weights,
    make_network,
)
from jaxrod.training.normalisation import (
    batch_moments,
    merge_moments,
    no_moments,
    normalise,
)
from jaxrod.training.policy import Policy
from jaxrod.training.settings import (
    LearnerConfig,
    Scalar,
    check_counts,
    check_learner,
    check_not_negative,
    check_positive,
)

ACTIVATION = "tanh"
"""Activation function of the hidden layers of the policy network."""


@pytree
class DAggerConfig(LearnerConfig):
    """Settings of DAgger; more are in `LearnerConfig`.

    It does not learn from rewards: `discount` and `reward_scale` must keep their
    defaults.

    Example:
        >>> config = training.DAggerConfig(planner_steps=1e5)
        >>> config.lookahead, config.action_repeat  # control steps
        (32, 16)
    """

    num_envs: int = static(default=64)
    rollout_steps: int = static(default=8)
    action_repeat: int = static(default=16)
    hidden_sizes: tuple[int, ...] = static(default=(128, 128))
    lookahead: int = static(default=32)
    """Horizon of the planner [control steps]: its plan is one action, held for this
    time."""
    plan_iterations: int = static(default=1)
    """Gauss-Newton steps of the planner, starting from the policy's action."""
    gradient_steps: int = static(default=128)
    """Number of gradient steps in one update."""
    batch_size: int = static(default=256)
    """Number of decisions in the batch of a gradient step, a multiple of `num_envs`."""
    buffer_size: int = static(default=200_000)
    """Largest number of stored actions of the planner."""
    effort: Scalar = 1e-2
    """Weight e of the term `e |u|^2` of the action u in the planner's cost."""
    planner_steps: Scalar = 300_000.0
    """Control steps of the run over which the probability that the planner acts falls
    from 1 to 0, linearly."""
    learning_rate: Scalar = 1e-3
    """Step size of Adam at the start."""
    final_learning_rate: Scalar = 1e-4
    """Step size of Adam at the end of the run; it falls linearly."""


@pytree
class Advice:
    """Observations with the planner's actions, with any leading axes."""

    observation: Float[Array, "*batch observation"]
    """Observation in the state from which the planner starts, not normalised."""
    action: Float[Array, "*batch action"]
    """Action of the planner."""


@pytree
class DAggerState(LearnerState):
    """Train state of a DAgger run: everything needed to continue it."""

    weights: Any
    """Weights of the policy network."""
    optimiser: Any
    """State of Adam."""
    advice: ReplayBuffer
    """Ring buffer of observations with the planner's actions; the oldest are
    overwritten."""
    keys: Key[Array, " num_envs"]
    """One key per environment, for the choice between planner and policy and for the
    samples."""


def validate(config: DAggerConfig, num_devices: int = 1) -> None:
    """Validates a configuration on the host.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_learner(config, num_devices)
    check_counts(
        config,
        "lookahead",
        "plan_iterations",
        "gradient_steps",
        "batch_size",
        "buffer_size",
    )
    for name in ("discount", "reward_scale"):
        given, usual = float(getattr(config, name)), getattr(LearnerConfig(), name)
        if given != usual:
            raise ValueError(
                f"{name} has no effect in dagger, which uses no rewards: leave it at "
                f"{usual}, got {given}"
            )
    check_memory(config)
    check_positive(config, "effort", "learning_rate", "final_learning_rate")
    check_not_negative(config, "planner_steps")


def init(
    key: Key[Array, ""],
    env: Environment,
    config: DAggerConfig,
    env_params: Any = None,
    total_steps: int | Int[Array, ""] = 1_000_000,
) -> DAggerState:
    """The train state before the first update; pure, so it can be vmapped over keys.

    Args:
        key: Typed random key; all randomness of the run comes from it.
        env: The environment, a `jaxrod.envs.Plannable`.
        config: Settings, whose numbers can also be vmapped.
        env_params: Parameters of the environment, None for its defaults.
        total_steps: Control steps of the run, over which the learning rate falls.

    Raises:
        ValueError: The environment is not plannable.
    """
    model_of(env)
    env = repeating(env, config.action_repeat)
    updates = -(-total_steps // steps_per_update(config))
    config, env_params, dtype = canonicalise(key, env, config, env_params)
    keys = jax.random.split(key, 3)
    dummy = jnp.zeros(env.observation_size, dtype)
    network = policy_network(env, config, dtype)
    weights = initial_weights(network, keys[0], dummy)
    check_outputs(network, weights, dummy, env.action_size)
    shape = (slots(config), config.num_envs)
    advice = Advice(
        jnp.zeros((*shape, env.observation_size), dtype),
        jnp.zeros((*shape, env.action_size), dtype),
    )
    return DAggerState(
        env=env,
        config=config,
        env_params=env_params,
        weights=weights,
        optimiser=optax.scale_by_adam().init(weights),
        moments=no_moments(env.observation_size, dtype),
        environments=started(keys[1], env, config, env_params, dtype),
        advice=ReplayBuffer(advice, jnp.zeros((), jnp.int32)),
        keys=jax.random.split(keys[2], config.num_envs),
        updates=jnp.zeros((), jnp.int32),
        total_updates=jnp.asarray(updates, jnp.int32),
    )


def policy_network(env: Environment, config: DAggerConfig, dtype: Any) -> Any:
    """The policy network as a flax module; its weights are in the train state."""
    size = env.action_size
    return make_network(config, "policy", size, activation=ACTIVATION, dtype=dtype)


def deterministic_policy(state: DAggerState) -> Policy:
    """Deterministic policy: the network's output, clipped to [-1, 1]."""
    return network_policy(state, state.weights, ACTIVATION)


def partition(state: DAggerState) -> DAggerState:
    """Partition specs: environments, their keys and the planner's actions are split."""
    return spread_over_devices(
        state, environments=SPREAD, advice=SPREAD_MEMORY, keys=SPREAD
    )


def update(
    state: DAggerState, axis_name: str | None = None
) -> tuple[DAggerState, Metrics]:
    """One update: acts, collects actions of the planner, then fits the network.

    Args:
        state: The train state.
        axis_name: Mapped axis over which the environments are spread, if any.
    """
    state, report, episodes = _act(state, axis_name)
    state, fitted = _fit(state, axis_name)
    config = state.config
    plans = config.num_envs * config.rollout_steps * config.plan_iterations
    report |= {
        "fit_error": fitted,
        # Steps of the model over all devices, in addition to the acted steps.
        "model_steps": jnp.asarray(plans * PASSES * config.lookahead, fitted.dtype),
    }
    return dataclasses.replace(state, updates=state.updates + 1), Metrics(
        report, episodes
    )


def _act(
    state: DAggerState, axis_name: str | None
) -> tuple[DAggerState, dict[str, Array], EpisodeRecord]:
    """Acts for one rollout and stores the planner's action of every decision.

    Returns:
        The updated state, scalars for the report, and results of the complete episodes
        that ended.
    """
    config: DAggerConfig = state.config
    environment, model = VectorEnvironment(state.env), model_of(state.env)
    policy = deterministic_policy(state)
    phase = restart_phase(state.env, config, state.updates)
    share = _planner_share(state)
    chance = jax.vmap(
        lambda key: jax.random.uniform(
            jax.random.fold_in(key, 2 * state.updates),
            (config.rollout_steps,),
            share.dtype,
        )
    )(state.keys)

    def decide(
        environments: VectorState, chance: Float[Array, " num_envs"]
    ) -> tuple[VectorState, Any]:
        own = policy(environments.observation)
        advised, reached = better_actions(
            model,
            state.env_params,
            environments.states,
            own,
            config.lookahead,
            jnp.asarray(config.effort),
            config.plan_iterations,
        )
        action = jnp.where((chance < share)[:, None], advised, own)
        following, outcome = environment.step(
            environments, action, state.env_params, restart_phase=phase
        )
        said = Advice(environments.observation, advised)
        finite = jnp.isfinite(reached)
        told = {
            "reward_mean": jnp.mean(outcome.reward),
            "advice_change": jnp.mean((advised - own) ** 2),
            "plan_cost": jnp.sum(jnp.where(finite, reached, 0))
            / jnp.maximum(jnp.sum(finite), 1),
            "plans_broken": jnp.mean(~finite, dtype=reached.dtype),
        }
        return following, (said, told, outcome.episodes)

    environments, (said, told, episodes) = jax.lax.scan(
        decide, state.environments, jnp.swapaxes(chance, 0, 1)
    )
    seen = said.observation.reshape(-1, said.observation.shape[-1])
    state = dataclasses.replace(
        state,
        environments=environments,
        advice=append(state.advice, said),
        moments=merge_moments(state.moments, batch_moments(seen, axis_name)),
    )
    report = mean_over_devices(jax.tree.map(jnp.mean, told), axis_name)
    return state, report | {"planner_share": share}, episodes


def _fit(
    state: DAggerState, axis_name: str | None
) -> tuple[DAggerState, Float[Array, ""]]:
    """Fits the network to the planner's actions by least squares.

    Returns:
        The updated state, and the mean squared error.
    """
    config: DAggerConfig = state.config
    dtype = state.environments.observation.dtype
    network = policy_network(state.env, config, dtype)
    optimiser = optax.scale_by_adam()
    rate = along_the_run(state, config.learning_rate, config.final_learning_rate, dtype)
    keys = jax.vmap(lambda key: jax.random.fold_in(key, 2 * state.updates + 1))(
        state.keys
    )
    per_env = config.batch_size // config.num_envs
    times = sample_indices(state.advice, keys, config.gradient_steps, per_env)

    def loss(weights: Any, said: Advice) -> Array:
        seen = normalise(state.moments, said.observation, config.observation_limit)
        action = network.apply({"params": weights}, seen).astype(dtype)
        return jnp.mean((action - said.action) ** 2)

    def gradient_step(
        carry: tuple[Any, Any], times: Int[Array, "per_env num_envs"]
    ) -> tuple[tuple[Any, Any], Array]:
        weights, memory = carry
        found, gradient = jax.value_and_grad(loss)(weights, sample(state.advice, times))
        gradient = mean_over_devices(gradient, axis_name)
        direction, memory = optimiser.update(gradient, memory)
        return (optax.tree.add_scale(weights, -rate, direction), memory), found

    (weights, memory), errors = jax.lax.scan(
        gradient_step, (state.weights, state.optimiser), times
    )
    state = dataclasses.replace(state, weights=weights, optimiser=memory)
    return state, mean_over_devices(jnp.mean(errors), axis_name)


def _planner_share(state: DAggerState) -> Float[Array, ""]:
    """Probability that the planner acts: 1 - steps / planner_steps, at least 0.

    `steps` are the control steps of the run so far.
    """
    config = state.config
    dtype = state.environments.observation.dtype
    # Updates are compared, not control steps, which would overflow their integers.
    until = config.planner_steps / steps_per_update(config)
    return jnp.clip(1 - state.updates.astype(dtype) / jnp.maximum(until, 1), 0, 1)


DAGGER = Algorithm(
    name="dagger",
    config_type=DAggerConfig,
    validate=validate,
    steps_per_update=steps_per_update,
    init=init,
    update=update,
    partition=partition,
    policy=deterministic_policy,
)
"""DAgger as an `Algorithm`, for `jaxrod.training.train`."""


PASSES = 4
"""Simulations of the model per Gauss-Newton step: one at the current action, one for
each of three step lengths."""


def model_of(env: Environment) -> Any:
    """Validates that an environment is plannable and returns it without wrappers.

    Raises:
        ValueError: The environment is not plannable.
    """
    model = getattr(env, "unwrapped", env)
    check_model(model, ("predict", "residuals"))
    return model


def better_actions(
    model: Any,
    params: Any,
    states: Any,
    actions: Float[Array, "batch action"],
    lookahead: int,
    effort: Array,
    iterations: int,
) -> tuple[Float[Array, "batch action"], Float[Array, " batch"]]:
    r"""Actions of a planner that improves given actions, and their costs.

    The plan is one action $u$, each entry in [-1, 1], held for $h$ control steps from
    the present state. The planner solves

    $$\min_u |r(x_h(u))|^2 + e |u|^2$$

    by Gauss-Newton steps from the given action, with the environment's residuals $r$ at
    the final state $x_h$. The small weight $e$ selects one of the many actions that
    reach the goal. This short plan is cheap: a step needs one backward pass for each of
    the few residuals. It is nearly a function of the state, so a network can learn it.
    If it is recomputed before it ends, it scores nearly as well as actions that are
    linear between several knots (docs/optimum.md).

    A step that does not reduce the cost, or after which the cost is not finite, leaves
    the action unchanged.

    Args:
        model: An environment with `predict` and `residuals`.
        params: Parameters of the environment.
        states: States of the environment; every leaf has a leading batch axis.
        actions: Initial actions, in [-1, 1].
        lookahead: Control steps h for which an action is held.
        effort: Weight e of the squared action.
        iterations: Number of Gauss-Newton steps.

    Returns:
        The improved actions, and the cost of each plan; infinite if the model breaks.
    """
    cost = PlanCost(
        params=params,
        effort=effort,
        smoothness=jnp.zeros_like(effort),
        env=model,
        knots=1,
        spacing=lookahead,
        hold=lookahead,
        shape="steps",
    )
    count = jnp.asarray(iterations, jnp.int32)

    def one(action: Array, state: Any) -> tuple[Array, Array]:
        found, reached = by_gauss_newton(cost, action, action[None], state, count)
        return found[0], reached

    return jax.vmap(one)(actions, states)
