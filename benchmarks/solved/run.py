"""Share of new starts from which policies and a planner solve a task.

Plays each policy, the planner (`planner`) and random actions (`random`) from the same
starts, which no training has seen. A start is solved if its episode ends with
`info["success"]`, as the task defines it: with the end of a rope at a target (`lift`),
with the tip of a cable in a socket (`insert`), or with the tip of a catheter in a
branch of a vessel (`catheter`). Runs in single precision, as training does. Writes a
record of each into records.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

import jaxrod
from benchmarks.shared.clocks import Clocks
from benchmarks.shared.files import write_record
from jaxrod.control import mpc
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import load_policy

RECORDS = Path(__file__).with_name("records")
STARTS_SEED = 2026
STARTS = 256
LIFTING: dict[str, Any] = {
    "method": "gradient",
    "horizon": 12,
    "knots": 4,
    "hold": 3,
    "replan": 3,
    "iterations": 8,
}
"""Settings of `jaxrod.control.mpc`: plans of 1.2 s by Adam, renewed every 0.3 s."""
INSERTING: dict[str, Any] = {"horizon": 12, "knots": 4, "hold": 3, "replan": 3}
"""The same by Gauss-Newton, one iteration each."""
TASKS: dict[str, tuple[dict[str, Any], dict[str, str]]] = {
    "lift": (LIFTING, {"distance": "m"}),
    "insert": (INSERTING, {"depth": "m", "offset": "m", "angle": "rad"}),
    "catheter": (INSERTING, {"depth": "m", "offset": "m"}),
}
"""Settings of the planner, and entries of `info` with their units, by task."""


def chosen(name: str, task: str, env: Any) -> tuple[Any, Any]:
    """Functions that begin a player's memory and choose the actions of a batch."""
    if name == "planner":
        policy = mpc(env, **TASKS[task][0])
        return policy.init, policy.act
    if name == "random":

        def drawn(key: Array, observation: Array, state: Any) -> tuple[Array, Array]:
            key, now = jax.random.split(key)
            size = (len(observation), env.action_size)
            return jax.random.uniform(now, size, minval=-1.0), key

        return lambda observation, state: jax.random.key(7), drawn
    learned = load_policy(name)
    return (
        lambda observation, state: None,
        lambda memory, observation, state: (jax.vmap(learned)(observation), memory),
    )


def played(name: str, task: str, starts: int) -> dict[str, Any]:
    """Returns, solved starts and times of a player, without compiling."""
    env, units = make(task), TASKS[task][1]
    params = env.default_params()
    begin, act = chosen(name, task, env)
    step = jax.vmap(env.step, (0, 0, 0, None))

    def play(keys: Array) -> tuple[Array, ...]:
        observation, state = jax.vmap(env.reset, (0, None))(keys, params)

        def one(carry: Any, _: None) -> tuple[Any, tuple[Array, ...]]:
            observation, state, memory = carry
            action, memory = act(memory, observation, state)
            observation, state, reward, _, _, info = step(keys, state, action, params)
            told = reward, info["success"], info["flagged"], {k: info[k] for k in units}
            return (observation, state, memory), told

        begun = observation, state, begin(observation, state)
        return jax.lax.scan(one, begun, length=env.episode_length)[1]

    keys = jax.random.split(jax.random.key(STARTS_SEED), starts)
    compiling = Clocks()
    compiled = jax.jit(play).lower(keys).compile()
    _, compile_cpu = compiling.read()
    clocks = Clocks()
    rewards, success, flagged, told = jax.tree.map(np.asarray, compiled(keys))
    wall, cpu = clocks.read()
    returns = np.sum(rewards, axis=0)
    return {
        "starts": starts,
        "solved": float(np.mean(success[-1])),
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns)),
        **{
            f"median_last_{name}_{unit}": float(np.median(told[name][-1]))
            for name, unit in units.items()
        },
        "flagged": float(np.mean(np.any(flagged, axis=0))),
        "compile_processor_s": compile_cpu,
        "wall_s": wall,
        "processor_s": cpu,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the players and the task."""
    parser.add_argument("players", nargs="+", metavar="RUN/policy|planner|random")
    parser.add_argument("--task", choices=TASKS, default="lift", help="(lift)")
    parser.add_argument(
        "--starts", type=int, default=STARTS, metavar="N", help=f"({STARTS})"
    )


def run(args: argparse.Namespace) -> int:
    """Plays, prints and writes."""
    jaxrod.configure_cpu()
    for name in args.players:
        found = played(name, args.task, args.starts)
        print(f"{name}: {json.dumps(found)}", flush=True)
        # RUN/policy: the folder of the run names its record.
        known = name in ("planner", "random")
        label = name if known else Path(name).parent.name
        player = name if known else f"{label}/policy"
        words = f"{player} --task {args.task} --starts {args.starts}"
        record = {
            **found,
            "machine": processor_and_versions(),
            "command": f"python -m benchmarks solved {words}",
        }
        if name == "planner":
            record["settings"] = TASKS[args.task][0]
        write_record(RECORDS, f"{args.task}-{label}", record)
    return 0
