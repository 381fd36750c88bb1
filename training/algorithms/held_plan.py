r"""Actions improved by the model: what a planner would do instead.

The plan is one action $u$ in [-1, 1], held for some control steps, from the state $x$
on:

$$\min_u |r(x_h(u))|^2 + e |u|^2$$

with the environment's residuals $r$ at the end, and a small effort $e$, which selects
one of the many actions that reach the goal. It is a plan of `jaxrod.control.mpc` with
one step, as a function of its starting point. Such a short plan is cheap: one backward
pass for each of the few residuals. It is nearly a function of the state, so a network
can learn it. If it is recomputed before it has run out, it earns nearly as much as
actions that are linear between several knots (docs/optimum.md).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.control.planning.plans import PlanCost, by_gauss_newton, check_model
from jaxrod.envs import Environment
from jaxrod.envs.wrappers import ActionRepeat

PASSES = 4
"""Forward runs of the model per iteration: one at the action, three at others."""


def model_of(env: Environment) -> Any:
    """The environment as its own model.

    Raises:
        ValueError: The environment is not plannable.
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
    """Actions after Gauss-Newton steps from the given actions, and their costs.

    An action is left unchanged if a step brings no improvement or the model breaks.

    Args:
        model: An environment with `predict` and `residuals`.
        params: Its parameters.
        states: States of the environment; every leaf has a leading batch axis.
        actions: Initial actions, in [-1, 1].
        lookahead: Control steps for which an action is held.
        effort: Cost of the mean squared action.
        iterations: Number of Gauss-Newton steps.
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
