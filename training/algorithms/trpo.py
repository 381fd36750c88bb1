"""Trust region policy optimisation: natural gradients with a bounded policy change.

Source: Schulman et al., "Trust region policy optimization", 2015.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxrod.structure import pytree, static
from jaxrod.training.algorithm import (
    Algorithm,
    Metrics,
    mean_over_devices,
    steps_per_update,
)
from jaxrod.training.algorithms.on_policy import (
    Experience,
    OnPolicyConfig,
    OnPolicyState,
    check_on_policy,
    deterministic_policy,
    fit_value,
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
from jaxrod.training.settings import (
    Scalar,
    check_counts,
    check_fractions,
    check_not_negative,
    check_positive,
)


@pytree
class TRPOConfig(OnPolicyConfig):
    """Settings of TRPO; more are in `OnPolicyConfig` and `LearnerConfig`.

    Example:
        >>> config = training.TRPOConfig(max_kl=0.02)  # it falls to `final_max_kl`
        >>> config.max_kl, config.final_max_kl
        (0.02, 0.01)
    """

    rollout_steps: int = static(default=64)
    conjugate_iterations: int = static(default=10)
    """Number of conjugate gradient iterations in one update."""
    fisher_stride: int = static(default=5)
    """Stride k: the Fisher matrix is computed from every k-th time step."""
    line_search_tries: int = static(default=10)
    """Largest number of step lengths that the line search tries."""
    value_epochs: int = static(default=8)
    """Number of passes over the experience of one update when the value network is
    fitted."""
    value_minibatches: int = static(default=8)
    """Number of gradient steps in one pass; divides `rollout_steps`."""
    max_kl: Scalar = 0.01
    """Bound on the policy's change in the first update: KL(old policy, new policy),
    averaged over the observations [nat]."""
    final_max_kl: Scalar = 0.01
    """Bound on the policy's change in the last update [nat]; the bound is linear in
    between."""
    damping: Scalar = 0.01
    """Damping d: F + d I replaces the Fisher matrix F."""
    line_search_shrink: Scalar = 0.5
    """Factor from one step length to the next in the line search."""
    trace_decay: Scalar = 0.98
    value_learning_rate: Scalar = 1e-3
    """Step size of Adam for the value network."""


def validate(config: TRPOConfig, num_devices: int = 1) -> None:
    """Validates a configuration on the host.

    Raises:
        ValueError: A setting is wrong; the message has its name and value.
    """
    check_on_policy(config, num_devices)
    check_counts(
        config,
        "conjugate_iterations",
        "fisher_stride",
        "line_search_tries",
        "value_epochs",
        "value_minibatches",
    )
    if config.rollout_steps % config.value_minibatches:
        raise ValueError(
            f"value_minibatches must divide rollout_steps, {config.rollout_steps}, "
            f"got {config.value_minibatches}"
        )
    check_fractions(config, "line_search_shrink")
    check_positive(config, "max_kl", "final_max_kl")
    check_positive(config, "value_learning_rate", "line_search_shrink")
    check_not_negative(config, "damping")


def _value_optimiser(config: TRPOConfig) -> optax.GradientTransformation:
    """Adam for the value network, without a step size, which `fit_value` applies."""
    del config
    adam = optax.scale_by_adam()
    return optax.GradientTransformation(
        lambda weights: adam.init(weights["value"]), adam.update
    )


init = functools.partial(start, make_optimiser=_value_optimiser)
"""Function that makes the train state before the first update, see
`on_policy.start`."""


def update(
    state: OnPolicyState, axis_name: str | None = None
) -> tuple[OnPolicyState, Metrics]:
    """One update: acts, estimates advantages, steps within the trust region, fits V.

    Args:
        state: The train state.
        axis_name: Mapped axis over which the environments are spread, if any.
    """
    state, experience, episodes = gather_experience(state, axis_name)
    policy, scalars = _improve_policy(state, experience, axis_name)
    state = dataclasses.replace(state, weights=state.weights | {"policy": policy})
    state, value_loss = _fit_value(state, experience, axis_name)
    scalars |= {
        "value_loss": value_loss,
        "value_error": jnp.mean((experience.value_target - experience.value) ** 2),
        "return_mean": jnp.mean(experience.value_target),
        "reward_mean": jnp.mean(experience.reward),
        "action_std": jnp.mean(jnp.exp(policy["log_std"])),
    }
    state = dataclasses.replace(state, updates=state.updates + 1)
    return state, Metrics(mean_over_devices(scalars, axis_name), episodes)


def _improve_policy(
    state: OnPolicyState, experience: Experience, axis_name: str | None
) -> tuple[Any, dict[str, Array]]:
    """Natural gradient step of the policy, scaled to the KL bound, with a line search.

    Returns:
        The new weights of the policy, and scalars for the report.
    """
    config: TRPOConfig = state.config
    advantage = standardised(experience.advantage, (0, 1), axis_name)
    experience = dataclasses.replace(experience, advantage=advantage)
    rows = experience.observation[:: config.fisher_stride]
    every_so_many = rows.reshape(-1, rows.shape[-1])
    batch = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), experience)
    network = policy_network(state.env, config, batch.observation.dtype)
    start, as_weights = ravel_pytree(state.weights["policy"])

    def outputs(parameters: Array, observation: Array) -> tuple[Array, Array]:
        return network.apply({"params": as_weights(parameters)}, observation)

    old_mean, old_log_std = outputs(start, batch.observation)

    def objective(parameters: Array) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Surrogate mean(q A) + entropy_weight H, and mean KL(old policy, new policy).

        q is the ratio of the probabilities of an action by the new and the old policy,
        A the advantage, and H the entropy.
        """
        mean, log_std = outputs(parameters, batch.observation)
        noise = (batch.action - mean) * jnp.exp(-log_std)[None]
        ratio = jnp.exp(log_density(noise, log_std) - batch.log_prob)
        gain = jnp.mean(ratio * batch.advantage)
        entropy = gaussian_entropy(log_std)
        kl = mean_divergence(old_mean, old_log_std, mean, log_std)
        return gain + config.entropy_weight * entropy, kl

    gradient, _ = jax.grad(objective, has_aux=True)(start)
    gradient = mean_over_devices(gradient, axis_name)
    fisher = fisher_product(lambda p: outputs(p, every_so_many), start)

    def product(vector: Array) -> Array:
        return mean_over_devices(fisher(vector), axis_name) + config.damping * vector

    direction = conjugate_gradient(product, gradient, config.conjugate_iterations)
    max_kl = along_the_run(state, config.max_kl, config.final_max_kl, gradient.dtype)
    step = longest_step(product, direction, max_kl)
    before, _ = mean_over_devices(objective(start), axis_name)

    def acceptable(parameters: Array) -> Array:
        after, kl = mean_over_devices(objective(parameters), axis_name)
        # Also False if a number is NaN.
        return (after > before) & (kl <= max_kl)

    search = backtrack(
        acceptable, start, step, config.line_search_shrink, config.line_search_tries
    )
    after, kl = objective(search.point)
    weights = as_weights(search.point)
    return weights, {
        "policy_gain": after - before,
        "kl": kl,
        "entropy": gaussian_entropy(weights["log_std"]),
        "gradient_norm": jnp.sqrt(jnp.vdot(gradient, gradient)),
        "accepted": search.accepted.astype(after.dtype),
        "backtracks": search.backtracks.astype(after.dtype),
        "max_kl": max_kl,
    }


