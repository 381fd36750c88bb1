"""Returns in every task, plain and randomised, in the same control steps.

Trains each task three times with the same learner, settings and number of control
steps: the plain task (`plain`), a task with random bodies, faulty actuators and faulty
sensors (`randomised`), and a randomisation that widens during the run (`widened`). A
body is up to a fifth softer or stiffer and some per cent heavier or lighter than its
model. Commands arrive up to `Task.delay` control steps late, through actuators with a
lag of up to 20 ms. All entries of the observation have noise, and each is missing in
2 % of the control steps.

Evaluates policies without noise in their actions, the last two under the full
randomisation, and random actions with and without it. The third run begins with the
plain task. Its randomisation widens if the gain of training episodes is more than half
of the plain run's gain in training, and narrows if it is less than a quarter. Writes a
record of each task into records, then the table of docs/randomisation.md from all
records.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import jaxrod
from benchmarks.baselines.run import played
from benchmarks.shared.arguments import add_names
from benchmarks.shared.clocks import Clocks
from benchmarks.shared.files import ROOT, write_record
from benchmarks.shared.page_tables import measured_table
from jaxrod.envs import make
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import PPOConfig, evaluate, train

RECORDS = Path(__file__).with_name("records")
PAGE = ROOT / "docs" / "randomisation.md"
HEAD = (
    "| task | control steps | random actions: plain; randomised | plain | randomised "
    "| of the gain | widened | of the gain | share reached |\n"
    "|---|---:|---:|---:|---:|---:|---:|---:|---:|"
)
EPISODES = {"episodes": 64, "seed": 2}
"""Number of episodes that count, and their seed, which no training used."""
LAG, DROPOUT = 0.02, 0.02
"""Longest time constant of the actuators [s]; probability of a missing entry."""
STIFFNESS, MASS = [0.8, 1.25], [1.0, 0.05]
"""Factors: lowest and highest; mean and standard deviation."""
CHUNKS = 40
"""Number of decisions of the widening in a run, at most."""

BODIES: dict[str, Any] = {
    "num_envs": 64,
    "rollout_steps": 32,
    "epochs": 8,
    "minibatches": 8,
    "learning_rate": 5e-4,
    "final_learning_rate": 1e-4,
    "entropy_weight": 0.01,
    "discount": 0.95,
    "trace_decay": 0.9,
    "initial_log_std": -0.5,
}
"""Settings of gripper, rope and cable, as `python -m benchmarks training` has them."""
ARM: dict[str, Any] = {
    "action_repeat": 8,
    "rollout_steps": 32,
    "discount": 0.93,
    "max_log_std": 0.0,
    "final_max_log_std": -1.5,
}
"""Settings of arms in the open, as `python -m benchmarks reality` has them."""
MAZE: dict[str, Any] = {
    "action_repeat": 3,
    "rollout_steps": 64,
    "discount": 0.985,
    "trace_decay": 0.96,
}
"""Settings among obstacles, as `python -m benchmarks best_learners` has them."""


@dataclasses.dataclass(frozen=True)
class Task:
    """A task, and how it is trained and randomised."""

    steps: int
    """Control steps of each run."""
    rods: str
    """Path of the parameters of its rods."""
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of PPO that differ from its defaults."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task."""
    delay: int = 1
    """Longest delay of a command [control steps]."""
    noise: float = 0.02
    """Standard deviation of the noise, in the unit of each entry."""
    made_by: str = ""
    """Import path, for a task that is not built in."""


CLEAN = {"variant": "clean"}
ARMS: dict[str, Any] = {
    "rods": "arm.rod",
    "options": CLEAN,
    "delay": 3,
    "noise": 0.002,
}
"""The four tasks of the published benchmark."""
TASKS = {
    "tracking": Task(2_000_000, settings=ARM, **ARMS),
    "reaching": Task(1_000_000, settings=ARM, **ARMS),
    "structured": Task(1_200_000, settings=MAZE, **ARMS),
    "unstructured": Task(1_200_000, settings=MAZE, **ARMS),
    "following": Task(300_000, "arm.rod", {"rollout_steps": 32}, noise=0.005),
    "snake": Task(100_000, "body.rod"),
    "octopus": Task(50_000, "body.system.members.arms.rod", {"rollout_steps": 32}),
    "gripper": Task(100_000, "body.system.members.fingers.rod", BODIES),
    "lift": Task(400_000, "body.scene.rod", BODIES),
    "insert": Task(400_000, "body.scene.rod", BODIES),
    "catheter": Task(60_000, "body.scene.rod", BODIES),
    "own": Task(
        200_000,
        "scene.rod",
        {"rollout_steps": 32},
        noise=0.005,
        made_by=f"{ROOT / 'examples' / 'own_task.py'}:make_task",
    ),
}
"""All tasks that are worth varying; `own` is the one of `examples/own_task.py`."""


