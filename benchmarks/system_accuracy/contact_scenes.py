"""Error against cost of scenes in contact, with one reference for both libraries.

A scene is built with any number of elements and any stiffness of its contact. Its
error is the largest distance of a point from its place in the reference at the end,
over the length of a rod. Points are nodes that all numbers of elements have in common.
The reference is jaxrod's, with most elements. Both libraries take the same steps:
`stable_dt` of jaxrod, and shares of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.system_speed.run import Scene, processor
from benchmarks.tradeoff.grid import Row, as_csv, cheapest
from jaxrod import tradeoff

NUDGE = 1e-6
"""Displacement at the start that shows whether a scene is chaotic [lengths]."""


class ContactScene(NamedTuple):
    """A scene in contact, and the settings to compare."""

    build: Callable[..., Scene]
    """The scene in both libraries, of a number of elements, a relative stiffness of
    contact, a share of `stable_dt`, and a displacement at the start [m]."""
    duration: float
    """Simulated time [s]."""
    length: float
    """Length of a rod [m]."""
    parts: int
    """Parts of a rod between the nodes that are compared; divides all of `sizes`."""
    sizes: tuple[int, ...]
    """Numbers of elements."""
    finest: tuple[int, float]
    """Number of elements and relative stiffness of the reference."""
    contacts: tuple[float, ...] = (0.25, 1.0)
    """Relative stiffnesses of contact [1]."""
    shares: tuple[float, ...] = (1.0, 0.5)
    """Steps, over `stable_dt` [1]."""


class Checks(NamedTuple):
    """Changes of the end of the reference, in lengths of a rod [1]."""

    coarser: float
    """With half the elements."""
    softer: float
    """With a quarter of the stiffness of contact."""
    theirs: float
    """In PyElastica, with the elements and the stiffness of the reference."""
    loose: float
    """Nearly without contact."""
    nudged: tuple[float, float]
    """With the start displaced one way or the other, over that displacement."""


def whole_step(system: Any, duration: float, share: float) -> float:
    """The largest step below a share of `stable_dt` that divides the duration [s]."""
    return float(duration / np.ceil(duration / (share * jaxrod.stable_dt(system).dt)))


def points_of(nodes: list[np.ndarray], parts: int) -> np.ndarray:
    """Points to compare `(3, points)` [m], from nodes of rods, and of bodies (3, 1)."""
    return np.concatenate([x[:, :: max(1, x.shape[1] // parts)] for x in nodes], axis=1)


def apart(found: np.ndarray, exact: np.ndarray, length: float) -> float:
    """Largest distance of points, over a length [1]."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.max(np.linalg.norm(found - exact, axis=0))) / length


def our_points(of: ContactScene, scene: Scene, runs: int = 1) -> tuple[Any, float]:
    """Points at the end, and median processor time of runs that are compiled [s].

    Points are not numbers if neighbour lists may have missed a contact.
    """
    steps = round(of.duration / scene.dt)
    after: dict[str, Any] = {}

    def move() -> None:
        state = jaxrod.advance(scene.model, scene.state, scene.dt, jnp.asarray(steps))
        after.update(jax.block_until_ready(state))

    jaxrod.advance(scene.model, scene.state, scene.dt, jnp.asarray(1))
    seconds = float(np.median([processor(move) for _ in range(runs)]))
    near = after.get("neighbours")
    missed = near is not None and (near.overflow or near.stale)
    nodes: list[Any] = []
    for name in scene.model.members:
        places = np.asarray(after[name].positions)
        nodes += [places] if places.ndim == 2 else list(places)
    return points_of(nodes, of.parts) * (np.nan if missed else 1), seconds


def their_points(of: ContactScene, scene: Scene) -> tuple[np.ndarray, float]:
    """The same of PyElastica, which ran before and so is compiled."""

    def move() -> None:
        for _ in range(round(of.duration / scene.their_dt)):
            scene.step()

    seconds = processor(move)
    nodes = [rod.position_collection for rod in scene.their_rods]
    return points_of(nodes, of.parts), seconds


