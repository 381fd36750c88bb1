"""Measures how far the four tasks of the arm can be brought, and by whom.

    python -m benchmarks.optimum [tracking reaching structured unstructured]

For each task (variant "clean"), or those named, on the same episodes: the ceiling by
construction, what model-predictive control earns and takes, and what random actions
earn. Writes a record for each into benchmarks/optimum, then docs/optimum.md and its
picture from all records there are, with those of the learners beside them. In float32
on one core. `--pages` measures nothing and writes the pages from the records.

The ceiling of an episode is its reward with the tip in the best place there is: on the
target, or as near as the arm's length from its base allows. In "reaching" the
orientation is the goal's. It is not known to be within reach: it leaves out the way
there, that the base is clamped, and how strong the muscles are; and that an arm can be
stretched, which adds to its length.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxrod
from jaxrod.control import mpc
from jaxrod.envs import VectorEnvironment, make
from jaxrod.envs.arm.arm_task import distance_reward
from jaxrod.envs.tasks.reaching import reaching_reward
from jaxrod.files import write_atomically
from jaxrod.installation.machine import processor_and_versions
from jaxrod.structure import pytree, static
from jaxrod.training import evaluate

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "benchmarks" / "optimum"
SEED = 1
"""Of the episodes: those of `jaxrod evaluate`."""
CASES = {"tracking": 1, "reaching": 2, "structured": 3, "unstructured": 4}
EPISODES = {"tracking": 32, "reaching": 32, "structured": 4, "unstructured": 4}
"""Nothing is random in the last two: all episodes are the same."""
PLANS: dict[str, dict[str, Any]] = {
    "tracking": {},
    "reaching": {},
    "structured": {},
    "unstructured": {},
}
"""Settings of the planner that are not its defaults."""
TIMED_PLANS = 10


@dataclasses.dataclass(frozen=True)
class Bound:
    """A task whose reward is the most there is, whatever the arm does."""

    env: Any
    """The task."""

    def __getattr__(self, name: str) -> Any:
        """All else is the task's."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.env, name)

    def step(self, key: Any, state: Any, action: Array, params: Any) -> Any:
        """The task's step, with another reward."""
        observation, state, _, *rest = self.env.step(key, state, action, params)
        return observation, state, most(state, params), *rest


def most(state: Any, params: Any) -> Array:
    """Reward of a control step with the tip in the best place; see the module."""
    base = params.arm.rest.positions[:, 0]
    far = jnp.sqrt(jnp.sum((state.target.position - base) ** 2))
    squared = jnp.maximum(far - params.arm.rod.length, 0) ** 2
    if hasattr(params, "aligned"):
        return reaching_reward(squared, jnp.zeros_like(squared), params)
    return distance_reward(squared, params.bonus)


@pytree
class Random:
    """Actions drawn anew and evenly from [-1, 1] at every decision."""

    key: Array
    size: int = static()
    action_repeat: int = static()

    def init(self, observation: Array, state: Any) -> Array:
        """Decisions so far."""
        return jnp.zeros((), jnp.int32)

    def act(self, memory: Array, observation: Array, state: Any) -> tuple[Array, Array]:
        """The next draw."""
        key = jax.random.fold_in(self.key, memory)
        shape = (observation.shape[0], self.size)
        return jax.random.uniform(key, shape, minval=-1.0), memory + 1


def measured(task: str) -> dict[str, Any]:
    """The record of a task."""
    env, episodes = make(task, variant="clean"), EPISODES[task]
    policy = mpc(env, **PLANS[task])
    # Randomness of a control step depends on how long actions are held: one for all.
    held = policy.action_repeat
    random = Random(jax.random.key(SEED), env.action_size, held)
    wall = time.perf_counter()
    found = evaluate(env, policy, episodes=episodes, seed=SEED)
    wall = time.perf_counter() - wall
    bound = evaluate(Bound(env), random, episodes=episodes, seed=SEED)
    chance = evaluate(env, random, episodes=episodes, seed=SEED)
    if bound.flagged.any():
        raise RuntimeError(f"an arm under random actions was flagged in {task}")
    many, compiling = timed(policy, env, episodes)
    return {
        "task": task,
        "case": CASES[task],
        "seed": SEED,
        "episodes": episodes,
        "settings": {
            name: getattr(policy, name)
            for name in (
                "method",
                "horizon",
                "knots",
                "iterations",
                "replan",
                "first",
                "starts",
            )
        }
        | {"hold": held}
        | {name: float(getattr(policy, name)) for name in ("effort", "smoothness")},
        "period_ms": 1e3 * policy.replan * env.control_period,
        "plan_ms": many,
        "single_plan_ms": timed(policy, env, 1)[0],
        "compile_s": compiling,
        "evaluation_wall_s": wall,
        "ceiling": bound.returns.tolist(),
        "mpc": found.returns.tolist(),
        "mpc_flagged": int(found.flagged.sum()),
        "random": chance.returns.tolist(),
        "machine": processor_and_versions(),
        "command": f"python -m benchmarks.optimum {task}",
    }