def randomisation(task: Task) -> dict[str, Any]:
    """The options of the full randomisation of a task, as its TOML file has them."""
    heavy = f"{task.rods}.linear_density, {task.rods}.rotary_inertia"
    return {
        "delay": [0, task.delay],
        "lag_seconds": [0.0, LAG],
        "parameters": {
            f"{task.rods}.bend_twist_stiffness": {
                "log_uniform": STIFFNESS,
                "scaled": True,
            },
            heavy: {"normal": MASS, "scaled": True},
        },
        "noise": task.noise,
        "dropout": DROPOUT,
    }


def environment(name: str, randomise: dict[str, Any] | None = None) -> Any:
    """The task of this name, with a randomisation or without."""
    task = TASKS[name]
    return make(task.made_by or name, randomise=randomise, **task.options)


def by_chance(env: Any) -> float:
    """Mean return of random actions."""
    return float(np.mean(played(env, EPISODES["episodes"], False).episode_return))


def learned(env: Any, task: Task) -> dict[str, Any]:
    """The results of a run on an environment, evaluated under its defaults."""
    clocks = Clocks()
    result = train(
        env,
        "ppo",
        steps=task.steps,
        config=PPOConfig(**task.settings),
        chunk_steps=task.steps // CHUNKS,
        evaluation_episodes=0,
        progress=False,
    )
    wall, cpu = clocks.read()
    found = evaluate(env, result.policy, **EPISODES)
    return {
        "return": found.mean,
        "flagged": found.flagged_fraction,
        "return_in_training": result.summary["final_score"],
        "control_steps": result.summary["env_steps"],
        "share": result.summary.get("randomisation_share"),
        "wall_s": wall,
        "processor_s": cpu,
    }


def measured(name: str) -> dict[str, Any]:
    """The record of a task: random actions, and its three runs."""
    task = TASKS[name]
    full = randomisation(task)
    plain, varied = environment(name), environment(name, full)
    record: dict[str, Any] = {
        "task": name,
        "random": by_chance(plain),
        "random_randomised": by_chance(varied),
        "plain": learned(plain, task),
        "randomised": learned(varied, task),
    }
    low, high = record["random"], record["plain"]["return_in_training"]
    rule = {
        "above": low + 0.5 * (high - low),
        "below": low + 0.25 * (high - low),
        "start": 0.0,
        "step": 0.25,
        "episodes": 16,
    }
    record["widened"] = learned(environment(name, full | {"widening": rule}), task)
    return record | {
        "widening": rule,
        "settings": task.settings,
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks randomised {name}",
    }


def gain(record: dict[str, Any], run: str) -> float:
    """Fraction of the gain over random actions that a randomised run keeps."""
    most = record["plain"]["return"] - record["random"]
    return (record[run]["return"] - record["random_randomised"]) / most


def rows() -> Iterable[str]:
    """Rows of the table, from all records."""
    for name in TASKS:
        path = RECORDS / f"{name}.json"
        if not path.exists():
            continue
        one = json.loads(path.read_text())
        digits = 0 if abs(one["plain"]["return"]) > 1000 else 1

        def shown(value: float, digits: int = digits) -> str:
            return f"{value:,.{digits}f}"

        cells = [
            f"`{name}`" if not TASKS[name].made_by else "`examples/own_task.py`",
            f"{one['plain']['control_steps'] / 1e6:.2g} million",
            f"{shown(one['random'])}; {shown(one['random_randomised'])}",
            shown(one["plain"]["return"]),
            shown(one["randomised"]["return"]),
            f"{100 * gain(one, 'randomised'):.0f} %",
            shown(one["widened"]["return"]),
            f"{100 * gain(one, 'widened'):.0f} %",
            f"{one['widened']['share']:g}",
        ]
        yield f"| {' | '.join(cells)} |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tasks."""
    add_names(parser, "tasks", TASKS, "TASK")
    parser.add_argument("--dry", action="store_true", help="leave the page as it is")


def run(args: argparse.Namespace) -> int:
    """Trains, writes records, and writes the table."""
    jaxrod.configure_cpu(1)
    for name in args.tasks:
        record = measured(name)
        write_record(RECORDS, name, record)
        print(json.dumps(record), flush=True)
    measured_table(PAGE, "randomised", HEAD, rows, dry=args.dry)
    return 0