def checks_of(of: ContactScene, exact: np.ndarray) -> Checks:
    """Checks of a scene and of its reference `exact`."""
    n, contact = of.finest

    def moved(*settings: float) -> float:
        return apart(our_points(of, of.build(*settings))[0], exact, of.length)

    middle = of.sizes[-1]
    here, *aside = (
        our_points(of, of.build(middle, 1.0, 1.0, sign * NUDGE * of.length))[0]
        for sign in (0, 1, -1)
    )
    one, other = (apart(each, here, of.length) / NUDGE for each in aside)
    theirs = their_points(of, of.build(n, contact))[0]
    return Checks(
        moved(n // 2, contact),
        moved(n, contact / 4),
        apart(theirs, exact, of.length),
        moved(n // 2, 1e-6),
        (one, other),
    )


def measure_contact(name: str, of: ContactScene) -> tuple[list[Row], float]:
    """Prints the table of a scene; returns its rows and the reference's error.

    The reference is the limit of hard contact if its contact is stiffer than that of
    all rows. Otherwise its stiffness is part of the scene.
    """
    exact, _ = our_points(of, of.build(*of.finest))
    assert np.all(np.isfinite(exact)), "the reference must be finite"
    of.build(of.sizes[0]).step()  # Compiles PyElastica.
    checks = checks_of(of, exact)
    print(f"## {name}: {of.duration:g} s\n")
    print(f"The reference has n = {of.finest[0]} and contact {of.finest[1]:g}.")
    print(f"With half the elements it moves by {checks.coarser:.1e} lengths,")
    print(f"with a quarter of the stiffness by {checks.softer:.1e}.")
    print(f"PyElastica, with the same numbers, is {checks.theirs:.1e} away.")
    print(f"Without contact the end would be {checks.loose:.1e} away.")
    one, other = checks.nudged
    print(f"A nudge of {NUDGE:g} lengths grows {one:.2g} and {other:.2g} times.\n")
    print("| | n | contact | step [us] | error | processor seconds per second |")
    print("|---|---:|---:|---:|---:|---:|")
    rows = []
    for n in of.sizes:
        for contact in of.contacts:
            for share in of.shares:
                scene = of.build(n, contact, share)
                for label, (found, seconds) in (
                    ("jaxrod", our_points(of, scene, 3)),
                    ("PyElastica", their_points(of, scene)),
                ):
                    off = apart(found, exact, of.length)
                    if not off < 1:
                        continue
                    cost = seconds / of.duration
                    print(
                        f"| {label} | {n} | {contact:g} | {1e6 * scene.dt:.1f} | "
                        f"{off:.3%} | {cost:.4g} |",
                        flush=True,
                    )
                    law: Any = "consistent" if label == "jaxrod" else "pyelastica"
                    setting = tradeoff.Setting(
                        n, scene.dt, dtype="float64", mode=law, contact=contact
                    )
                    rows.append(Row(label.lower(), setting, 1, off, cost))
    for error in (0.01, 0.003, 0.001):
        best = [
            cheapest([row for row in rows if row.simulator == who], error)
            for who in ("jaxrod", "pyelastica")
        ]
        costs = [np.nan if row is None else row.wall_s_per_sim_s for row in best]
        print(
            f"\nThe cheapest within {error:.1%}: jaxrod {costs[0]:.4g}, PyElastica "
            f"{costs[1]:.4g} s per second, {costs[1] / costs[0]:.0f} times.",
            flush=True,
        )
    print()
    # Errors are in proportion to 1 / stiffness: a third of the change is left.
    soft = checks.softer / 3 if of.finest[1] > max(of.contacts) else 0.0
    return rows, max(checks.coarser, soft)


def as_csv_with_contact(rows: list[Row]) -> str:
    """The rows as csv, with the relative stiffness of contact as the last column."""
    last = ["contact", *(str(row.setting.contact) for row in rows)]
    lines = as_csv(rows).splitlines()
    pairs = zip(lines, last, strict=True)
    return "".join(f"{line},{word}\n" for line, word in pairs)
