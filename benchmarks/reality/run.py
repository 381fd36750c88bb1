"""Returns of learners on an arm with the faults of real arms and sensors.

The task is `tracking` (variant "clean"). The arm is up to 30 % stiffer or softer than
its model, drawn for every episode. Commands arrive 20 ms late. Positions have noise of
5 mm, and each marker on the arm is missing half of the time. Six learners train on
this: PPO without memory (`mlp`), PPO with a recurrent policy (`recurrent`), each of
them also with a critic that sees everything (`mlp-privileged`, `recurrent-privileged`),
DAgger (`imitator`), and DAgger followed by recurrent PPO (`recurrent-imitated`). DAgger
imitates a planner that sees everything and knows the delay. Its policy has no memory,
and sees its own last actions in addition to the sensors. In `recurrent-imitated` DAgger
has three quarters of the control steps, and recurrent PPO begins with its policy.
`ideal` is PPO without memory and without any of these faults. `ideal-softer` and
`ideal-stiffer` are the same on an arm that is ten per cent softer or stiffer than any
arm in training. `mlp-delay`, `mlp-dropout`, `mlp-noise`, `mlp-stiffness` and
`imitator-delay` have one of the faults. The benchmark then evaluates each policy
without noise in its actions, on its own task and on arms that are ten per cent softer
and stiffer than any arm in training.

`faults` trains nothing on faults. It evaluates the policy of `ideal` under each fault.
It also evaluates a planner that knows everything (`jaxrod.control.mpc`), with the delay
and without. The planner shows how much of a loss is due to physics, and not to
learning. Writes a record of every run into records.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.shared.clocks import Clocks
from benchmarks.shared.learners import EPISODES, add_run_arguments, returns, run_all
from jaxrod.control import mpc
from jaxrod.envs import Environment, make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import (
    DAggerConfig,
    evaluate,
    find_algorithm,
    train,
    warm_start,
)

RECORDS = Path(__file__).with_name("records")
DELAY = 0.02
"""Delay of the commands [s]."""
MARKERS = 11
"""Points of the arm in the observation: x of each, then y, then z."""
STIFFNESS = "arm.rod.bend_twist_stiffness"
OUTSIDE = {"softer": 0.9 * 0.7, "stiffer": 1.1 * 1.3}
"""Stiffness of arms outside of the training [of the nominal one]."""
DELAYS = (1, 2, 4, 7, 14)
"""Delays under which the policy of `ideal` is tried [control steps]."""
PLAN: dict[str, Any] = {
    "shape": "steps",
    "horizon": 48,
    "knots": 3,
    "replan": 16,
    "hold": 16,
    "effort": 1e-2,
    "smoothness": 0.0,
}
"""Plans of three actions, each held; they look beyond the delay."""
PLANNED = {"episodes": 8, "seed": 2}
"""Episodes of the planner: fewer, because every plan differentiates the arm."""
COMMON: dict[str, Any] = {
    "num_envs": 128,
    "action_repeat": 8,
    "rollout_steps": 32,
    "discount": 0.93,
    "max_log_std": 0.0,
    "final_max_log_std": -1.5,
}
"""Settings of all learners that differ from PPO's defaults."""
GRU: dict[str, Any] = {"gru_units": 64, "epochs": 4}
IMITATOR: dict[str, Any] = {"lookahead": 48, "planner_steps": 1.5e5}
"""Settings of DAgger that differ from its defaults: plans look beyond the delay."""
CLIMB: dict[str, Any] = GRU | {
    "num_envs": 128,
    "action_repeat": 16,
    "rollout_steps": 16,
    "discount": 0.93**2,
    "hidden_sizes": DAggerConfig().hidden_sizes,
    "initial_log_std": -3.0,
    "learning_rate": 5e-5,
}
"""Settings of PPO that begins with the imitator's policy: small noise and steps."""
IMITATED = 0.75
"""Part of the control steps of `recurrent-imitated` that DAgger takes [1]."""
PAST_ACTIONS = (1, 17)
"""Past actions that the imitator sees [control steps ago]: its last two, as it holds
each for 16."""
FAULTS = ("delay", "dropout", "noise", "stiffness")
LEARNERS: dict[str, dict[str, Any]] = {
    "ideal": {},
    **{f"ideal-{other}": {} for other in OUTSIDE},
    "mlp": {},
    "recurrent": GRU,
    "mlp-privileged": {"privileged_critic": True},
    "recurrent-privileged": GRU | {"privileged_critic": True},
    **{f"mlp-{fault}": {} for fault in FAULTS},
    "imitator": IMITATOR,
    "imitator-delay": IMITATOR,
    "recurrent-imitated": IMITATOR,
    "faults": {},
}
"""Settings by learner, beside those common to all."""


