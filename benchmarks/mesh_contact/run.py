"""Contact with a mesh of 10,000 triangles, compared with five spheres.

Prints the time to compute distances from the mesh on a grid of 64 points along its
longest axis, their errors, and the time of a step of a rod with 20 elements in float32:
without contact, with five spheres, and with the mesh.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.shared.clocks import pin_to_one_core
from jaxrod.installation.machine import processor_and_versions

RADIUS, THICKNESS = 0.4, 0.15
TIME_STEP = 1e-5


def ring(along: int = 100, around: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a ring about the z axis."""
    a = 2 * np.pi * np.arange(along)[:, None] / along
    b = 2 * np.pi * np.arange(around) / around
    out = RADIUS + THICKNESS * np.cos(b)
    corners = [out * np.cos(a), out * np.sin(a), THICKNESS * np.sin(b) + 0 * a]
    i, j = np.divmod(np.arange(along * around), around)
    at = lambda p, q: (i + p) % along * around + (j + q) % around
    one = np.stack([at(0, 0), at(1, 0), at(1, 1)], axis=-1)
    two = np.stack([at(0, 0), at(1, 1), at(0, 1)], axis=-1)
    return np.stack(corners, axis=-1).reshape(-1, 3), np.concatenate([one, two])


def errors(body: jaxrod.shapes.Body) -> tuple[float, float]:
    """Largest errors of distance over size, and of the normal, near the smooth ring."""
    draw = np.random.default_rng(0)
    a, b = draw.uniform(0, 2 * np.pi, (2, 2000))
    apart = draw.uniform(-0.5 * THICKNESS, 0.05, 2000)
    normal = np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
    middle = RADIUS * np.stack([np.cos(a), np.sin(a), 0 * a])
    points = middle + (THICKNESS + apart) * normal
    distance, slope = body.surface(tuple(jnp.asarray(points, jnp.float32)))
    off = np.abs(np.asarray(distance) - apart).max() / (2 * (RADIUS + THICKNESS))
    tilt = np.linalg.norm(np.asarray(slope) - normal, axis=0).max()
    return float(off), float(tilt)


def scene(bodies: Any) -> tuple[jaxrod.Scene, jaxrod.RodState]:
    """A rod that lies on bodies with tops at a height of 0.15 m; `None` for none."""
    rod, state = jaxrod.straight_rod(
        20,
        length=1.0,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e6,
        start=(-0.5, RADIUS, THICKNESS + 0.02),
        direction=(1.0, 0.0, 0.0),
    )
    effects = [jaxrod.gravity(), jaxrod.exponential_damping(1.0)]
    if bodies is not None:
        effects.append(jaxrod.contact(bodies, stiffness=1e4, damping=1.0))
    return jaxrod.make_scene(rod, *effects), state


def step_time(bodies: Any, batch: int) -> float:
    """Processor time of a step of one rod, alone or in a batch: least of seven [us]."""
    model, state = scene(bodies)
    steps = 20_000 if batch == 1 else 100

    def one(speed: jax.Array) -> jaxrod.RodState:
        thrown = replace(state, velocities=state.velocities + speed)
        return jaxrod.advance(model, thrown, TIME_STEP, steps)

    speeds = 1e-3 * jnp.arange(batch, dtype=jnp.float32)
    run = jax.jit(jax.vmap(one) if batch > 1 else one)
    given = speeds if batch > 1 else speeds[0]
    jax.block_until_ready(run(given))
    least = np.inf
    for _ in range(7):
        start = time.process_time()
        jax.block_until_ready(run(given))
        least = min(least, time.process_time() - start)
    return 1e6 * least / (steps * batch)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds nothing: the benchmark has no arguments."""


def run(options: argparse.Namespace) -> int:
    """Measures and prints everything."""
    pin_to_one_core()
    jaxrod.configure_cpu()
    print(processor_and_versions())
    spacing = 2 * (RADIUS + THICKNESS + 0.05) / 63
    start = time.process_time()
    body = jaxrod.shapes.from_mesh(*ring(), spacing=spacing, margin=0.05)
    spent = time.process_time() - start
    points = " x ".join(str(n - 2) for n in body.coefficients.shape)
    print(f"from_mesh: {len(ring()[1]):,} triangles, {points} points, {spent:.1f} s")
    off, tilt = errors(body)
    print(f"errors: distance {100 * off:.3f} % of the size, normal {tilt:.3f}")
    places = [(x, RADIUS, 0.0) for x in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    spheres = [jaxrod.shapes.sphere(place, THICKNESS) for place in places]
    for batch in (1, 256):
        bare, five, mesh = (step_time(b, batch) for b in (None, spheres, body))
        print(
            f"{batch} rods: {bare:.2f} us without contact, {five:.2f} us with five "
            f"spheres, {mesh:.2f} us with the mesh; contact with the mesh costs "
            f"{(mesh - bare) / (five - bare):.2f} times that with five spheres"
        )
    return 0
