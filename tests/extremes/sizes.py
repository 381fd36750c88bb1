"""Rods of 2 to 2,000 elements and of radii from 1 nm to 1 km.

    PYTHONPATH=tests python tests/extremes/sizes.py

A rod of another size, of the same material, under gravity that goes with one over its
size, on ground, damped in its own time, is the same rod in other units of length and
time: whatever it does is the same to rounding. So it is run at every radius, in every
method, in both precisions, and compared with the rod of 1 cm. `stable_dt`,
`equilibrium`, energies and `health` are compared too.

Then free rods of 2 to 2,000 elements are thrown: momentum and energy stay what they
are.

Exits with 1 and lists what differs.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod

RADII = 10.0 ** np.arange(-9, 4)
COUNTS = (2, 3, 10, 100, 500, 1000, 2000)
USUAL = 1e-2
STEPS = 300
ALLOWED = {"float32": 3e-3, "float64": 1e-9}
"""Share of the rod's length; disturbances of rounding grow in contact."""
METHODS: dict[str, Callable[[], Any]] = {
    "consistent": jaxrod.consistent,
    "pyelastica": jaxrod.pyelastica,
    "planar": lambda: jaxrod.planar("xy"),
    "torsion free": jaxrod.torsion_free,
    "implicit": jaxrod.implicit,
}


def arm(radius: float, method: str, dtype: Any) -> tuple[Any, Any]:
    """A clamped rod above ground, and its state."""
    length = 30 * radius
    rod, state = jaxrod.straight_rod(
        12,
        length=length,
        radius=radius,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 1.0, 0.0),
        dtype=dtype,
    )
    # Speed of sound is 32 m/s at every size.
    ground = jaxrod.shapes.plane((0.0, -3 * radius, 0.0), (0.0, 1.0, 0.0))
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity((0.0, -0.02 / radius, 0.0)),
        jaxrod.exponential_damping(0.05 / radius, 0.05 / radius),
        jaxrod.contact(ground, stiffness=1e4, damping=20.0 * radius),
        method=METHODS[method](),
    )
    return scene, state


def in_own_units(radius: float, method: str, dtype: Any) -> dict[str, Any]:
    """Results, in units of the radius and of the time of sound across it."""
    scene, state = arm(radius, method, dtype)
    found = {}
    limit = jaxrod.stable_dt(scene, 0.5).dt
    found["stable_dt"] = np.asarray(limit) / radius
    dt = limit * (10.0 if method == "implicit" else 1.0)
    after = jaxrod.advance(scene, state, dt, STEPS)
    found["positions"] = np.asarray(after.positions) / radius
    found["energy"] = np.asarray(scene.potential_energy(after)) / radius**3
    found["health"] = np.asarray(jaxrod.health(scene, after, dt).flagged)
    if method == "consistent":
        still = jaxrod.equilibrium(scene, state)
        found["equilibrium"] = np.asarray(still.state.positions) / radius
        found["converged"] = np.asarray(still.converged)
    return found


def apart(one: Any, other: Any) -> float:
    """Largest difference over the size of what it is of."""
    size = max(float(np.max(np.abs(other))), 1e-300)
    distance = np.asarray(one, float) - np.asarray(other, float)
    return float(np.max(np.abs(distance))) / size


def compare_sizes() -> tuple[int, list[str]]:
    """Rods of all radii beside that of 1 cm."""
    tried, wrong = 0, []
    for name, allowed in ALLOWED.items():
        dtype = jnp.dtype(name)
        for method in METHODS:
            usual = in_own_units(USUAL, method, dtype)
            worst = 0.0
            for radius in RADII:
                tried += 1
                try:
                    found = in_own_units(float(radius), method, dtype)
                except ValueError as refused:
                    # Inertias of the smallest rods are not numbers of single precision.
                    if "float64 holds more" not in str(refused):
                        wrong.append(
                            f"{method}, {name}, radius {radius:g} m: {refused}"
                        )
                    continue
                for what, values in found.items():
                    off = apart(values, usual[what])
                    worst = max(worst, off)
                    if not off <= allowed:
                        wrong.append(
                            f"{method}, {name}, radius {radius:g} m: {what} {off:.1e}"
                        )
            print(f"{method}, {name}: at most {worst:.1e}", flush=True)
    return tried, wrong


def compare_counts() -> tuple[int, list[str]]:
    """Free rods of many elements: what they keep."""
    tried, wrong = 0, []
    for name, allowed in (("float32", 1e-3), ("float64", 1e-6)):
        for n in COUNTS:
            for method in ("consistent", "planar", "torsion free"):
                tried += 1
                rod, state = jaxrod.straight_rod(
                    n,
                    length=1.0,
                    radius=0.01,
                    density=1000.0,
                    youngs_modulus=1e6,
                    dtype=jnp.dtype(name),
                )
                plane = {"planar": lambda: jaxrod.planar("zx")}
                scene = jaxrod.make_scene(
                    rod, method=(plane | METHODS | plane)[method]()
                )
                wave = np.sin(np.pi * np.linspace(0, 1, n + 1))
                speeds = np.stack([wave, 0 * wave, 0 * wave])
                start = replace(state, velocities=jnp.asarray(speeds, name))
                dt = jaxrod.stable_dt(scene, 0.5).dt
                after = jaxrod.advance(scene, start, dt, 2000)
                before, now = (np.asarray(rod.momentum(s)) for s in (start, after))
                whole = [
                    float(rod.kinetic_energy(s) + scene.potential_energy(s))
                    for s in (start, after)
                ]
                off = {
                    "momentum": apart(now, before),
                    "energy": abs(whole[1] / whole[0] - 1) / 50,
                }
                bad = [f"{k} {v:.1e}" for k, v in off.items() if not v <= allowed]
                print(f"n = {n}, {method}, {name}: {off}", flush=True)
                wrong += [f"n = {n}, {method}, {name}: {b}" for b in bad]
    return tried, wrong


def main() -> int:
    """Tries all, prints what differs, and counts."""
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    failed = 0
    for what, compare in (("radii", compare_sizes), ("counts", compare_counts)):
        tried, wrong = compare()
        print(*(f"    DIFFERS {w}" for w in wrong), sep="\n")
        print(f"{what}: {tried} tried, {len(wrong)} differ", flush=True)
        failed += len(wrong)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
