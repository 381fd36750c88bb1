"""Ceilings of the arm's four tasks, and returns of a planner.

Measures each task (variant "clean") with each plan, or those that you name (`PLANS`),
in float32 on one core. All numbers are from the same episodes: the ceiling of the
return, the return and the time of model-predictive control, and the return of random
actions. Writes a record of each into records, then docs/optimum.md and its picture from
all records, including those of the learners. `--pages` measures nothing and writes the
pages from the records.

The ceiling of an episode is its return with the tip in the best position: on the
target, or as near as the arm's length from its base allows. In "reaching" the
orientation is the goal's. The arm may be unable to reach the ceiling, because the
ceiling ignores the way to the target, the clamp at the base and the limited strength of
muscles. It also ignores that an arm can stretch, which adds to its length.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxrod
from benchmarks.optimum.page import CASES, RECORDS, write_pages
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import write_record
from jaxrod.control import mpc
from jaxrod.envs import VectorEnvironment, make
from jaxrod.envs.tasks.arm_task import distance_reward
from jaxrod.envs.tasks.reaching import reaching_reward
from jaxrod.installation.machine import processor_and_versions
from jaxrod.structure import pytree, static
from jaxrod.training import evaluate

SEED = 1
"""Seed of the episodes: that of `jaxrod evaluate`."""
EPISODES = {"tracking": 32, "reaching": 32, "structured": 4, "unstructured": 4}
"""Nothing is random in the last two: all episodes are the same."""
HELD = {
    "shape": "steps",
    "horizon": 32,
    "knots": 1,
    "replan": 16,
    "hold": 16,
    "effort": 1e-2,
    "smoothness": 0.0,
}
"""One action, held: what DAgger's planner does (`jaxrod train --algorithm dagger`)."""
PLANS: dict[str, dict[str, Any]] = {
    "tracking": {},
    "tracking_held": HELD,
    "reaching": {},
    "reaching_held": HELD,
    "structured": {},
    "unstructured": {},
}
"""Settings of the planner that are not its defaults, by the name of the record: a task,
or a task and a word."""
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
    """Uniform random actions from [-1, 1], drawn at every decision."""

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


def measured(name: str) -> dict[str, Any]:
    """The record of a task and a plan for it."""
    task, _, plan = name.partition("_")
    env, episodes = make(task, variant="clean"), EPISODES[task]
    policy = mpc(env, **PLANS[name])
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
        "plan": plan,
        "case": CASES[task],
        "seed": SEED,
        "episodes": episodes,
        "settings": {
            "method": policy.method,
            "shape": policy.cost.shape,
            "horizon": policy.cost.knots * policy.cost.spacing,
            "knots": policy.cost.knots,
            "iterations": policy.iterations,
            "replan": policy.replan,
            "first": policy.first,
            "starts": policy.starts,
            "hold": held,
            "effort": float(policy.cost.effort),
            "smoothness": float(policy.cost.smoothness),
        },
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
        "command": f"python -m benchmarks optimum {name}",
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the plans."""
    add_names(parser, "plans", PLANS, "PLAN")
    parser.add_argument(
        "--pages", action="store_true", help="write the pages from the records"
    )


def run(args: argparse.Namespace) -> int:
    """Measures and writes."""
    jaxrod.configure_cpu(1)
    for name in () if args.pages else args.plans:
        record = measured(name)
        write_record(RECORDS, name, record)
        print(
            f"{name}: planned {np.mean(record['mpc']):,.0f} of "
            f"{np.mean(record['ceiling']):,.0f}, random "
            f"{np.mean(record['random']):,.0f}; {record['plan_ms']:.1f} ms of "
            f"{record['period_ms']:.1f} ms, single "
            f"{record['single_plan_ms']:.1f} ms; compiling "
            f"{record['compile_s']:.0f} s",
            flush=True,
        )
    write_pages(SEED)
    return 0
