r"""Actions made better by the model: what a planner would do instead.

A plan of one action $u$ in [-1, 1], held for some control steps, from the state $x$ on:

$$\min_u |r(x_h(u))|^2 + e |u|^2$$

with the environment's residuals $r$ at the end, and a small effort $e$, which chooses
among the many actions that do it: a plan of `jaxrod.control.mpc` with one step, as a
function of where to begin. Being so short a plan it is cheap, a backward pass for each
of the few residuals, and nearly a function of the state, so that a network can learn
it; planned anew before it is acted out it earns nearly what a line of actions through
several knots does (docs/optimum.md).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.control.planning import PlanCost, by_gauss_newton
from jaxrod.control.planning_policy import check_model
from jaxrod.envs import Environment
from jaxrod.envs.action_repeat import ActionRepeat

PASSES = 4
"""Times that an iteration runs the model forward: at the action, at three others."""


def model_of(env: Environment) -> Any:
    """The environment as a model of itself.

    Raises:
        ValueError: It is none.
    """
    model = env.env if isinstance(env, ActionRepeat) else env
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
    """Actions after Gauss-Newton steps from those given, and what they cost.

    Where a step makes nothing better, or the model breaks, an action is left as it is.

    Args:
        model: An environment with `predict` and `residuals`.
        params: Its parameters.
        states: Its states, every leaf with the batch in front.
        actions: Where to begin, in [-1, 1].
        lookahead: Control steps for which an action is held.
        effort: Cost of the mean squared action.
        iterations: Steps of the method.
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
