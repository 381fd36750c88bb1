"""Returns of learners on an arm with the faults of real arms and sensors.

The task is `tracking` (variant "clean"). The arm is up to 30 % stiffer or softer than
its model, drawn for every episode. Commands arrive 20 ms late. Positions have noise of
5 mm, and each marker on the arm is missing half of the time. Four learners train on
this: PPO without memory (`mlp`), with a recurrent policy (`recurrent`), and each of
them also with a critic that sees everything (`mlp-privileged`,
`recurrent-privileged`). `ideal` is PPO without memory and without any of these faults.
Each policy is then evaluated without noise in its actions, on the task on which it was
trained. Writes a record of every run into records.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from benchmarks.shared.clocks import Clocks
from benchmarks.shared.learners import add_run_arguments, returns, run_all
from jaxrod.envs import Environment, make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import PPOConfig, train

RECORDS = Path(__file__).with_name("records")
DELAY = 0.02
"""Delay of the commands [s]."""
MARKERS = 11
"""Points of the arm in the observation: x of each, then y, then z."""
COMMON: dict[str, Any] = {
    "num_envs": 128,
    "action_repeat": 4,
    "rollout_steps": 64,
    "discount": 0.96,
    "max_log_std": 0.0,
    "final_max_log_std": -1.5,
}
"""Settings of all learners that differ from PPO's defaults."""
GRU: dict[str, Any] = {"gru_units": 64, "epochs": 4}
LEARNERS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "mlp": {},
    "recurrent": GRU,
    "mlp-privileged": {"privileged_critic": True},
    "recurrent-privileged": GRU | {"privileged_critic": True},
}
"""Settings by learner, beside those common to all."""


def task(name: str) -> Environment:
    """The task of a learner: `ideal` has none of the trouble."""
    plain: Any = make("tracking", variant="clean")
    if name == "ideal":
        return plain
    late = round(DELAY / plain.control_period)
    trouble = {
        "delay": [late, late],
        "parameters": {
            "arm.rod.bend_twist_stiffness": {"uniform": [0.7, 1.3], "scaled": True}
        },
        "noise": {"points of the arm": 0.005, "position of the target": 0.005},
        "dropout": {
            f"{k}, {k + MARKERS}, {k + 2 * MARKERS}": 0.5 for k in range(MARKERS)
        },
        "flags": True,
    }
    return make("tracking", variant="clean", randomise=trouble)


def trained(name: str, seed: int, steps: int) -> dict[str, Any]:
    """The record of a run."""
    env, config = task(name), PPOConfig(**(COMMON | LEARNERS[name]))
    clocks = Clocks()
    result = train(
        env,
        steps=steps,
        seed=seed,
        config=config,
        chunk_steps=max(steps // 20, 1),
        evaluation_episodes=0,
        progress=False,
    )
    wall, cpu = clocks.read()
    columns = ("env_steps", "episode_return_mean", "action_std")
    return {
        "learner": name,
        "seed": seed,
        "control_steps": result.summary["env_steps"],
        **returns(env, result.policy),
        "return_in_training": result.summary["final_score"],
        "wall_s": wall,
        "processor_s": cpu,
        "settings": COMMON | LEARNERS[name],
        "rows": [[row[column] for column in columns] for row in result.progress],
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
