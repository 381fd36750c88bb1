"""Distance of the bellies of our muscles from a slender rod, in the third period.

Prints for long and short muscles the largest angle between an element and its section's
normal, and the least and largest stretch, looked at 40 times.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.muscular_snake import scene

EVERY = 5_000
FROM, TO = 400_000, 600_000
"""Steps."""


def measure_bellies() -> None:
    """Steps ours, and prints a table."""
    jax.config.update("jax_enable_x64", True)
    system, state = scene.ours()
    advance = jax.jit(jaxrod.advance)
    found: dict[str, list[tuple[float, float, float]]] = {g: [] for g in scene.SIZES}
    for step in range(0, TO, EVERY):
        first = jnp.asarray(step)
        state = advance(system, state, scene.STEP, jnp.asarray(EVERY), first=first)
        if step < FROM:
            continue
        for group, rows in found.items():
            own = state[group]
            edges = np.diff(np.asarray(own.positions), axis=-1)
            edges = edges[..., scene.FIRST : scene.LAST]
            lengths = np.linalg.norm(edges, axis=1)
            normals = np.asarray(own.directors)[:, 2, :, scene.FIRST : scene.LAST]
            lean = np.arccos(np.sum(edges * normals, axis=1) / lengths)
            stretch = lengths / scene.ELEMENT
            rows.append((np.max(lean), np.min(stretch), np.max(stretch)))
    print("| muscles | leaning, at most [deg] | stretch, least | largest |")
    print("|---|---:|---:|---:|")
    for group, rows in found.items():
        lean, least, most = np.array(rows).T
        print(
            f"| {group} | {np.degrees(np.max(lean)):.0f} | {np.min(least):.4f} | "
            f"{np.max(most):.2f} |"
        )
