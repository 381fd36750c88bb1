"""Time of systems with planar members, divided by that with members in space.

Runs each scene with `consistent()` and with `planar("zx")` in turn, in float32 on one
core, and compares medians of processor times. It runs them within `jax.jit`, which
omits the checks of the state in a plain call. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import jax
import jax.numpy as jnp

import jaxrod
from benchmarks.planar_systems.scenes import SCENES
from jaxrod.installation.machine import processor_and_versions

METHODS = {"space": jaxrod.consistent(), "plane": jaxrod.planar("zx")}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the length of a window and their number."""
    parser.add_argument("--steps", type=int, default=2000, help="of one window")
    parser.add_argument("--windows", type=int, default=9, help="of each kind")


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    jaxrod.configure_cpu(1)
    found = {name: measured(name, args.steps, args.windows) for name in SCENES}
    print(json.dumps({"machine": processor_and_versions(), "scenes": found}, indent=2))
    return 0


def measured(name: str, steps: int, windows: int) -> dict[str, float]:
    """Processor time of a scene, planar over spatial, and of a step in space."""
    made = {kind: SCENES[name](m, dtype=jnp.float32) for kind, m in METHODS.items()}
    advance = jax.jit(lambda system, state: jaxrod.advance(system, state, 5e-5, steps))
    times: dict[str, list[float]] = {kind: [] for kind in made}
    # The first window compiles. Kinds alternate, so that both see the same load.
    for window in range(windows + 1):
        for kind, (system, state) in made.items():
            begun = time.process_time()
            jax.block_until_ready(advance(system, state))
            if window > 0:
                times[kind].append(time.process_time() - begun)
    medians = {kind: statistics.median(own) for kind, own in times.items()}
    return {
        "time": medians["plane"] / medians["space"],
        "microseconds of a step in space": 1e6 * medians["space"] / steps,
    }
