"""Steps of exactly the stable step, of the measured limit, and of 1 % more.

    PYTHONPATH=tests python tests/extremes/limits.py

Random rods at rest, of every method, support and section, with losses of all kinds, are
disturbed by 1e-9 of their length and run for 4,000 steps: at `stable_dt` of safety one,
and at 0.999 and 1.01 of the true limit, which is found from the eigenvalues of a step.
The first two have to stay where they are, the last has to grow. A bound above the
limit, or of less than half of it, fails.

Exits with 1 and lists what fails.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes.pair_cases import limit, run
from extremes.pair_kinds import METHODS, SECTIONS, SUPPORTS, Kind
from extremes.pair_scenes import scene_in
from extremes.views import View
from physics.step_map import measured_limit

HOLDING = tuple(name for name in SUPPORTS if name != "driven")
ALONE = {"internal damping", "short waves"}
"""Damping that is solved by itself, which the bound does not count."""
LOSSES = ("nothing", "exponential damping", "stokes", "internal damping", "short waves")
STEPS = 4000
NOISE = 1e-9
STAYS, GROWS = 1e-6, 1e-4
"""Shares of the length within which a disturbance stays, beyond which it has grown."""


def drawn(seed: int) -> Kind:
    """A random kind of scene without loads."""
    random = np.random.default_rng(seed)
    methods = [m for m in dict.fromkeys(METHODS) if m != "implicit"]
    method = str(random.choice(methods))
    loss = str(random.choice(LOSSES))
    round_ones = method == "torsion free"
    return Kind(
        method,
        str(random.choice(HOLDING[: 4 if round_ones else 6])),
        () if loss == "nothing" else (loss,),
        int(random.integers(3, 9)),
        bool(random.random() < 0.5) or round_ones,
        str(random.choice(SECTIONS[: 3 if round_ones else 5])),
        "none",
        schedules=False,
    )


def excursion(scene: Any, state: Any, dt: float, flat: bool) -> float:
    """Distance of a disturbed rod from its place, over its length."""
    length = float(scene.rod.length)
    noise = NOISE * length * np.random.default_rng(0).normal(size=state.positions.shape)
    if flat:
        noise[2] = 0.0
    begun = replace(state, positions=state.positions + noise)
    begun = jaxrod.with_memory(scene, begun)
    after = run(scene, begun, dt, jnp.asarray(STEPS), jnp.asarray(0))
    apart = np.abs(np.asarray(after.positions) - np.asarray(state.positions))
    # A free rod drifts with its disturbance.
    apart = apart - apart.mean(axis=1, keepdims=True)
    far = float(np.max(np.abs(apart))) / length
    return far if np.isfinite(far) else np.inf


def examined(seed: int) -> tuple[Kind, list[str], float]:
    """A random scene: its kind, what fails, and the bound over the limit."""
    kind = drawn(seed)
    scene, state = scene_in(View(), kind, seed)
    still = jnp.zeros_like(state.velocities)
    state = replace(state, velocities=still, angular_momenta=state.angular_momenta * 0)
    bound = float(limit(scene))
    true = measured_limit(scene, state, bound)
    failed = []
    if not np.isfinite(true):
        return kind, failed, 0.0
    least = 0.0 if ALONE & set(kind.effects) else 0.5
    if not least < bound / true < 1 + 2e-3:
        failed.append(f"the bound is {bound / true:.3f} of the limit")
    for share, dt in (("the bound", bound), ("0.999 of the limit", 0.999 * true)):
        far = excursion(scene, state, dt, kind.flat)
        if not far < STAYS:
            failed.append(f"grows at {share}: {far:.1e}")
    far = excursion(scene, state, 1.01 * true, kind.flat)
    if not far > GROWS:
        failed.append(f"stays at 1.01 of the limit: {far:.1e}")
    return kind, failed, bound / true


def main() -> int:
    """Draws scenes, prints each, and counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    tried = wrong = refused = 0
    shares = []
    for seed in range(options.seed + 1, options.seed + options.scenes + 1):
        try:
            kind, failed, share = examined(seed)
        except ValueError as why:
            refused += 1
            print(f"{seed}: refused: {' '.join(str(why).split())[:120]}", flush=True)
            continue
        tried += 1
        wrong += bool(failed)
        shares += [share] if share else []
        print(
            f"{seed}: {share:.3f} {kind}",
            *(f"\n    FAILS {f}" for f in failed),
            flush=True,
        )
        if tried % 20 == 0:
            jax.clear_caches()
    print(
        f"{tried} tried, {wrong} failed, {refused} not made; the bound is "
        f"{min(shares):.3f} to {max(shares):.3f} of the limit"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
