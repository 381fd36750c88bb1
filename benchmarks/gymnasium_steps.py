"""Control steps per second of one environment behind Gymnasium.

    python benchmarks/gymnasium_steps.py [jaxrod/tracking-clean-v0 ...]

Each id made by `gymnasium.make`, with Gymnasium's usual wrappers, under random actions,
on one core and with `configure_cpu(1)`. Ids of other packages are `module:id`. Best and
median of many short bursts: other work on the machine is no property of an environment.
Compiling is not counted.
"""

from __future__ import annotations

import importlib
import os
import statistics
import sys
import time

import jaxrod
from jaxrod.installation.machine import processor_and_versions

BURST = 20
BURSTS = 400
SECONDS = 30.0
"""Bursts end after so long."""


def measured(name: str) -> tuple[float, float]:
    """Best and median control steps per second."""
    import gymnasium

    importlib.import_module("jaxrod.envs.gym")  # registers the ids

    env = gymnasium.make(name)
    env.action_space.seed(0)
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(BURST)]
    speeds: list[float] = []
    end = time.perf_counter() + SECONDS
    while len(speeds) < BURSTS and (len(speeds) < 2 or time.perf_counter() < end):
        start = time.perf_counter()
        ended = False
        for action in actions:
            ended = any(env.step(action)[2:4])
            if ended:
                break
        else:
            speeds.append(BURST / (time.perf_counter() - start))
        if ended:
            env.reset()
    del speeds[0]
    return max(speeds), statistics.median(speeds)


def main(names: list[str]) -> int:
    """Measures and prints."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    jaxrod.configure_cpu(1)
    print(processor_and_versions(), f"; load {os.getloadavg()[0]:.1f}", sep="")
    for name in names or ["jaxrod/tracking-clean-v0"]:
        best, median = measured(name)
        print(f"{name}: best {best:,.0f}, median {median:,.0f} control steps/s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
