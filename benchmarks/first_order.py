"""Learning by gradients of the simulation beside learning without.

    python -m benchmarks.first_order [TASK:ALGORITHM ...] [--seeds 0 1 2 3 4]

Trains PPO, DAgger and SHAC on the tasks `tracking` and `reaching` (variant "clean"), or
the cells named, a seed at a time, in float32 on one core. Now and then the clocks stop
and the policy is evaluated without noise, on the same episodes for all. Writes a record
of every run into benchmarks/first_order and docs/first_order.md with its picture from
all records there are. `--pages` trains nothing and writes the page from the records.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import time
from typing import Any

import jax
import numpy as np

import jaxrod
from benchmarks.first_order_page import RECORDS, write_pages
from jaxrod.envs import make
from jaxrod.files import write_atomically
from jaxrod.installation.machine import processor_and_versions
from jaxrod.training import evaluate, find_algorithm

SEEDS = (0, 1, 2, 3, 4)
EPISODES = 64
EPISODES_SEED = 1
"""Of the episodes that policies are evaluated on: those of `jaxrod evaluate`."""
POINTS = 8
"""Evaluations along a run, about; PPO's recorded runs have twice as many."""
STEPS: dict[str, dict[str, int]] = {
    "tracking": {"ppo": 10_000_000, "dagger": 1_000_000, "shac": 2_000_000},
    "reaching": {"ppo": 10_000_000, "dagger": 1_500_000, "shac": 2_000_000},
}
"""Control steps of a run."""
SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "tracking": {"ppo": {}, "dagger": {"plan_iterations": 2}, "shac": {}},
    "reaching": {
        "ppo": {},
        "dagger": {"short_steps": 1.0e9, "short_length": 480.0},
        "shac": {},
    },
}
"""What differs from the learners' defaults."""


def trained(task: str, algorithm: str, seed: int, steps: int) -> dict[str, Any]:
    """The record of a run."""
    env = make(task, variant="clean")
    learner = find_algorithm(algorithm)
    config = dataclasses.replace(learner.config_type(), **SETTINGS[task][algorithm])
    learner.validate(config, 1)
    per_update = learner.steps_per_update(config)
    updates = -(-steps // per_update)
    chunk = max(1, updates // POINTS)
    clocks = Clocks()

    params = env.default_params()
    start = jax.jit(learner.init, static_argnums=(1, 4))
    state = start(jax.random.key(seed), env, config, params, updates * per_update)
    update = jax.jit(learner.update, donate_argnums=0)
    update = update.lower(state).compile()
    jax.block_until_ready(state)
    compiling = clocks.read()

    rows, simulated, done = [], 0.0, 0
    while done < updates:
        metrics = None
        for _ in range(min(chunk, updates - done)):
            state, metrics = update(state)
            simulated += float(metrics.scalars.get("model_steps", 0.0))
            done += 1
        wall, cpu = clocks.read()
        clocks.stop()
        found = evaluate(
            env, learner.policy(state), episodes=EPISODES, seed=EPISODES_SEED
        )
        rows.append(
            {
                "control_steps": done * per_update,
                "model_steps": simulated,
                "wall_s": wall,
                "processor_s": cpu,
                "return": found.mean,
                "deviation": found.standard_deviation,
                "flagged": float(found.flagged_fraction),
            }
        )
        print(
            f"{task} {algorithm} {seed}: {done * per_update:,} steps, {wall:.0f} s, "
            f"processor {cpu:.0f} s, {found.mean:,.0f}",
            flush=True,
        )
        clocks.go()
    return {
        "task": task,
        "algorithm": algorithm,
        "seed": seed,
        "settings": SETTINGS[task][algorithm],
        "compile_s": compiling[0],
        "compile_processor_s": compiling[1],
        "episodes": EPISODES,
        "returns": np.asarray(found.returns).tolist(),
        "rows": rows,
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks.first_order {task}:{algorithm} "
        f"--seeds {seed}",
    }


class Clocks:
    """Wall-clock and processor time that can be stopped."""

    def __init__(self) -> None:
        """Begins."""
        self.passed = np.zeros(2)
        self.go()

    def go(self) -> None:
        """Goes on."""
        self.began = self._now()

    def stop(self) -> None:
        """Stops."""
        self.passed = self.passed + self._now() - self.began

    def read(self) -> tuple[float, float]:
        """Seconds of both while they go."""
        wall, cpu = self.passed + self._now() - self.began
        return float(wall), float(cpu)

    @staticmethod
    def _now() -> np.ndarray:
        return np.array([time.perf_counter(), time.process_time()])


def main() -> int:
    """Trains and writes."""
    jaxrod.configure_cpu(1)
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    cells = [f"{task}:{name}" for task, known in STEPS.items() for name in known]
    parser.add_argument("cells", nargs="*", metavar="TASK:ALGORITHM")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--pages", action="store_true")
    asked = parser.parse_args()
    unknown = set(asked.cells) - set(cells)
    if unknown:
        parser.error(f"cells are {', '.join(cells)}; got {', '.join(sorted(unknown))}")
    RECORDS.mkdir(exist_ok=True)
    for seed in asked.seeds:
        for cell in () if asked.pages else asked.cells or cells:
            task, name = cell.split(":")
            record = trained(task, name, seed, STEPS[task][name])
            file = RECORDS / f"{task}-{name}-{seed}.json"
            write_atomically(file, (json.dumps(record, indent=1) + "\n").encode())
            jax.clear_caches()
            gc.collect()
    write_pages()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
