"""Twist and writhe of a rod that is twisted ten times, here and in PyElastica."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.plectoneme import scene

EVERY = 2.5
"""Between rows [s]."""


def twist(n: int = 50, seconds: float = 50.0, count: float | None = None) -> None:
    """Steps both and prints a table.

    Args:
        n: Elements.
        seconds: Simulated time [s].
        count: Our contact over one pair of PyElastica's per element [1]; by default
            what `pairs_counted` measures of theirs at a penetration of a twentieth.
    """
    jax.config.update("jax_enable_x64", True)
    dt = scene.time_step(n)
    if count is None:
        count = scene.pairs_counted(n, 0.05)
    print(f"{n} elements, steps of {dt:.3g} s, contact of {count:.2f} pairs an element")
    print(
        "| time [s] | ours: twist, writhe | theirs: twist, writhe | link lost there |"
    )
    print("|---|---|---|---|")
    system, state = scene.ours(n, count)
    simulator, rod = scene.theirs(n)
    import elastica as ea

    stepper, time = ea.PositionVerlet(), np.float64(0.0)
    each = round(EVERY / dt)
    advance = jax.jit(jaxrod.advance)
    for row in range(round(seconds / EVERY)):
        first: Any = jnp.asarray(row * each)
        state = advance(system, state, dt, jnp.asarray(each), first=first)
        for _ in range(each):
            time = stepper.step(simulator, time, np.float64(dt))
        own = state["rod"]
        a = scene.shape(own.positions, own.directors[0])
        b = scene.shape(rod.position_collection, rod.director_collection[0])
        turned = scene.TURNS * min(1.0, (row + 1) * EVERY / scene.TWISTING)
        print(
            f"| {(row + 1) * EVERY:g} | {a.twist:.4f}, {a.writhe:.4f} | "
            f"{b.twist:.4f}, {b.writhe:.4f} | {turned - b.twist - b.writhe:.3f} |",
            flush=True,
        )