def timed(policy: Any, env: Any, episodes: int) -> tuple[float, float]:
    """Processor time of a plan for one arm of a batch [ms], and of compiling [s]."""
    state = VectorEnvironment(env).reset(
        jax.random.key(SEED), episodes, env.default_params()
    )
    memory = policy.init(state.observation, state.states)
    # As in mid-course: an episode's first plan is made with more iterations.
    memory = dataclasses.replace(memory, calls=memory.calls + 1)
    begun = time.process_time()
    plan = jax.jit(policy.planned).lower(memory, state.states).compile()
    compiling = time.process_time() - begun
    memory = jax.block_until_ready(plan(memory, state.states))
    begun = time.process_time()
    for _ in range(TIMED_PLANS):
        memory = plan(memory, state.states)
    jax.block_until_ready(memory)
    used = time.process_time() - begun
    return 1e3 * used / TIMED_PLANS / episodes, compiling


def learners(case: int) -> list[tuple[str, float, int]]:
    """Recorded learners: name, mean noise-free return, seeds; the best of a variant."""
    found: dict[tuple[str, str], list[float]] = {}
    for folder in ("clean", "paper"):
        for file in sorted((ROOT / "benchmarks" / folder / "cells").glob("*.json")):
            cell = json.loads(file.read_text())
            score = cell.get("evaluation_score")
            if cell["case"] == f"Case{case}" and score is not None:
                key = cell["algorithm"], cell["variant"]
                found.setdefault(key, []).append(score)
    best: dict[str, tuple[str, float, int]] = {}
    for (algorithm, variant), scores in found.items():
        mean = float(np.mean(scores))
        if variant not in best or mean > best[variant][1]:
            best[variant] = (f"{algorithm} ({variant})", mean, len(scores))
    return [best[variant] for variant in ("clean", "paper") if variant in best]


HEADER = """\
# How good is good: what the tasks of the arm can earn

Written by `python -m benchmarks.optimum`; do not edit. For each of the four tasks of the
arm, variant `clean`, on the same episodes (seed {seed} of `evaluate`):

- **ceiling**: the reward with the tip on the target, or as near to it as the arm's
  length from its base allows, and in `reaching` with the goal's orientation. By
  construction, for each episode. It leaves out the way there, the clamp at the base and
  the strength of muscles; nobody is known to reach it. That an arm can be stretched, by
  a few percent when it is swung, is left out as well, so it is no bound to the last
  digit.
- **planned**: `jaxrod.control.mpc`, which plans with the rod itself and does not know
  what is random, untrained;
- **learned**: the policies of the recorded grids without exploration noise, means over
  seeds. They were measured on other episodes; those of the `paper` variant under the
  published physics, too. Their shares are of the mean ceiling here;
- **random**: actions drawn anew every {hold} control steps.

![Shares of the ceiling](../benchmarks/optimum/optimum.png)

| task | episodes | ceiling | planned | share | least share | random | learned |
|---|---:|---:|---:|---:|---:|---:|---|
"""
TIMES = """
## What a plan takes

Processor time of one core, compiling not counted, and compiling on its own. A plan has
to be ready within its period to act in real time; here the simulation waits for it.
Times of a single arm are XLA's and lanes' where the plan itself is a batch (rows of the
Jacobian, samples).

| task | period [ms] | plan, of a batch [ms] | plan, single arm [ms] | compiling [s] |
|---|---:|---:|---:|---:|
"""
SETTINGS = """
## Settings

Control steps of 1.4 ms; see `jaxrod.control.mpc`. Costs are the tasks' own
([planning](planning.md)), not their rewards.

| task | method | horizon | knots | replan | hold | iterations | first | starts | effort | smoothness |
|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|
"""


