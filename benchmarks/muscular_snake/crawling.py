"""Places of the muscular snake as it crawls, here or in PyElastica."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.muscular_snake import scene
from benchmarks.muscular_snake.our_ground import our_ground

QUARTER = round(scene.PERIOD / scene.STEP / 4)
"""Steps."""


def middle(positions: Any, masses: Any) -> np.ndarray:
    """The centre of mass of nodes [m]."""
    mass = np.asarray(masses)
    middle: np.ndarray = np.asarray(positions) @ mass / np.sum(mass)
    return middle


def our_places(
    quarters: int, *given: float, theirs: Collection[str] = ()
) -> Iterator[np.ndarray]:
    """Centres of mass of the body after each quarter of a period [m]."""
    system, state = scene.ours(*given, theirs=theirs)
    masses = system.members["body"].rod.node_masses
    advance = jax.jit(jaxrod.advance)
    yield middle(state["body"].positions, masses)
    for quarter in range(quarters):
        first = jnp.asarray(quarter * QUARTER)
        state = advance(system, state, scene.STEP, jnp.asarray(QUARTER), first=first)
        yield middle(state["body"].positions, masses)


def their_places(quarters: int, *given: float) -> Iterator[np.ndarray]:
    """The same of PyElastica's."""
    yield from _stepped(quarters, *scene.theirs(*given))


def mixed_places(
    quarters: int, sinks: float = 0.02, drag: float = 1000.0
) -> Iterator[np.ndarray]:
    """The same of PyElastica's rods on our ground."""
    yield from _stepped(quarters, *scene.theirs(ground=our_ground(sinks, drag)))


def _stepped(quarters: int, simulator: Any, rods: list[Any]) -> Iterator[np.ndarray]:
    """Centres of mass of PyElastica's body after each quarter."""
    import elastica as ea

    stepper, time = ea.PositionVerlet(), np.float64(0.0)
    yield middle(rods[0].position_collection, rods[0].mass)
    for _ in range(quarters):
        for _ in range(QUARTER):
            time = stepper.step(simulator, time, np.float64(scene.STEP))
        yield middle(rods[0].position_collection, rods[0].mass)


def crawl(which: str, periods: int = 6, *given: float) -> None:
    """Steps one of the two and prints a table."""
    jax.config.update("jax_enable_x64", True)
    kind, *theirs_of = which.split("+")
    if kind not in ("ours", "theirs", "our_ground") or (theirs_of and kind != "ours"):
        raise SystemExit(f"ours[+rods][+joints][+damping], theirs, our_ground: {which}")
    choices: dict[str, Callable[..., Any]] = {
        "ours": functools.partial(our_places, theirs=theirs_of),
        "theirs": their_places,
        "our_ground": mixed_places,
    }
    places = choices[kind]
    found = []
    print("| time [s] | centre of mass [m] |")
    print("|---|---|")
    for quarter, place in enumerate(places(4 * periods, *given)):
        found.append(place)
        print(
            f"| {quarter * scene.PERIOD / 4:g} | "
            f"{', '.join(f'{x:.6f}' for x in place)} |",
            flush=True,
        )
    moved = np.diff(found[::4], axis=0) / scene.LENGTH
    lengths = ", ".join(f"{length:.4f}" for length in np.linalg.norm(moved, axis=1))
    print(f"in each period, in lengths: {lengths}")
