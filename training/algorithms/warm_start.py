"""On-policy learning that starts from an existing policy instead of a random one.

A policy that imitates a planner can be no better than the planner's cost and the
observation allow. Learning from rewards alone takes long to find the first rewards.
Imitation followed by learning from rewards has neither problem.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from jaxrod.envs import Environment
from jaxrod.training.algorithm import Algorithm
from jaxrod.training.algorithms.on_policy import OnPolicyState
from jaxrod.training.networks import layers
from jaxrod.training.policy import MLPPolicy


def warm_start(algorithm: Algorithm, policy: MLPPolicy) -> Algorithm:
    """Copy of an algorithm whose runs begin with a policy that was learned before.

    The network, the observation moments and the bound of normalised observations are
    those of the policy. So without noise a run begins with the same actions, if actions
    are held for the same number of control steps. The exploration noise is that of the
    configuration: `initial_log_std` should be far below 0, or the first updates destroy
    what was learned. The value network starts from random weights.

    Args:
        algorithm: `PPO`, `TRPO` or `SHAC`, whose configuration must have the policy's
            `hidden_sizes`.
        policy: The initial policy, for the same task.

    Raises:
        ValueError: The policy is no perceptron. When the run begins: the algorithm is
            not on-policy, or its own policy has another activation, another output or
            layers of other sizes.

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
        own = algorithm.policy(state)
        assert isinstance(own, MLPPolicy)
        if (policy.activation, policy.output) != (own.activation, own.output):
            raise ValueError(
                f"policy must have activation {own.activation!r} and output "
                f"{own.output!r}, as {algorithm.name} has; got {policy.activation!r} "
                f"and {policy.output!r}"
            )
        return _with_policy(state, policy)

    return dataclasses.replace(
        algorithm, name=f"{algorithm.name}_with_policy", init=init
    )


def _with_policy(state: OnPolicyState, policy: MLPPolicy) -> OnPolicyState:
    """The train state with the policy's network, moments and observation bound."""
    weights: dict[str, Any] = dict(state.weights)
    usual = weights["policy"]["mean"]
    own, given = _sizes(layers(usual)), _sizes(policy.layers)
    if own != given:
        raise ValueError(
            f"the policy's layers must have the sizes of the run's, {own}, as "
            f"hidden_sizes and the task have them; got {given}"
        )
    dtype = state.moments.mean.dtype
    names = [f"hidden_{i}" for i in range(len(own) - 1)] + ["output"]
    mean = {
        name: {"kernel": jnp.asarray(kernel, dtype), "bias": jnp.asarray(bias, dtype)}
        for name, (kernel, bias) in zip(names, policy.layers, strict=True)
    }
    weights["policy"] = {**weights["policy"], "mean": mean}
    limit = jnp.asarray(policy.limit, state.config.observation_limit.dtype)
    return dataclasses.replace(
        state,
        config=dataclasses.replace(state.config, observation_limit=limit),
        weights=weights,
        moments=jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), policy.moments),
    )


def _sizes(found: tuple[tuple[Array, Array], ...]) -> list[tuple[int, ...]]:
    return [kernel.shape for kernel, _ in found]