def pages() -> None:
    """Writes the page and its picture from the records."""
    records = [
        json.loads(file.read_text())
        for task in CASES
        if (file := RECORDS / f"{task}.json").exists()
    ]
    if not records:
        return
    page = HEADER.format(seed=SEED, hold=records[0]["settings"]["hold"])
    times, settings = TIMES, SETTINGS
    for record in records:
        planned, ceiling = np.array(record["mpc"]), np.array(record["ceiling"])
        mean = ceiling.mean()
        known = "; ".join(
            f"{name} {score:,.0f} ({score / mean:.1%}, {seeds} seeds)"
            for name, score, seeds in learners(record["case"])
        )
        flagged = record["mpc_flagged"]
        page += (
            f"| {record['case']} `{record['task']}` | {record['episodes']} "
            f"| {mean:,.0f} | {planned.mean():,.0f}"
            f"{f', {flagged} flagged' if flagged else ''} "
            f"| {planned.mean() / mean:.1%} | {np.min(planned / ceiling):.1%} "
            f"| {np.mean(record['random']):,.0f} | {known} |\n"
        )
        times += (
            f"| {record['case']} `{record['task']}` | {record['period_ms']:.1f} "
            f"| {record['plan_ms']:.1f} | {record['single_plan_ms']:.1f} "
            f"| {record['compile_s']:.0f} |\n"
        )
        s = record["settings"]
        settings += (
            f"| {record['case']} `{record['task']}` | {s['method']} | {s['horizon']} "
            f"| {s['knots']} | {s['replan']} | {s['hold']} | {s['iterations']} "
            f"| {s['first']} | {s['starts']} | {s['effort']:g} | {s['smoothness']:g} |\n"
        )
    machines = sorted({record["machine"] for record in records})
    measured_on = f"\nMeasured on: {'; '.join(machines)}.\n"
    write_atomically(
        ROOT / "docs" / "optimum.md", (page + times + measured_on + settings).encode()
    )
    picture(records)


def picture(records: list[dict[str, Any]]) -> None:
    """Bars of the shares of the ceiling."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    kinds = {
        "random": ("0.75", lambda r: np.mean(r["random"])),
        "learned (paper)": ("tab:orange", lambda r: _learned(r, "(paper)")),
        "learned (clean)": ("tab:red", lambda r: _learned(r, "(clean)")),
        "planned": ("tab:blue", lambda r: np.mean(r["mpc"])),
    }
    for place, (name, (colour, value)) in enumerate(kinds.items()):
        shares = [100 * value(r) / np.mean(r["ceiling"]) for r in records]
        bars = axes.bar(
            np.arange(len(records)) + 0.2 * (place - 1.5),
            np.maximum(np.nan_to_num(shares), 0),
            0.18,
            color=colour,
            label=name,
        )
        words = ["" if np.isnan(share) else f"{share:.0f}" for share in shares]
        axes.bar_label(bars, words, fontsize=8)
    axes.set_xticks(range(len(records)), [r["task"] for r in records])
    axes.set_ylabel("share of the ceiling [%]")
    axes.set_ylim(0, 112)
    axes.axhline(100, color="black", linewidth=0.8)
    axes.legend(ncols=4, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    figure.savefig(RECORDS / "optimum.png", dpi=120, metadata={"Software": None})


def _learned(record: dict[str, Any], variant: str) -> float:
    scores = [s for name, s, _ in learners(record["case"]) if variant in name]
    return scores[0] if scores else float("nan")


def main(arguments: list[str]) -> int:
    """Measures and writes."""
    jaxrod.configure_cpu(1)
    names = [a for a in arguments if a != "--pages"]
    unknown = set(names) - set(CASES)
    if unknown:
        raise SystemExit(f"tasks are {', '.join(CASES)}; got {', '.join(unknown)}")
    if "--pages" not in arguments:
        RECORDS.mkdir(exist_ok=True)
        for task in names or CASES:
            record = measured(task)
            write_atomically(
                RECORDS / f"{task}.json", (json.dumps(record, indent=1) + "\n").encode()
            )
            print(
                f"{task}: planned {np.mean(record['mpc']):,.0f} of "
                f"{np.mean(record['ceiling']):,.0f}, random "
                f"{np.mean(record['random']):,.0f}; {record['plan_ms']:.1f} ms of "
                f"{record['period_ms']:.1f} ms, single {record['single_plan_ms']:.1f} ms;"
                f" compiling {record['compile_s']:.0f} s",
                flush=True,
            )
    pages()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
