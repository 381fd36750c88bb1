"""Scenes that are compared with C programs, and the C program of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

import jaxrod
from benchmarks.c_programs.programs import (
    constants_of_contact,
    constants_of_joint,
    constants_of_scene,
)
from benchmarks.lanes.run import crossing
from benchmarks.system_speed.run import wound

Built = tuple[Any, Any, float]
"""A scene or a system, its state and its step [s]."""


class Compared(NamedTuple):
    """A scene in jaxrod, and the C program of the same law."""

    title: str
    """Words for the scene in tables."""
    source: str
    """Name of the C program."""
    settings: dict[str, int]
    """Numbers that the C program is compiled for, except those of lists."""
    build: Callable[[str], Built]
    """Function from a type to the scene in it."""
    constants: Callable[[Any, Any, float, str], np.ndarray]
    """Function from a scene, a state, a step and a type to constants of the program."""
    members: tuple[str, ...]
    """Members in the order of the program; none for a single rod."""
    steps: int
    """Number of steps of a measured run."""


def rod(n: int, dtype: str) -> Built:
    """A clamped, damped rod that begins to fall, and half of its largest step."""
    rod, state = jaxrod.straight_rod(
        n,
        length=1.0,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        dtype=dtype,
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity((0.0, -9.81, 0.5)),
        jaxrod.exponential_damping(0.7),
    )
    return scene, state, 0.5 * float(jaxrod.stable_dt(scene).dt)


def joint(n: int, dtype: str) -> Built:
    """Two rods under gravity that share a node; the first is clamped."""
    length, rods, state = 0.5, {}, {}
    for name, start in (("one", 0.0), ("two", length)):
        rods[name], state[name] = jaxrod.straight_rod(
            n,
            length=length,
            radius=0.02,
            density=1000.0,
            youngs_modulus=1e6,
            start=(start, 0.0, 0.0),
            direction=(1.0, 0.0, 0.0),
            dtype=dtype,
        )
    gravity, damping = jaxrod.gravity(), jaxrod.exponential_damping(4.0)
    clamp = jaxrod.clamp(state["one"])
    members = {
        "one": jaxrod.make_scene(rods["one"], clamp, gravity, damping),
        "two": jaxrod.make_scene(rods["two"], gravity, damping),
    }
    tied = jaxrod.systems.tie(("one", "tip"), ("two", "base"), state)
    system = jaxrod.make_system(members, tied, state=state)
    return system, state, 0.5 * float(jaxrod.stable_dt(system).dt)


def coil(n: int, dtype: str) -> Built:
    """A helix of seven turns that press on each other."""
    radius, turns = 0.01, 7.03
    around, rise = 0.06, 0.0198
    angle = np.linspace(0, 2 * np.pi * turns, n + 1)
    nodes = np.stack(
        [around * np.cos(angle), around * np.sin(angle), rise * angle / (2 * np.pi)]
    )
    rod, state = jaxrod.rod_along(
        nodes, radius=radius, density=1000.0, youngs_modulus=1e6, dtype=dtype
    )
    touch = jaxrod.systems.crossing_contact(
        "coil",
        stiffness=1e3,
        damping=0.1,
        self_contact=True,
        lists=jaxrod.systems.neighbour_lists(),
    )
    scene = jaxrod.make_scene(rod, jaxrod.exponential_damping(4.0))
    state = {"coil": state}
    system = jaxrod.make_system({"coil": scene}, touch, state=state)
    return system, state, 0.5 * float(jaxrod.stable_dt(system).dt)


def plectoneme(n: int, dtype: str) -> Built:
    """A rod wound around itself, two strands in a double helix that touch all along."""
    nodes = wound(n, 1.0, 0.004)
    rod, state = jaxrod.rod_along(
        # Around the origin, where positions are rounded least.
        nodes - np.mean(nodes, axis=1, keepdims=True),
        radius=0.004,
        density=1000.0,
        youngs_modulus=1e6,
        shear_modulus=4e5,
        dtype=dtype,
    )
    touch = jaxrod.systems.rod_contact(
        "rope",
        stiffness=1e4,
        damping=1.0,
        self_contact=True,
        lists=jaxrod.systems.neighbour_lists(refresh_every=64),
    )
    scene = jaxrod.make_scene(rod, jaxrod.exponential_damping(4.0))
    state = {"rope": state}
    system = jaxrod.make_system({"rope": scene}, touch, state=state)
    return system, state, 0.5 * float(jaxrod.stable_dt(system).dt)


def rods(n: int) -> Compared:
    """A single rod of n elements."""
    build = lambda dtype: rod(n, dtype)
    steps = max(200, 200_000 // n)
    return Compared(str(n), "rod.c", {"N": n}, build, constants_of_scene, (), steps)


SCENES: dict[str, Compared] = {
    "joint": Compared(
        "two rods of 20 elements, a joint",
        "joint.c",
        {"N": 20},
        lambda dtype: joint(20, dtype),
        constants_of_joint,
        ("one", "two"),
        8192,
    ),
    "crossing": Compared(
        "two ropes of 51, `crossing_contact`",
        "crossing.c",
        {"N": 51, "RODS": 2},
        lambda dtype: crossing("crossing_contact", 51, dtype),
        constants_of_contact,
        ("one", "other"),
        2048,
    ),
    "line": Compared(
        "two ropes of 51, `rod_contact`",
        "line.c",
        {"N": 51, "RODS": 2},
        lambda dtype: crossing("rod_contact", 51, dtype),
        constants_of_contact,
        ("one", "other"),
        2048,
    ),
    "coil": Compared(
        "a coil of 100, `crossing_contact`",
        "crossing.c",
        {"N": 100, "RODS": 1, "BENT": 1},
        lambda dtype: coil(100, dtype),
        constants_of_contact,
        ("coil",),
        1024,
    ),
    "plectoneme": Compared(
        "a plectoneme of 150, `rod_contact`",
        "line.c",
        {"N": 150, "RODS": 1, "BENT": 1},
        lambda dtype: plectoneme(150, dtype),
        constants_of_contact,
        ("rope",),
        512,
    ),
}


def refreshed(system: Any, every: int) -> Any:
    """Copy of a system whose lists are rebuilt every so many steps."""
    (touch,) = system.couplings
    rare = replace(touch, lists=replace(touch.lists, refresh_every=every))
    return replace(system, couplings=(rare,))
