"""A rod whose ends are turned in guides: straight pieces on which nothing slips off.

Loops of a rod that is wound up slide along it. An end that is a point of it is no
obstacle to them, and two turns are gone with every loop that slides over it. Here a
piece of the rod at each end lies on the axis, and is longer than loops get.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod

LENGTH, RADIUS, YOUNG = 1.0, 0.025, 1e6
"""Numbers of PyElastica's examples, between the guides; their mass is 1 kg."""
SHEAR = YOUNG / 1.5
BENDING = YOUNG * np.pi * RADIUS**4 / 4
TORSION = SHEAR * np.pi * RADIUS**4 / 2
FAR = 1e5
"""Length of the lines with which the ends go on, for the link [m].

What it misses is as the square of radius over length.
"""


@dataclass(frozen=True)
class Guided:
    """A rod in guides, and its state."""

    system: Any
    state: Any
    whole: float
    """Length with the guided pieces [m]."""


def guided(
    n: int,
    n_guided: int,
    turn: Any,
    *,
    pull: Any = None,
    stiffness: float,
    dashpot: float,
    damping: tuple[float, float],
    across: float,
) -> Guided:
    """A rod along y, turned at its last element, that may slide through that guide.

    Args:
        n: Elements between the guides.
        n_guided: Elements in each guide.
        turn: Schedule of the angle [rad].
        pull: Schedule of the force on the end that slides [N].
        stiffness: Stiffness of contact [N/m^2].
        dashpot: Dashpot of contact [kg/(m s)].
        damping: Damping rates of velocities and of spins [1/s].
        across: Load across the rod, which decides where it buckles [N/m].
    """
    m, size = n + 2 * n_guided, LENGTH / n
    rod, state = jaxrod.straight_rod(
        m,
        length=m * size,
        radius=RADIUS,
        density=1 / (np.pi * RADIUS**2 * LENGTH),
        youngs_modulus=YOUNG,
        shear_modulus=SHEAR,
        direction=(0.0, 1.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    turned = jaxrod.driven(
        state, "tip", axes="xz", axis=(0.0, 1.0, 0.0), angle=turn, holds_element=True
    )
    guides = [
        jaxrod.pin_support(state, node, axes="xz")
        for k in range(1, n_guided + 1)
        for node in (k, m - k)
    ]
    scene = jaxrod.make_scene(
        rod,
        jaxrod.fixed_end(state),
        turned,
        *guides,
        *([] if pull is None else [jaxrod.end_load(pull)]),
        jaxrod.uniform_load((0.0, 0.0, -across)),
        jaxrod.exponential_damping(*damping),
    )
    touch = jaxrod.systems.rod_contact(
        "rod",
        self_contact=True,
        stiffness=stiffness,
        damping=dashpot,
        points_per_element=2,
    )
    system = jaxrod.make_system({"rod": scene}, touch)
    return Guided(system, {"rod": state}, m * size)


@jax.jit
def topology(state: Any, radii: Any) -> Any:
    """Twist, writhe and link."""
    nodes, normals = state.positions, state.directors[0]
    far = {"ends": "next_tangent", "extension": FAR}
    return (
        jaxrod.topology.twist(nodes, normals),
        jaxrod.topology.writhe(nodes, **far),
        jaxrod.topology.link(nodes, normals, offset=radii, **far),
    )


def nearest(state: Any, pieces: int = 6) -> float:
    """Smallest distance of places of the rod that may touch, over the diameter."""
    nodes = np.asarray(state.positions)
    share = (np.arange(pieces) + 0.5) / pieces
    edges = np.diff(nodes, axis=1)
    places = (nodes[:, :-1, None] + edges[:, :, None] * share).reshape(3, -1)
    steps = np.linalg.norm(np.diff(places, axis=1), axis=0)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    apart = np.linalg.norm(places[:, :, None] - places[:, None, :], axis=0)
    beside = np.abs(along[:, None] - along[None, :]) < 1.3 * np.pi * RADIUS
    return float(np.min(np.where(beside, np.inf, apart)) / (2 * RADIUS))
