"""Control steps per second of one environment behind Gymnasium.

    python benchmarks/gymnasium_steps.py [jaxrod/tracking-clean-v0 ...]
    python benchmarks/gymnasium_steps.py --softrobot PYTHON

Each id made by `gymnasium.make`, with Gymnasium's usual wrappers, under random actions,
on one core and with `configure_cpu(1)`. Ids of other packages are `module:id`. Best and
median of many short bursts: other work on the machine is no property of an environment.
Compiling is not counted. A burst that is longer than the system's slices of time is
interrupted where the machine is busy; the steps in a second of processor time are not.

`--softrobot` names a Python that has gym-softrobot, of an environment of its own, say
(`python -m venv x; x/bin/pip install gym-softrobot`). Its `SoftArmTracking-v0`,
PyElastica's arm in much the same task, is measured by the same function on the same
core: half of the time before ours, half behind. The two differ in what a control step
is, so steps of the rod and seconds of its motion stand beside.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

OURS = "jaxrod/tracking-clean-v0"
THEIRS = "SoftArmTracking-v0"
REGISTERS = {OURS.partition("/")[0]: "jaxrod.envs.gym", THEIRS: "gym_softrobot"}
"""Modules that register ids when they are imported."""

BURST = 20
BURSTS = 400
SECONDS = 30.0
"""Bursts end after so long."""


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


def in_other_python(python: str, seconds: float) -> dict[str, Any]:
    """The bursts of gym-softrobot's arm, in a process of another Python.

    Raises:
        ValueError: it cannot be measured there.
    """
    try:
        done = subprocess.run(
            [python, "-W", "ignore", __file__, "--bursts", THEIRS, str(seconds)],
            capture_output=True,
            text=True,
        )
    except OSError as error:
        raise ValueError(f"--softrobot {python}: {error.strerror}") from None
    if done.returncode or not done.stdout:
        last = done.stderr.strip().rpartition("\n")[2] or "it said nothing"
        raise ValueError(f"--softrobot {python} could not measure {THEIRS}: {last}")
    measured: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return measured


def line(name: str, measured: dict[str, Any]) -> str:
    """What was measured of an id, in words."""
    best, median = max(measured["speeds"]), statistics.median(measured["speeds"])
    busy = BURST * len(measured["speeds"]) / measured["busy"]
    words = (
        f"{name}: best {best:,.0f}, median {median:,.0f} control steps/s, {busy:,.0f} "
        "in a second of processor time"
    )
    steps = measured["steps"]
    if steps:
        words += (
            f"; of {steps} steps of {measured['elements']} elements: "
            f"{busy * steps:,.0f} rod-steps in it"
        )
    if measured["seconds"]:
        words += f", {busy * measured['seconds']:.2f} s of motion"
    return words


def main(words: list[str]) -> int:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("ids", nargs="*", default=[OURS], help=f"by default {OURS}")
    parser.add_argument(
        "--softrobot", metavar="PYTHON", help=f"measure {THEIRS} beside, in this Python"
    )
    args = parser.parse_args(words)
    pin_to_one_core()
    import jaxrod
    from jaxrod.installation.machine import processor_and_versions

    jaxrod.configure_cpu(1)
    print(processor_and_versions(), f"; load {os.getloadavg()[0]:.1f}", sep="")
    theirs: dict[str, Any] = {}
    half = SECONDS / 2
    if args.softrobot:
        python = str(Path(args.softrobot).absolute())
        theirs = in_other_python(python, half)
    for name in args.ids:
        print(line(name, bursts(name, SECONDS)))
    if args.softrobot:
        again = in_other_python(python, half)
        theirs["speeds"] += again["speeds"]
        theirs["busy"] += again["busy"]
        print(line(THEIRS, theirs))
    return 0


def pin_to_one_core() -> None:
    """Keeps this process, and those it starts, on one core where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


if __name__ == "__main__":
    if sys.argv[1:2] == ["--bursts"]:
        # Another Python, which need not have jaxrod.
        del sys.path[0]  # this folder, whose names are not for others
        print("\n" + json.dumps(bursts(sys.argv[2], float(sys.argv[3]))))
        sys.exit(0)
    sys.exit(main(sys.argv[1:]))
