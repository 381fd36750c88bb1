"""A rod that is pressed until it buckles: scene, film, and starts of windows.

A straight rod of 0.5 m is clamped at one end; the wall of the other is driven towards
it and back. It buckles to a side that depends on nothing but what is left of an earlier
motion, too small to be seen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxrod
from jaxrod import control
from jaxrod.control import MultipleShooting, least_squares, windows

LENGTH, RADIUS = 0.5, 0.01
MODULUS = 1e6
TRUTH = {
    "bending_stiffness": MODULUS * np.pi * RADIUS**4 / 4,
    "axial_stiffness": MODULUS * np.pi * RADIUS**2,
    "density": 1000.0,
    "damping": 10.0,
}
"""Numbers of a soft rubber [N m^2, N, kg/m^3, 1/s]."""
LOWER = {"density": 300.0, "axial_stiffness": 75.0, "damping": 0.5}
UPPER = {
    "axial_stiffness": 1000.0,
    "bending_stiffness": 0.033,
    "density": 4500.0,
    "damping": 60.0,
}
"""Up to these the step is stable."""
RATE = 30
PRESSED, PERIOD = 0.05, 4.0
"""Travel of the wall [m], and its time there and back [s]."""
SD = {"film": 1e-3, "force": 0.05}
"""Size of the noise in every coordinate of every node [m], and in the sensor [N]."""
TRUST = ((1.0, 1.0, 1e-3), (0.2, 1.0, 1e-3), (SD["force"], 0.1, 1e-6))
"""For each search in turn: noise of the sensor [N], at last the true one; damping of
the first step; relative change that ends the search."""
TOLERANCE = 5e-6
"""Relative change that ends the search of joined windows."""
UNEVEN = 5e-3
"""Amplitude of each mode at time zero [rad], and its rate [rad/s]."""


class Buckling:
    """The scene, and windows of it."""

    def __init__(self, n: int = 16, modes: int = 8, frames: int = 90) -> None:
        """Sets the numbers of elements, of modes of a start and of frames."""
        self.n, self.modes, self.frames = n, modes, frames
        s = np.pi * (np.arange(n) + 0.5) / n
        dtype = jnp.result_type(1.0)
        # The first makes ends meet, the others are free.
        self.shapes = jnp.asarray(np.sin(np.outer(np.arange(1, modes + 2), s)), dtype)
        worst = TRUTH | UPPER | {"density": LOWER["density"]}
        scene, _ = self.scene(worst)
        stiffness = scene.rod.shear_stretch_stiffness[:, 0]
        self.shear = float(stiffness[2] / stiffness[0])
        stable = 0.9 * float(jaxrod.stable_dt(scene).dt)
        self.per = int(np.ceil(1 / RATE / stable))
        self.dt = 1 / RATE / self.per

    def scene(self, p: dict[str, Any]) -> tuple[Any, Any]:
        """The scene for parameters, and the straight rod."""
        rod, state = jaxrod.straight_rod(
            self.n,
            length=LENGTH,
            radius=RADIUS,
            density=p["density"],
            youngs_modulus=MODULUS,
            poisson_ratio=0.5,
            normal=(1.0, 0.0, 0.0),
        )
        axial = p["axial_stiffness"] / TRUTH["axial_stiffness"]
        bending = p["bending_stiffness"] / TRUTH["bending_stiffness"]
        rod = replace(
            rod,
            shear_stretch_stiffness=axial * rod.shear_stretch_stiffness,
            bend_twist_stiffness=bending * rod.bend_twist_stiffness,
        )
        half = 0.5 * PRESSED
        wall = jaxrod.schedules.sine(
            (0.0, 0.0, half), PERIOD, mean=(0.0, 0.0, -half), phase=0.25
        )
        effects = (
            jaxrod.clamp(state),
            jaxrod.driven(state, "tip", displacement=wall, axes="zx"),
            jaxrod.exponential_damping(p["damping"]),
        )
        scene = jaxrod.make_scene(rod, *effects, method=jaxrod.planar("zx"))
        return scene, state

    def shape(self, amplitudes: Array, time: Any) -> tuple[Array, Array]:
        """Places of nodes (x, z) and angles of elements, from modes of the angle.

        Strain and shear are those of one force along z; it and the first mode's
        amplitude are such that the ends meet the walls.
        """
        gap = LENGTH - 0.5 * PRESSED * (1 - jnp.cos(2 * jnp.pi * time / PERIOD))
        length = LENGTH / self.n

        def closed(first: Array) -> tuple[Array, Array, Array]:
            angle = first * self.shapes[0] + amplitudes @ self.shapes[1:]
            sine, cosine = jnp.sin(angle), jnp.cos(angle)
            yields = cosine**2 + self.shear * sine**2
            force = (jnp.sum(cosine) - gap / length) / jnp.sum(yields)
            aside = sine * (1 + force * (self.shear - 1) * cosine)
            edges = length * jnp.stack([aside, cosine - force * yields])
            return jnp.sum(edges[0]), edges, angle

        first = jnp.zeros(())
        for _ in range(4):
            aside, slope = jax.jvp(lambda a: closed(a)[0], (first,), (jnp.ones(()),))
            first = first - aside / slope
        _, edges, angle = closed(first)
        nodes = jnp.concatenate([jnp.zeros((2, 1)), jnp.cumsum(edges, axis=1)], axis=1)
        return nodes, angle

    def state(self, p: dict[str, Any], start: dict[str, Any], time: Any) -> Any:
        """The state of amplitudes and their rates: axial waves are not in it."""
        scene, straight = self.scene(p)
        (nodes, angle), (velocity, spin) = jax.jvp(
            self.shape,
            (start["amplitudes"], time),
            (start["rates"], jnp.ones_like(time)),
        )
        none = jnp.zeros(self.n + 1)
        zero = none[1:]
        half = 0.5 * angle
        state = replace(
            straight,
            positions=jnp.stack([nodes[0], none, nodes[1]]),
            velocities=jnp.stack([velocity[0], none, velocity[1]]),
            orientations=jnp.stack([jnp.cos(half), zero, jnp.sin(half), zero]),
        )
        spins = jnp.stack([zero, spin, zero])
        return jaxrod.with_angular_velocities(scene.rod, state, spins)

    def window(self, p: dict[str, Any], start: Any, first: Any, frames: int) -> Any:
        """Frames from one on, the first with the start itself."""
        state = self.state(p, start, first / RATE)
        return self._seen(p, self._run(p, state, first, frames - 1), first)

    def joint(
        self, p: dict[str, Any], state: Any, first: Any, frames: int
    ) -> tuple[Any, Any]:
        """Frames from one on, from a state, and the state at the frame after them."""
        states = self._run(p, state, first, frames)
        shown, end = (
            jax.tree.map(lambda leaf, part=part: leaf[part], states)
            for part in (slice(None, -1), -1)
        )
        return self._seen(p, shown, first), end

    def _run(self, p: dict[str, Any], state: Any, first: Any, intervals: int) -> Any:
        """States at frames."""
        scene, _ = self.scene(p)
        steps, begun = self.per * intervals, self.per * first
        return jaxrod.rollout(scene, state, self.dt, steps, self.per, first=begun)

    def _seen(self, p: dict[str, Any], states: Any, first: Any) -> Any:
        """Observations of states by film and sensor."""
        scene, _ = self.scene(p)
        times = first / RATE + jnp.arange(len(states.positions)) / RATE

        def force(time: Any, state: Any) -> Array:
            return jaxrod.reactions(scene.at(time), state)[0].force[2]

        return {
            "film": states.positions[:, ::2, 1:-1],
            "force": jax.vmap(force)(times, states),
        }

    def film(self, p: dict[str, Any], key: Any) -> Any:
        """All frames of a rod that is straight except for unobserved modes."""
        a, b = UNEVEN * jax.random.normal(key, (2, self.modes))
        start = {"amplitudes": a, "rates": b}
        return self.window(p, start, jnp.asarray(0), self.frames)

    def starts(self, film: Array, every: int) -> Any:
        """Starts of windows as a film shows them.

        Amplitudes of every frame by least squares, and of their parabola through
        neighbouring frames value and slope.
        """
        times = jnp.arange(self.frames) / RATE

        def seen(frame: Array, time: Array) -> Array:
            def apart(amplitudes: Array) -> Array:
                return self.shape(amplitudes, time)[0][:, 1:-1] - frame

            zero = jnp.zeros(self.modes)
            return least_squares(apart, zero, iterations=15).solution

        amplitudes = jax.vmap(seen)(film, times)
        made = []
        for first in range(0, self.frames - every + 1, every):
            low = max(0, min(first - 3, self.frames - 7))
            near = slice(low, low + 7)
            design = np.vander((np.arange(self.frames)[near] - first) / RATE, 3)
            parabola = jnp.asarray(np.linalg.pinv(design), film.dtype)
            _, slope, value = parabola @ amplitudes[near]
            made.append((value, slope))
        values, slopes = map(jnp.stack, zip(*made, strict=True))
        return {"amplitudes": values, "rates": slopes}

    def films(self, keys: Any) -> Any:
        """Films of rods that are straight except for unobserved modes, by key."""
        return jax.vmap(lambda key: self.film(TRUTH, key))(keys)

    def apart(
        self,
        seen: Any,
        start: Any,
        starts: Any,
        every: int,
        trust: Any = TRUST,
        iterations: int = 30,
    ) -> Any:
        """A fit to films, stacked in front, in windows that are not joined.

        Starts of windows begin with those given, stacked by film and window. Weights of
        the force rise from one search to the next, `TRUST`: of a start that only the
        film shows it is wrong by many times its noise.
        """
        firsts, parts = self._parts(seen, every)

        def run(p: Any, start: Any, first: Any) -> Any:
            return self.window(p, start, first, every)

        def search(begin: Any, trust: Array) -> Any:
            values, unknowns = begin
            fit = control.fit(
                run,
                jax.tree.map(_joined, parts),
                values,
                multiple_shooting=MultipleShooting(unknowns, known=_joined(firsts)),
                noise={"film": SD["film"], "force": trust[0]},
                lower=LOWER,
                upper=UPPER,
                initial_damping=trust[1],
                tolerance=trust[2],
                iterations=iterations,
            )
            return (fit.values, fit.unknowns), fit

        begin = (jax.tree.map(jnp.asarray, start), jax.tree.map(_joined, starts))
        _, fits = jax.lax.scan(search, begin, jnp.asarray(trust))
        return jax.tree.map(lambda leaf: leaf[-1], fits)

    def fit(self, seen: Any, start: Any, every: int, iterations: int = 60) -> Any:
        """A fit to films, stacked in front, in windows of so many frames, joined.

        Parameters begin with those of windows that are not joined, states with what the
        film shows, and the rod at time zero straight and at rest.
        """
        starts = self.shown(seen, every)
        values = self.apart(seen, start, starts, every, TRUST[:-1]).values
        firsts, parts = self._parts(seen, every)

        def state(start: Any, first: Array) -> Any:
            return self.state(values, start, first / RATE)

        return control.fit(
            lambda p, state, first: self.joint(p, state, first, every),
            parts,
            jax.tree.map(jnp.asarray, values),
            multiple_shooting=MultipleShooting(
                jax.tree.map(lambda leaf: jnp.zeros_like(leaf[:, 0]), starts),
                jax.vmap(jax.vmap(state))(starts, firsts),
                known=firsts,
                initial_state=lambda p, start, first: self.state(
                    p, start, first / RATE
                ),
            ),
            noise=SD,
            lower=LOWER,
            upper=UPPER,
            tolerance=TOLERANCE,
            iterations=iterations,
        )

    def shown(self, seen: Any, every: int) -> Any:
        """`starts` of all films."""
        return jax.vmap(lambda film: self.starts(film, every))(seen["film"])

    def _parts(self, seen: Any, every: int) -> tuple[Array, Any]:
        """First frames of windows, and windows, by film."""
        parts = jax.vmap(lambda one: windows(one, every, with_starts=True))(seen)
        firsts = jnp.arange(0, self.frames - every + 1, every)
        return jnp.tile(firsts, (len(seen["force"]), 1)), parts


def _joined(leaf: Array) -> Array:
    """Windows of all films along one axis."""
    return jnp.reshape(leaf, (-1, *leaf.shape[2:]))
