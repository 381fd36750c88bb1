"""Peak memory of a process that computes a gradient, beyond what it had before.

Each case runs in a separate process. The numbers are those that Linux keeps of it.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jaxrod

CASES = {
    "one rod, 100,000 steps": (1, 100_000),
    "1,024 rods, 1,000 steps": (1024, 1000),
}
"""Numbers of rods and of steps."""


def measured(rods: int, steps: int, mode: str, elements: int) -> dict[str, Any]:
    """Measures this process: peaks [bytes] of compiling and of two gradients."""
    jaxrod.configure_cpu(1)
    jaxrod.use_lanes(mode)
    rod, state = jaxrod.straight_rod(
        elements,
        length=1.0,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    effects = jaxrod.clamp(state), jaxrod.exponential_damping(1.0)
    scene = jaxrod.make_scene(rod, *effects, jaxrod.gravity((0.0, -9.81, 0.0)))
    dt = 0.5 * jaxrod.stable_dt(scene).dt
    velocities = jnp.zeros((rods, *state.velocities.shape), "float32")

    def loss(factor: Any, velocities: Any) -> Any:
        stiffer = replace(rod, bend_twist_stiffness=factor * rod.bend_twist_stiffness)
        begun = replace(state, velocities=velocities)
        after = jaxrod.advance(replace(scene, rod=stiffer), begun, dt, steps)
        return jnp.sum(after.tip**2)

    gradient = jax.jit(jax.vmap(jax.grad(loss, argnums=(0, 1))))
    given = jnp.ones(rods, "float32"), velocities
    compiled = gradient.lower(*given).compile()
    most_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    # Linux forgets the largest size so far, and notes it again from here.
    Path("/proc/self/clear_refs").write_text("5")
    before = _status("VmRSS")
    for _ in range(2):
        made = jax.block_until_ready(compiled(*given))
    own = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    analysis = compiled.memory_analysis()
    return {
        "finite": bool(all(jnp.all(jnp.isfinite(m)) for m in made)),
        "compiling": most_before,
        "beyond": _status("VmHWM") - before,
        "temporary": 0 if analysis is None else int(analysis.temp_size_in_bytes),
        "state": own,
    }


def _status(name: str) -> int:
    """A size of this process that Linux records [bytes]."""
    text = Path("/proc/self/status").read_text()
    (line,) = (line for line in text.splitlines() if line.startswith(name + ":"))
    return int(line.split()[1]) * 1024


def table(elements: int) -> None:
    """Measures all cases by kernels and by XLA, and prints a table."""
    print(
        f"| gradient, {elements} elements, float32 | by | beyond the process before "
        "[MB] | working memory of the program [MB] | states of each rod | peak of "
        "compiling [MB] |\n|---|---|---:|---:|---:|---:|"
    )
    for name, (rods, steps) in CASES.items():
        for mode, way in (("auto", "kernels"), ("never", "XLA")):
            words = json.dumps([rods, steps, mode, elements])
            done = subprocess.run(
                [sys.executable, "-m", "benchmarks.gradients.memory", words],
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
            found = json.loads(done.stdout.splitlines()[-1])
            assert found["finite"], name
            states = found["temporary"] / (rods * found["state"])
            sizes = (found[k] / 1e6 for k in ("beyond", "temporary", "compiling"))
            beyond, temporary, compiling = (f"{size:.3g}" for size in sizes)
            cells = (name, way, beyond, temporary, f"{states:.0f}", compiling)
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    print(json.dumps(measured(*json.loads(sys.argv[1]))))
