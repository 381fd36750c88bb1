"""PyElastica's solenoid between guides: a rod that is pulled and turned 13 times.

Prints twist, writhe and link, the largest angle of a joint, and which elements have
passed through each other since the last moment that was looked at, from two turns
before the rod buckles on.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.plectoneme.guided import (
    BENDING,
    LENGTH,
    RADIUS,
    TORSION,
    guided,
    topology,
)

N, GUIDED = 50, 4
A_TURN, PULLING, LOOKED = 2.0, 1.0, 0.05
"""For a turn, until it is pulled, between looks [s]."""


def pull(force: float = 300.0, turns: float = 13.0, contact: float = 1e7) -> None:
    """Steps and prints rows where something passes, and every quarter of a turn.

    Args:
        force: Pull along the rod [N].
        turns: Turns of the end.
        contact: Stiffness of contact [N/m^2].
    """
    jax.config.update("jax_enable_x64", True)
    made = guided(
        N,
        GUIDED,
        jaxrod.schedules.ramp(0.0, 2 * np.pi * turns, turns * A_TURN, start=PULLING),
        pull=jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, force, 0.0), PULLING),
        stiffness=contact,
        dashpot=2250.0,
        damping=(20.0, 12800.0),
        across=0.01,
    )
    system, state = made.system, made.state
    radii = system.members["rod"].rod.radii
    dt = float(jaxrod.stable_dt(system, 0.9).dt)
    buckles = 2 * np.sqrt(BENDING * force) / TORSION * made.whole / (2 * np.pi)
    tight = 2 * RADIUS * np.sqrt(force / BENDING)
    print(
        f"2 sqrt(B F) at {buckles:.2f} turns; a loop's curvature over 1/r: {tight:.2f}"
    )
    advance, passed = jax.jit(jaxrod.advance), jax.jit(jaxrod.topology.crossings)
    each = max(1, int(LOOKED / dt))
    first = int((PULLING + (buckles - 2) * A_TURN) / dt)
    step = jnp.asarray(first)
    state = advance(system, state, dt, step, first=jnp.asarray(0))
    print("| turned | twist | writhe | link | largest angle [rad] | passed |")
    print("|---|---|---|---|---|---|")
    rows = round(A_TURN / 4 / LOOKED)
    for row in range(int((turns * A_TURN + PULLING) / dt - first) // each):
        before = state["rod"].positions
        start = jnp.asarray(first + row * each)
        state = advance(system, state, dt, jnp.asarray(each), first=start)
        own = state["rod"]
        through = np.abs(np.asarray(passed(before, own.positions))) > 0.25
        pairs = [f"{i} {j}" for i, j in zip(*np.nonzero(through), strict=True) if i < j]
        if row % rows and not pairs:
            continue
        edges = np.diff(np.asarray(own.positions), axis=1)
        edges /= np.linalg.norm(edges, axis=0)
        angle = np.arccos(np.clip(np.sum(edges[:, 1:] * edges[:, :-1], axis=0), -1, 1))
        twist, writhe, link = map(float, topology(own, radii))
        time = (first + (row + 1) * each) * dt
        print(
            f"| {min(turns, (time - PULLING) / A_TURN):.2f} | {twist:.3f} | "
            f"{writhe:.3f} | {link:.3f} | {angle.max():.2f} | {', '.join(pairs)} |",
            flush=True,
        )
    print(f"elements are {LENGTH / N / RADIUS:.2g} radii long")