def mean_divergence(
    old_mean: Float[Array, "samples action"],
    old_log_std: Float[Array, " action"],
    mean: Float[Array, "samples action"],
    log_std: Float[Array, " action"],
) -> Float[Array, ""]:
    """KL(old, new) of normal distributions, averaged over the samples [nat].

    KL = sum(log(s'/s) + (s^2 + (m - m')^2) / (2 s'^2) - 1/2), with the means m and
    standard deviations s; a prime marks the new distribution. It is computed with
    expm1, so that float32 resolves nearly equal distributions.
    """
    change = log_std - old_log_std
    spread = change + 0.5 * jnp.expm1(-2 * change)
    shift = 0.5 * ((mean - old_mean) * jnp.exp(-log_std)[None]) ** 2
    return jnp.sum(spread) + jnp.mean(jnp.sum(shift, axis=-1))


def _fit_value(
    state: OnPolicyState, experience: Experience, axis_name: str | None
) -> tuple[OnPolicyState, Float[Array, ""]]:
    """Fits the value network to the value targets.

    Returns:
        The updated state, and the mean loss.
    """
    config: TRPOConfig = state.config
    shuffle_key, own = jax.random.split(state.shuffle_key)
    weights, memory, error = fit_value(
        value_network(config, experience.observation.dtype),
        (state.weights["value"], state.optimiser),
        _value_optimiser(config),
        (experience.observation, experience.value_target),
        own,
        (config.value_epochs, config.value_minibatches),
        rate=config.value_learning_rate,
        weight=0.5,
        axis_name=axis_name,
    )
    state = dataclasses.replace(
        state,
        weights=state.weights | {"value": weights},
        optimiser=memory,
        shuffle_key=shuffle_key,
    )
    return state, error


TRPO = Algorithm(
    name="trpo",
    config_type=TRPOConfig,
    validate=validate,
    steps_per_update=steps_per_update,
    init=init,
    update=update,
    partition=partition,
    policy=deterministic_policy,
)
"""TRPO as an `Algorithm`, for `jaxrod.training.train`."""


