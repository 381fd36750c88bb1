"""Returns of planners that know the arm in the task `following`.

`jaxrod.control.mpc` by Gauss-Newton on the first of the learners' episodes. A planner
sees the whole state and differentiates the simulation; what heading the target takes
next it does not know. It makes small the task's smooth cost, not the reward.
"""

from __future__ import annotations

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from benchmarks.following.learned import EPISODES, EPISODES_SEED, RECORDS, discounted
from benchmarks.shared.clocks import Clocks
from benchmarks.shared.files import write_record
from jaxrod.control import mpc
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions


def held(horizon: int, effort: float = 1e-2) -> dict[str, Any]:
    """One change of the angles over the horizon, planned again in each control step."""
    return {
        "horizon": horizon,
        "knots": 1,
        "hold": 1,
        "replan": 1,
        "shape": "steps",
        "effort": effort,
    }


def line(horizon: int, hold: int) -> dict[str, Any]:
    """One knot and one plan for every `hold` control steps."""
    return {"horizon": horizon, "knots": horizon // hold, "hold": hold, "replan": hold}


PLANNERS: dict[str, dict[str, Any]] = {
    **{f"held-{horizon}": held(horizon) for horizon in (2, 3, 4, 5, 7)},
    **{f"line-{horizon}": line(horizon, 2) for horizon in (6, 8, 10)},
    "held-3-effort": held(3, 5e-2),
}
"""Settings of `jaxrod.control.mpc`."""


def planned(settings: dict[str, Any], episodes: int) -> dict[str, Any]:
    """Returns of a planner, and the times without compiling."""
    env = make("following")
    params, policy = env.default_params(), mpc(env, **settings)

    def play(pairs: Key[Array, "episodes 2"]) -> tuple[Array, Array, Array]:
        observation, state = jax.vmap(env.reset, (0, None))(pairs[:, 0], params)
        keys = jax.vmap(lambda key: jax.random.split(key, env.episode_length))(
            pairs[:, 1]
        )

        def step(carry: Any, keys: Array) -> tuple[Any, tuple[Array, Array, Array]]:
            observation, state, memory = carry
            action, memory = policy.act(memory, observation, state)
            observation, state, reward, _, _, info = jax.vmap(
                env.step, (0, 0, 0, None)
            )(keys, state, action, params)
            told = reward, info["distance"], info["flagged"]
            return (observation, state, memory), told

        begun = observation, state, policy.init(observation, state)
        return jax.lax.scan(step, begun, jnp.swapaxes(keys, 0, 1))[1]

    # The keys of the learners' episodes.
    keys = jax.random.split(jax.random.key(EPISODES_SEED), EPISODES)[:episodes]
    pairs = jax.vmap(jax.random.split)(keys)
    compiled = jax.jit(play).lower(pairs).compile()
    clocks = Clocks()
    rewards, distances, flagged = map(np.asarray, compiled(pairs))
    wall, cpu = clocks.read()
    return {
        "wall_s": wall,
        "processor_s": cpu,
        "episodes": episodes,
        **discounted(rewards.T),
        "median_distance": float(np.median(distances)),
        "within_5_cm": float(np.mean(distances < 0.05)),
        "flagged": float(np.mean(np.any(flagged, axis=0))),
    }


def plan(name: str, episodes: int) -> None:
    """Writes the record of a planner."""
    found = planned(PLANNERS[name], episodes)
    print(f"{name}: {json.dumps(found)}", flush=True)
    record = {
        "settings": PLANNERS[name],
        **found,
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks following {name} --episodes {episodes}",
    }
    write_record(RECORDS, f"planned-{name}", record)