def options(plain: Environment, *faults: str) -> dict[str, Any]:
    """Options of a randomisation that has these faults."""
    # All arm tasks have a period, but not every environment has one.
    period: float = getattr(plain, "control_period")  # noqa: B009
    late = round(DELAY / period)
    every: dict[str, dict[str, Any]] = {
        "delay": {"delay": [late, late]},
        "dropout": {
            "dropout": {
                f"{k}, {k + MARKERS}, {k + 2 * MARKERS}": 0.5 for k in range(MARKERS)
            },
            "flags": True,
        },
        "noise": {
            "noise": {"points of the arm": 0.005, "position of the target": 5e-3}
        },
        "stiffness": {
            "parameters": {STIFFNESS: {"uniform": [0.7, 1.3], "scaled": True}}
        },
    }
    return {key: value for fault in faults for key, value in every[fault].items()}


def task(name: str) -> Environment:
    """The task of a learner: `ideal` has none of the faults, `mlp-delay` has one."""
    plain = make("tracking", variant="clean")
    if name in ("ideal", "faults"):
        return plain
    _, _, last = name.partition("-")
    if last in OUTSIDE:
        same = {"uniform": [OUTSIDE[last]] * 2, "scaled": True}
        return make(
            "tracking", variant="clean", randomise={"parameters": {STIFFNESS: same}}
        )
    faults = (last,) if last in FAULTS else FAULTS
    given = options(plain, *faults)
    if LEARNERS[name] is IMITATOR:
        given["past_actions"] = PAST_ACTIONS
    return make("tracking", variant="clean", randomise=given)


def outside(env: Any, policy: Any) -> list[float]:
    """Mean returns on arms of each stiffness in `OUTSIDE`."""
    params = env.default_params()
    found = []
    for stiffness in OUTSIDE.values():
        ranges = {STIFFNESS: jnp.full_like(params.ranges[STIFFNESS], stiffness)}
        apart = dataclasses.replace(params, ranges=ranges)
        found.append(evaluate(env, policy, env_params=apart, **EPISODES).mean)
    return found


def without_learning(plain: Environment, policy: Any) -> dict[str, float]:
    """Mean returns under single faults, of a policy that never met them."""
    found = {}
    for fault in ("dropout", "noise", "stiffness"):
        given = options(plain, fault) | {"flags": False}
        env = make("tracking", variant="clean", randomise=given)
        found[fault] = evaluate(env, policy, **EPISODES).mean
    late = make("tracking", variant="clean", randomise={"delay": [0, DELAYS[-1]]})
    params: Any = late.default_params()
    for delay in DELAYS:
        actuator = {"delay": jnp.full_like(params.actuator["delay"], delay)}
        fixed = dataclasses.replace(params, actuator=actuator)
        found[f"delay of {delay}"] = evaluate(
            late, policy, env_params=fixed, **EPISODES
        ).mean
    for name, env in (
        ("planner", make("tracking", variant="clean", randomise={"delay": 0})),
        (f"planner, delay of {DELAYS[-1]}", task("mlp-delay")),
    ):
        found[name] = float(np.mean(evaluate(env, mpc(env, **PLAN), **PLANNED).returns))
    return found


def stages(name: str, steps: int) -> list[tuple[str, int, dict[str, Any]]]:
    """Learners, control steps and settings; each begins with the policy before it."""
    if LEARNERS[name] is not IMITATOR:
        return [("ppo", steps, COMMON | LEARNERS[name])]
    if name != "recurrent-imitated":
        return [("dagger", steps, IMITATOR)]
    first = round(IMITATED * steps)
    return [("dagger", first, IMITATOR), ("ppo", steps - first, CLIMB)]


def trained(name: str, seed: int, steps: int) -> dict[str, Any]:
    """The record of a run."""
    env, policy, taken = task(name), None, 0
    clocks = Clocks()
    for learner, count, settings in stages(name, steps):
        algorithm = find_algorithm(learner)
        result = train(
            env,
            algorithm if policy is None else warm_start(algorithm, policy),
            steps=count,
            seed=seed,
            config=algorithm.config_type(**settings),
            chunk_steps=max(count // 20, 1),
            evaluation_episodes=0,
            progress=False,
        )
        policy = result.policy
        taken += result.summary["env_steps"]
    wall, cpu = clocks.read()
    columns = ("env_steps", "episode_return_mean", "action_std")
    more: dict[str, Any] = {}
    if name == "faults":
        more["without_learning"] = without_learning(env, result.policy)
    elif STIFFNESS in getattr(env.default_params(), "ranges", {}):
        more["outside"] = outside(env, result.policy)
    return {
        "learner": name,
        "seed": seed,
        "control_steps": taken,
        **returns(env, result.policy),
        **more,
        "return_in_training": result.summary["final_score"],
        "wall_s": wall,
        "processor_s": cpu,
        "settings": settings,
        "rows": [[row.get(column) for column in columns] for row in result.progress],
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks reality {name} --seeds {seed} "
        f"--steps {steps}",
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares learners, seeds and steps."""
    add_run_arguments(parser, LEARNERS, "LEARNER")


def run(args: argparse.Namespace) -> int:
    """Trains, plays and writes."""
    return run_all(args, trained, RECORDS)