Vector = Float[Array, " parameters"]


def fisher_product(
    outputs: Callable[[Vector], tuple[Array, Array]],
    parameters: Vector,
) -> Callable[[Vector], Vector]:
    """Function v -> F v for the Fisher matrix F of a normal distribution over actions.

    F is the Hessian of the mean KL divergence from the distribution at `parameters`,
    evaluated there. With J the Jacobian of (mean, log std), F = J^T M J. The diagonal
    matrix M is 1 / (samples std^2) for a mean and 2 for a log std. The outputs are
    linearised once: every product takes one forward and one backward pass.

    Args:
        outputs: Function from the parameters to the mean, shape (samples, actions), and
            the log std, shape (actions,).
        parameters: Point at which the matrix is evaluated.

    Source: Schulman et al., "Trust region policy optimization", 2015, appendix C.
    """
    (mean, log_std), forwards = jax.linearize(outputs, parameters)
    backwards = jax.linear_transpose(forwards, parameters)
    precision = jnp.exp(-2 * log_std)[None] / mean.shape[0]

    def product(vector: Vector) -> Vector:
        of_mean, of_log_std = forwards(vector)
        return backwards((precision * of_mean, 2 * of_log_std))[0]

    return product


def conjugate_gradient(
    product: Callable[[Vector], Vector],
    right_side: Vector,
    iterations: int,
    tolerance: float = 1e-10,
) -> Vector:
    """Conjugate gradients: solves A x = b for a positive definite A, from products A x.

    It stops early when the squared residual is below `tolerance` times its initial
    value, because further iterations would only add round-off.

    Args:
        product: Function that returns A x for a vector x.
        right_side: Right-hand side b.
        iterations: Largest number of products.
        tolerance: Relative tolerance of the squared residual.
    """
    enough = tolerance * jnp.vdot(right_side, right_side)

    def improve(_: Int[Array, ""], carry: tuple[Vector, ...]) -> tuple[Vector, ...]:
        solution, residual, direction, square = carry
        image = product(direction)
        curvature = jnp.vdot(direction, image)
        go_on = (square > enough) & (curvature > 0)
        length = jnp.where(go_on, square / jnp.where(go_on, curvature, 1), 0)
        solution = solution + length * direction
        residual = residual - length * image
        following = jnp.where(go_on, jnp.vdot(residual, residual), square)
        ratio = jnp.where(go_on, following / jnp.where(go_on, square, 1), 0)
        direction = jnp.where(go_on, residual + ratio * direction, direction)
        return solution, residual, direction, following

    start = (
        jnp.zeros_like(right_side),
        right_side,
        right_side,
        jnp.vdot(right_side, right_side),
    )
    return jax.lax.fori_loop(0, iterations, improve, start)[0]


def longest_step(
    product: Callable[[Vector], Vector], direction: Vector, bound: Scalar
) -> Vector:
    """Scales a direction s so that s^T A s / 2 = bound; `product` returns A s.

    A direction with s^T A s <= 0 becomes zero.
    """
    quadratic = 0.5 * jnp.vdot(direction, product(direction))
    sound = quadratic > 0
    scale = jnp.sqrt(bound / jnp.where(sound, quadratic, 1))
    return jnp.where(sound, scale, 0) * direction


@pytree
class LineSearch:
    """Result of a backtracking line search."""

    point: Vector
    """Accepted point; the starting point if none was accepted."""
    accepted: Bool[Array, ""]
    """Whether a point was accepted."""
    backtracks: Int[Array, ""]
    """Number k of times that the step was shortened."""


def backtrack(
    acceptable: Callable[[Vector], Bool[Array, ""]],
    start: Vector,
    step: Vector,
    shrink: Scalar,
    tries: int,
) -> LineSearch:
    """Line search: the first acceptable point start + shrink^k step, k = 0, 1, ...

    Args:
        acceptable: Function that returns whether a point is acceptable.
        start: Starting point.
        step: Step of the first try, from the starting point.
        shrink: Factor from one try to the next.
        tries: Largest number of tries; if all fail, the result is the starting point.
    """

    def unfinished(carry: tuple[Array, Array]) -> Bool[Array, ""]:
        tried, accepted = carry
        return ~accepted & (tried < tries)

    def attempt(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        tried, _ = carry
        return tried + 1, acceptable(start + _shortened(step, shrink, tried))

    tried, accepted = jax.lax.while_loop(
        unfinished, attempt, (jnp.int32(0), jnp.array(False))
    )
    backtracks = tried - 1
    found = start + _shortened(step, shrink, backtracks)
    return LineSearch(jnp.where(accepted, found, start), accepted, backtracks)


def _shortened(step: Vector, shrink: Scalar, times: Int[Array, ""]) -> Vector:
    return jnp.asarray(shrink, step.dtype) ** times * step
