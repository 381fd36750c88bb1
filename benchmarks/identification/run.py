"""Identification and inverse design: docs/identification.md.

`dropped` fits a released arm to noisy positions, with 100 draws of the noise, and with
parameters that positions alone do not determine. `forced` adds a force sensor at the
clamp. `buckling` fits four parameters of a rod that buckles, in windows with unknown
initial states. `poses` fits eight poses at rest. `shapes` finds rest curvatures that
give an arm a shape. The default is all. Rows that are not measured do not change.

Runs use float32 on one core. Seconds are processor time, and the first run, which
compiles, is listed separately. The fitted model simulates every observation, and the
benchmark adds noise. This tests the search and its standard deviations, not whether a
model is correct.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.identification.buckling_rows import buckling_rows
from benchmarks.identification.fit_rows import fit_row, noisy, scaled, timed
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import ROOT
from benchmarks.shared.page_tables import measured_table
from jaxrod import control
from jaxrod.control import match_shape
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors
from jaxrod.rods.motion import motion_of

PAGE = ROOT / "docs" / "identification.md"
FITTED = (
    "found | errors | stated standard deviations | iterations | first call [s] "
    "| run [s] |\n|---|---|---|---|---:|---:|---:|"
)
HEADS = {
    "dropped": f"| dropped arm, 60 frames a second | {FITTED}",
    "forced": f"| dropped arm with a force sensor | {FITTED}",
    "buckling": f"| pressed rod | {FITTED}",
    "poses": f"| eight poses at rest | {FITTED}",
    "shapes": (
        "| shapes with ten markers each | within 1 mm and stable "
        "| largest error of these [mm] "
        "| iterations | first call [s] | run [s] |\n|---|---|---|---:|---:|---:|"
    ),
}


# The arm that is let go.

FRAMES, RATE = 60, 60
FILM_SD, FORCE_SD = 2e-3, 1.0
DROPPED = {"youngs_modulus": 1e7, "damping": 2.0, "density": 1000.0}
MOST_STIFF = 4.5e7
"""The modulus up to which the step is stable [Pa]."""


class Drop:
    """A clamped arm, 1 m long and 10 cm thick, released from horizontal: one second."""

    def __init__(self, n: int = 20, frames: int = FRAMES) -> None:
        """Sets the numbers of elements and frames."""
        self.n, self.frames = n, frames
        stiffest = DROPPED | {"youngs_modulus": MOST_STIFF, "density": 500.0}
        stable = float(jaxrod.stable_dt(self.scene(stiffest)[0]).dt)
        self.per = int(np.ceil(1 / RATE / stable))
        self.dt = 1 / RATE / self.per

    def scene(self, p: dict[str, Any]) -> tuple[Any, Any]:
        """The scene for parameters; those not given are the true ones."""
        p = DROPPED | p
        rod, state = jaxrod.straight_rod(
            self.n,
            length=1.0,
            radius=0.05,
            density=p["density"],
            youngs_modulus=p["youngs_modulus"],
            direction=(1.0, 0.0, 0.0),
            normal=(0.0, 0.0, 1.0),
        )
        effects = (
            jaxrod.clamp(state),
            jaxrod.exponential_damping(p["damping"]),
            jaxrod.gravity((0.0, -9.81, 0.0)),
        )
        return jaxrod.make_scene(rod, *effects), state

    def film(self, p: dict[str, Any]) -> dict[str, Any]:
        """Positions of all nodes but the first, frame by frame."""
        return {"film": self._states(p)[1].positions[:, :, 1:]}

    def film_and_force(self, p: dict[str, Any]) -> dict[str, Any]:
        """The same and the force of the clamp."""
        scene, states = self._states(p, compensated=True)
        force = jax.vmap(lambda state: jaxrod.reactions(scene, state)[0].force)(states)
        return {"film": states.positions[:, :, 1:], "force": force}

    def _states(self, p: dict[str, Any], compensated: bool = False) -> Any:
        scene, state = self.scene(p)
        if compensated:
            # Round-off of axial forces, 0.5 N without, is noise that a search sees.
            state = jaxrod.compensated(state)
        steps = self.per * self.frames
        states = jaxrod.rollout(scene, state, self.dt, steps, self.per)
        return scene, jax.tree.map(lambda leaf: leaf[1:], states)


def dropped_rows() -> Iterable[str]:
    """Identification from a film, with and without a force sensor."""
    drop = Drop()
    two = {k: DROPPED[k] for k in ("youngs_modulus", "damping")}
    sd = {"film": FILM_SD}
    clean = jax.jit(drop.film)(two)
    film = noisy(clean, sd, jax.random.key(0))
    upper = {"youngs_modulus": MOST_STIFF}

    def fitter(simulate: Any, sd: Any) -> Any:
        return jax.jit(lambda o, s: control.fit(simulate, o, s, noise=sd, upper=upper))

    fit = fitter(drop.film, sd)
    for words, factors in (
        ("4 times the stiffness, a fourth of the damping", (4, 0.25)),
        ("a fourth of the stiffness, 4 times the damping", (0.25, 4)),
    ):
        start = scaled(two, factors)
        yield fit_row(f"film; start: {words}", two, *timed(fit, film, start))
    draws = jax.vmap(lambda key: noisy(clean, sd, key))(
        jax.random.split(jax.random.key(1), 100)
    )
    start = scaled(two, (4, 0.25))
    many = jax.jit(
        jax.vmap(lambda o: control.fit(drop.film, o, start, noise=sd, upper=upper))
    )
    fits, first, run = timed(many, draws)
    z = {k: np.asarray(v) for k, v in fits.z(two).items()}
    shown = "; ".join(f"{k} {v.mean():+.2f} ± {v.std():.2f}" for k, v in z.items())
    ended = int(np.sum(fits.converged))
    yield (
        f"| 100 draws of the noise, as one batch | {ended} converged | "
        f"z-scores: {shown} | | {int(np.max(fits.iterations))} | {first:.1f} | "
        f"{run:.2f} |"
    )
    start = scaled(DROPPED, (2, 0.5, 0.7))
    yield fit_row(
        "film; density unknown too: not determined",
        DROPPED,
        *timed(fitter(drop.film, sd), film, start),
    )


def forced_rows() -> Iterable[str]:
    """The same with a force sensor, which weighs the arm."""
    drop = Drop()
    sd = {"film": FILM_SD, "force": FORCE_SD}
    clean = jax.jit(drop.film_and_force)(DROPPED)
    both = noisy(clean, sd, jax.random.key(2))
    start = scaled(DROPPED, (2, 0.5, 0.7))
    upper = {"youngs_modulus": MOST_STIFF}
    fit = jax.jit(
        lambda o, s: control.fit(drop.film_and_force, o, s, noise=sd, upper=upper)
    )
    yield fit_row(
        f"film, and force with {FORCE_SD:g} N of noise",
        DROPPED,
        *timed(fit, both, start),
    )


# Poses at rest.

POSES = 8
POSE_SD = 1e-3
MATERIAL = {"youngs_modulus": 315e3, "poisson_ratio": 0.4, "density": 1300.0}
MARKED = 10
"""Elements with a marker on the surface."""


class Poses:
    """A silicone arm of 25 cm, 4 cm thick, held eight ways, with eight loads."""

    def __init__(self, n: int = 20, poses: int = POSES) -> None:
        """Sets the numbers of elements and poses."""
        self.n = n
        random = np.random.default_rng(7)
        gravity = random.normal(size=(poses, 3))
        gravity *= 9.81 / np.linalg.norm(gravity, axis=1, keepdims=True)
        forces = 0.5 * random.normal(size=(poses, 3))
        couples = 0.03 * random.normal(size=(poses, 3))
        # Twist is what shows Poisson's ratio: every other pose has it for sure.
        couples[::2, 2] = 0.06 * np.sign(couples[::2, 2])
        self.loads = tuple(jnp.asarray(a) for a in (gravity, forces, couples))

    def rest(self, p: dict[str, Any], gravity: Any, force: Any, couple: Any) -> Any:
        """The equilibrium of one pose."""
        rod, state = jaxrod.straight_rod(
            self.n, length=0.25, radius=0.02, normal=(1.0, 0.0, 0.0), **p
        )
        scene = jaxrod.make_scene(
            rod,
            jaxrod.clamp(state),
            jaxrod.gravity(gravity),
            jaxrod.end_load(force, couple),
        )
        return jaxrod.equilibrium(scene, state)

    def markers(self, p: dict[str, Any]) -> dict[str, Any]:
        """Markers on the surface, along d1 of every other element."""

        def one(*loads: Any) -> Any:
            found = self.rest(p, *loads)
            motion = motion_of(found.state)
            first = directors(motion.orientation)[0]
            made = []
            for x, d in zip(motion.position, first, strict=True):
                made.append(0.5 * (x[1:] + x[:-1]) + 0.02 * d)
            every = self.n // MARKED
            seen = vectors.join(tuple(made))[:, every - 1 :: every]
            return jnp.where(found.converged, seen, jnp.inf)

        return {"markers": jax.vmap(one)(*self.loads)}


def poses_rows() -> Iterable[str]:
    """Three constants of the material from poses at rest."""
    poses = Poses()
    sd = {"markers": POSE_SD}
    clean = jax.jit(poses.markers)(MATERIAL)
    upper = {"poisson_ratio": 0.5}
    fit = jax.jit(lambda o, s: control.fit(poses.markers, o, s, noise=sd, upper=upper))
    seen = noisy(clean, sd, jax.random.key(3))
    for words, factors in (
        ("3 times the stiffness, ν 0.2, half the density", (3, 0.5, 0.5)),
        ("half the stiffness, ν 0.1, twice the density", (0.5, 0.25, 2)),
    ):
        start = scaled(MATERIAL, factors)
        yield fit_row(f"start: {words}", MATERIAL, *timed(fit, seen, start))


# Shapes.


class Shapes:
    """An arm of 50 cm, 3 cm thick, under its weight, and shapes that it can take."""

    def __init__(self, n: int = 20) -> None:
        """Sets the number of elements."""
        rod, state = jaxrod.straight_rod(
            n,
            length=0.5,
            radius=0.015,
            density=1000.0,
            youngs_modulus=1e7,
            direction=(1.0, 0.0, 0.0),
            normal=(0.0, 0.0, 1.0),
        )
        self.scene = jaxrod.make_scene(
            rod, jaxrod.clamp(state), jaxrod.gravity((0.0, -9.81, 0.0))
        )
        self.state, self.every = state, max(1, n // 10)
        self.nodes = tuple(range(self.every, n + 1, self.every))

    def target(self, key: Any) -> Any:
        """Markers on a smooth curve as long as the arm, bent by up to two radians."""
        n = self.scene.rod.n_elements
        a, b = jax.random.uniform(key, (2, 2), minval=-1.0)
        s = (jnp.arange(n) + 0.5) / n
        tilt = a[0] * s**2 + b[0] * s**3
        turn = a[1] * s**2 + b[1] * s**3
        x, y = jnp.cos(tilt) * jnp.cos(turn), jnp.sin(tilt)
        z = jnp.cos(tilt) * jnp.sin(turn)
        steps = 0.5 / n * jnp.stack([x, y, z])
        return jnp.cumsum(steps, axis=1)[:, self.every - 1 :: self.every]

    def match(self, markers: Any) -> Any:
        """The arm whose equilibrium has these markers."""
        return match_shape(self.scene, self.state, markers, self.nodes)


def shapes_rows() -> Iterable[str]:
    """Inverse design, of one shape and of a thousand.

    In sequence (`lax.map`): under `vmap` every search would last as long as the
    hardest one.
    """
    shapes = Shapes()
    for count in (1, 1000):
        keys = jax.random.split(jax.random.key(4), count)
        targets = jax.vmap(shapes.target)(keys)
        match = jax.jit(lambda t: jax.lax.map(shapes.match, t))
        found, first, run = timed(match, targets)
        done = np.asarray(found.converged)
        yield (
            f"| {count} | {int(done.sum())} | "
            f"{1e3 * float(np.max(found.error, where=done, initial=0)):.2f} | "
            f"{int(np.max(found.iterations))} | {first:.1f} | {run:.2f} |"
        )


TABLES: dict[str, Callable[[], Iterable[str]]] = {
    "dropped": dropped_rows,
    "forced": forced_rows,
    "buckling": buckling_rows,
    "poses": poses_rows,
    "shapes": shapes_rows,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tables."""
    add_names(parser, "tables", HEADS, "TABLE")
    parser.add_argument("--dry", action="store_true", help="write nothing")


def run(args: argparse.Namespace) -> int:
    """Measures, prints and writes."""
    jaxrod.configure_cpu(1)
    for table in args.tables:
        measured_table(PAGE, table, HEADS[table], TABLES[table], dry=args.dry)
    return 0
