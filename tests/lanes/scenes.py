"""Scenes of every kind that one rod can be in, drawn at random."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import use_lanes
from physics.actuators import actuators

_FORCED = ["always"]


def forced(mode=None):
    """The mode in which a test takes kernels; sets it if one is given."""
    if mode is not None:
        _FORCED[0] = mode
        use_lanes(mode)
    return _FORCED[0]


SEEDS = (0, 1, 2, 4, 5, 6, 7, 9, 10, 11, 12, 13)
"""Seeds of scenes that every method admits; those of 3 and 8 are refused."""
METHODS = ("consistent", "pyelastica", "planar", "torsion free", "planar pyelastica")


def arm(n=8, dtype="float64", **changes):
    """A slender arm along x."""
    numbers = {
        "length": 1.0,
        "radius": 0.04,
        "density": 1000.0,
        "youngs_modulus": 1e6,
        "direction": (1.0, 0.0, 0.0),
        "normal": (0.0, 0.0, 1.0),
    }
    return jaxrod.straight_rod(n, **{**numbers, **changes}, dtype=dtype)


def random_scene(seed):
    """A scene with some of the effects there are: `(scene, state, dt, name)`."""
    rng = np.random.default_rng(seed)
    method = METHODS[seed % len(METHODS)]
    rod, state = arm(int(rng.integers(4, 9)), radius=float(rng.uniform(0.02, 0.06)))
    flat = method.startswith("planar")

    def vector(scale):
        x, y, z = map(float, rng.normal(size=3) * scale)
        return (x, y, 0.0 if flat else z)

    ball = jaxrod.shapes.sphere((0.5, -0.1, 0.0), 0.09)
    touch = {"stiffness": 5000.0, "damping": 0.5, "friction": 0.3}
    touch["points_per_element"] = 3
    tip = (0.0, 0.0, 0.0)
    pushed = jaxrod.end_load(jaxrod.schedules.ramp(tip, vector(1.0), 0.02), tip)
    choices = {
        "gravity": lambda: jaxrod.gravity(vector(9.0)),
        "swinging gravity": lambda: jaxrod.gravity(
            jaxrod.schedules.sine(vector(9.0), 0.01)
        ),
        "damping": lambda: jaxrod.exponential_damping(float(rng.uniform(0.5, 5))),
        "uniform load": lambda: jaxrod.uniform_load(vector(1.0), tip),
        "pushed": lambda: pushed,
        "slender body": lambda: jaxrod.fluids.slender_body_drag(1.0),
        "stokes": lambda: jaxrod.fluids.stokes_drag(0.5, 1.0, 0.01),
        "quadratic": lambda: jaxrod.fluids.quadratic_drag(1000.0, along=0.1),
        "internal": lambda: jaxrod.internal_damping(float(rng.uniform(1e-4, 1e-3))),
        "contact": lambda: jaxrod.contact(ball, **touch),
        "near contact": lambda: jaxrod.near_contact(
            jaxrod.contact(
                (ball, jaxrod.shapes.sphere((0.9, 0.1, 0.0), 0.08)), **touch
            ),
            rod,
            state,
            1,
        ),
    }
    if method in ("consistent", "pyelastica"):
        for name, actuator in actuators(rod, state).items():
            choices[name] = lambda actuator=actuator: actuator
    names = sorted(choices)
    picked = [names[i] for i in rng.choice(len(names), size=3, replace=False)]
    held = jaxrod.clamp(state) if method != "pyelastica" else jaxrod.fixed_end(state)
    made = [held, *[choices[name]() for name in picked]]
    how = {
        "consistent": {},
        "pyelastica": {"method": jaxrod.pyelastica()},
        "planar": {"method": jaxrod.planar("xy")},
        "torsion free": {"method": jaxrod.torsion_free()},
        "planar pyelastica": {"method": jaxrod.planar("xy", jaxrod.pyelastica())},
    }[method]
    scene = jaxrod.make_scene(rod, *made, **how)
    return scene, state, 0.4 * jaxrod.stable_dt(scene).dt, f"{method}: {picked}"


def shaken(state, rods, seed, *, flat=False):
    """States of many rods, each moving in its own way."""
    rng = np.random.default_rng(seed)
    rates = rng.normal(size=(rods, *state.velocities.shape)) * 0.05
    if flat:
        rates[:, 2] = 0.0
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (rods, *x.shape)), state)
    return replace(many, velocities=jnp.asarray(rates, state.velocities.dtype))


def random_batch(seed, rods):
    """Rods of a random scene, each moving in its own way: `(scene, many, dt, name)`."""
    try:
        scene, state, dt, name = random_scene(seed)
    except ValueError:
        pytest.skip("effects that do not go together")
    begun = jaxrod.with_memory(scene, state)
    return scene, shaken(begun, rods, seed, flat=name.startswith("planar")), dt, name
