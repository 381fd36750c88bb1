"""Control steps per second of an environment behind Gymnasium, in many short bursts.

    PYTHON benchmarks/gymnasium_steps/bursts.py ID SECONDS

PYTHON may be one that has no jaxrod. Prints what `bursts` returns as JSON.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any

OURS = "jaxrod/tracking-clean-v0"
THEIRS = "SoftArmTracking-v0"
REGISTERS = {OURS.partition("/")[0]: "jaxrod.envs.gym", THEIRS: "gym_softrobot"}
"""Modules that register ids when they are imported."""

BURST = 20
BURSTS = 400


def bursts(name: str, seconds: float) -> dict[str, Any]:
    """Control steps per second of many bursts, and what a control step consists of."""
    import gymnasium

    if registers := REGISTERS.get(name.partition("/")[0]):
        importlib.import_module(registers)
    env = gymnasium.make(name)
    env.action_space.seed(0)
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(BURST)]
    if any(env.step(actions[0])[2:4]):  # compiles
        env.reset()
    speeds: list[float] = []
    busy = 0.0
    end = time.perf_counter() + seconds
    while len(speeds) < BURSTS and (len(speeds) < 2 or time.perf_counter() < end):
        start, began = time.perf_counter(), time.process_time()
        ended = False
        for action in actions:
            ended = any(env.step(action)[2:4])
            if ended:
                break
        else:
            speeds.append(BURST / (time.perf_counter() - start))
            busy += time.process_time() - began
        if ended:
            env.reset()
    return {"speeds": speeds, "busy": busy, **_content(env.unwrapped)}


def _content(env: Any) -> dict[str, Any]:
    """Elements, steps of the simulation in a control step, and its duration [s]."""
    if hasattr(env, "num_steps_per_update"):  # gym-softrobot's
        steps, seconds = env.num_steps_per_update, env.rl_update_interval
        return {"elements": env.n_elem, "steps": int(steps), "seconds": seconds}
    task = getattr(getattr(env, "_batch", None), "env", None)
    found = {"steps": "substeps", "elements": "n_elements", "seconds": "control_period"}
    return {name: getattr(task, fact, None) for name, fact in found.items()}


if __name__ == "__main__":
    del sys.path[0]  # this folder, whose names are not for others
    print("\n" + json.dumps(bursts(sys.argv[1], float(sys.argv[2]))))
