"""Random scenes of one rod, of every method, support and effect, in any view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes.pair_effects import Maker
from extremes.pair_kinds import Kind
from extremes.views import HALF_TURN, Draws, View, draws_of


def curve(random: np.random.Generator, n: int, *, straight: bool, flat: bool) -> Any:
    """Nodes `(3, n + 1)` [m] and the first normal of a rod of about half a metre."""
    length, way = random.uniform(0.3, 0.7), random.normal(size=3)
    bends = random.normal(size=(2, 3)) * 0.15
    if flat:
        way[2], bends[:, 2] = 0.0, 0.0
    way = way / np.linalg.norm(way)
    s = np.linspace(0, 1, n + 1)[None, :]
    nodes = length * way[:, None] * s
    if not straight:
        nodes = nodes + length * (
            bends[0][:, None] * np.sin(3 * s) + bends[1][:, None] * (1 - np.cos(2 * s))
        )
    normal = np.array([0.0, 0.0, 1.0]) if flat else random.normal(size=3)
    return nodes, normal


def material(draws: Draws, view: View, section: str, n: int) -> Any:
    """Section and material, as `rod_along` takes them."""
    choices, random = draws
    r = random.uniform(0.008, 0.02)
    m = lambda x: view.number(x, "m")
    taper = r * np.linspace(1.0, random.uniform(0.6, 0.9), n)
    sections: dict[str, Callable[[], Any]] = {
        "round": lambda: {"radius": m(r)},
        "tapered": lambda: {"radius": view.along(m(taper))},
        "tube": lambda: {"section": jaxrod.tube(m(r), m(0.6 * r))},
        "rectangle": lambda: {"section": jaxrod.rectangle(m(2 * r), m(1.3 * r))},
        "ellipse": lambda: {"section": jaxrod.ellipse(m(r), m(0.7 * r))},
    }
    return {
        **sections[section](),
        "density": view.number(10 ** random.uniform(2.7, 3.3), "kg m^-3"),
        "youngs_modulus": view.number(10 ** random.uniform(5, 6.5), "Pa"),
        "poisson_ratio": random.uniform(0.2, 0.5),
        "joint_mean": str(choices.choice(("arithmetic", "series"))),
    }


def rod_in(view: View, nodes: Any, normal: Any, straight: bool, material: Any) -> Any:
    """A rod along some nodes and its state, in a view."""
    n = nodes.shape[1] - 1
    if straight:
        way = nodes[:, -1] - nodes[:, 0]
        if view.reversed:
            way = -way
        return jaxrod.straight_rod(
            n,
            length=view.number(np.linalg.norm(way), "m"),
            start=view.place(view.along(nodes)[:, 0]),
            direction=view.vector(way),
            normal=view.vector(normal),
            **material,
        )
    _, plain = jaxrod.rod_along(
        nodes, radius=0.01, density=1.0, youngs_modulus=1.0, normal=normal
    )
    frames = np.einsum("ab,ibn->ian", view.turn, np.asarray(plain.directors))
    if view.reversed:
        frames = frames[:, :, ::-1] * HALF_TURN[:, None, None]
    return jaxrod.rod_along(view.along(view.place(nodes)), directors=frames, **material)


def moving(
    random: np.random.Generator, view: View, kind: Any, rod: Any, state: Any
) -> Any:
    """The state with smooth velocities and spins."""
    n = rod.n_elements
    speeds = np.array([random.normal(size=(3, 1)) * 0.4 for _ in range(2)])
    spins = np.array([random.normal(size=(3, 1)) * 2 for _ in range(2)])
    if kind.flat:
        speeds[:, 2], spins[:, :2] = 0.0, 0.0
    wave = lambda a, s: a[0] * np.sin(3 * s)[None] + a[1] * np.cos(2 * s)[None]
    velocities = view.vector(wave(speeds, np.linspace(0, 1, n + 1)), "m s^-1")
    world = view.along(view.vector(wave(spins, np.linspace(0, 1, n)), "s^-1"))
    own = np.einsum("ijn,jn->in", np.asarray(state.directors), world)
    if kind.method == "torsion free":
        own[2] = 0.0
    state = jaxrod.with_angular_velocities(rod, state, own)
    return replace(state, velocities=jnp.asarray(view.along(velocities)))


def scene_in(view: View, kind: Kind, seed: int, draw: int = 0) -> Any:
    """A scene of a kind in a view, and its state.

    Args:
        view: The view.
        kind: All that is chosen by name.
        seed: Of all else that is static.
        draw: Which of its sets of numbers.

    Raises:
        ValueError: If its effects do not go together.
    """
    draws = draws_of(seed, draw)
    random = draws[1]
    nodes, normal = curve(
        random, kind.n_elements, straight=kind.straight, flat=kind.flat
    )
    given = material(draws, view, kind.section, kind.n_elements)
    rod, state = rod_in(view, nodes, normal, kind.straight, given)
    maker = Maker(draws, view, kind, rod, state)
    held = maker.support()
    effects = view.order(held + maker.effects())
    scene = jaxrod.make_scene(rod, *effects, **method_of(kind))
    return scene, moving(random, view, kind, rod, state)


def method_of(kind: Kind) -> Any:
    """The method of a kind, as `make_scene` takes it."""
    made = {
        "consistent": jaxrod.consistent,
        "pyelastica": jaxrod.pyelastica,
        "planar": lambda: jaxrod.planar("xy"),
        "planar pyelastica": lambda: jaxrod.planar("xy", jaxrod.pyelastica()),
        "torsion free": jaxrod.torsion_free,
        "implicit": lambda: jaxrod.implicit(tolerance=1e-9),
    }
    return {"method": made[kind.method]()}
