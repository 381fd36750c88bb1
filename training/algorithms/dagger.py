r"""DAgger: a network learns to act like a planner, in the states that it visits.

The policy acts; at first the planner acts instead in a share of the decisions. In every
visited state the planner computes its own action, starting from the policy's action
(`jaxrod.training.algorithms.held_plan`). The network is fitted by least squares to all
of the planner's actions so far. The planner sees the whole state and differentiates the
simulation; the policy is a function of the observation. So the fit averages over
everything that the planner uses but that is not observed.

A planner knows only its cost, so it cannot teach more. Goals that are in the reward but
not in the task's cost are not learned; no reward is used.

Source: Ross, Gordon & Bagnell, "A reduction of imitation learning and structured
prediction to no-regret online learning", 2011.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from jaxrod.envs import EpisodeRecord, VectorEnvironment, VectorState
from jaxrod.training.algorithm import (
    Algorithm,
    Metrics,
    mean_over_devices,
    steps_per_update,
)
from jaxrod.training.algorithms.dagger_state import (
    Advice,
    DAggerConfig,
    DAggerState,
    init,
    network_policy,
    partition,
    policy_network,
    validate,
)
from jaxrod.training.algorithms.held_plan import PASSES, better_actions, model_of
from jaxrod.training.algorithms.replay import append, sample, sample_indices
from jaxrod.training.algorithms.schedule import along_the_run
from jaxrod.training.normalisation import batch_moments, merge_moments, normalise
from jaxrod.training.short_episodes import restart_phase


def update(
    state: DAggerState, axis_name: str | None = None
) -> tuple[DAggerState, Metrics]:
    """One update: act and collect the planner's actions, then fit.

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
        # In addition to the acted steps: steps of the model, over all devices.
        "model_steps": jnp.asarray(plans * PASSES * config.lookahead, fitted.dtype),
    }
    return dataclasses.replace(state, updates=state.updates + 1), Metrics(
        report, episodes
    )


def _act(
    state: DAggerState, axis_name: str | None
) -> tuple[DAggerState, dict[str, Array], EpisodeRecord]:
    """Acts, asks the planner in every decision, and stores its actions."""
    config: DAggerConfig = state.config
    environment, model = VectorEnvironment(state.env), model_of(state.env)
    policy = network_policy(state)
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
            "reward_mean": jnp.mean(outcome.reward) / config.action_repeat,
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
    """Gradient steps on the squared distance from the planner; returns its mean."""
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
    """Share of the decisions in which the planner acts."""
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
    policy=network_policy,
)
"""DAgger for the shared loop."""
