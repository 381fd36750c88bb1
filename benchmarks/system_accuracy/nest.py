"""Nine rods settle on a floor and on each other, in both libraries.

Three layers of three parallel rods are rotated by the golden angle. All that touch are
just in contact at the start, and gravity bends the rods over those below. Damping is
strong, so nothing bounces. There is no friction. The laws of contact differ: jaxrod's
is one spring for each crossing, PyElastica's one force for every two elements that
touch, which also carries the load on them. The reference is the limit of hard contact.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.system_accuracy.contact_scenes import ContactScene, whole_step
from benchmarks.system_speed.run import Scene, simulator, stepping
from jaxrod import shapes, systems

RODS, PER_LAYER = 9, 3
LENGTH, RADIUS, ASIDE = 1.0, 0.02, 0.25
GRAVITY, DURATION, RATE = 9.81, 0.4, 20.0
STIFFNESS, FLOOR = 1e5, 4e5
MATERIAL: dict[str, Any] = {
    "density": 1000.0,
    "youngs_modulus": 1e7,
    "shear_modulus": 1e7 / 3,
}
LINE = MATERIAL["density"] * np.pi * RADIUS**2


def rods(n: int, nudge: float) -> tuple[Any, Any]:
    """The rods and their states, with a leading axis."""

    def one(number: Any) -> tuple[Any, Any]:
        layer, place = jnp.divmod(number, PER_LAYER)
        c, s = jnp.cos(2.4 * layer), jnp.sin(2.4 * layer)
        along = jnp.stack([c, s, 0 * c])
        across = ASIDE * (place - 0.5 * (PER_LAYER - 1)) + nudge * jnp.sin(3.0 * number)
        middle = jnp.stack([-across * s, across * c, (1 + 2 * layer) * RADIUS])
        start = middle - 0.5 * LENGTH * along
        shape: dict[str, Any] = {"length": LENGTH, "radius": RADIUS}
        return jaxrod.straight_rod(
            n,
            start=start,
            direction=along,
            normal=jnp.asarray([0.0, 0.0, 1.0]),
            **shape,
            **MATERIAL,
        )

    return jax.vmap(one)(jnp.arange(RODS))


def nest(n: int, contact: float = 1.0, share: float = 1.0, nudge: float = 0.0) -> Scene:
    """The nest in both libraries; `nudge` moves the rods aside by up to this [m]."""
    import elastica as ea

    several, states = rods(n, nudge)
    stiffness, floor = contact * STIFFNESS, contact * FLOOR
    dashpot = 0.2 * np.sqrt(stiffness * LINE * LENGTH)
    floor_dashpot = 0.2 * np.sqrt(floor * LINE)

    def scene(rod: Any) -> Any:
        plane = shapes.plane()
        return jaxrod.make_scene(
            rod,
            jaxrod.contact(plane, stiffness=floor, damping=floor_dashpot),
            jaxrod.gravity((0.0, 0.0, -GRAVITY)),
            jaxrod.exponential_damping(RATE),
        )

    touch = systems.crossing_contact(
        "rods",
        stiffness=stiffness,
        damping=dashpot,
        lists=systems.neighbour_lists(skin=1.0, refresh_every=8),
    )
    state = {"rods": states}
    system = jaxrod.make_system({"rods": jax.vmap(scene)(several)}, touch, state=state)
    dt = whole_step(system, DURATION, share)
    theirs = simulator("Forcing", "Damping", "Contact")
    their_rods = []
    for nodes in np.asarray(states.positions):
        rod = ea.CosseratRod.straight_rod(
            n,
            nodes[:, 0],
            (nodes[:, -1] - nodes[:, 0]) / LENGTH,
            np.asarray([0.0, 0.0, 1.0]),
            LENGTH,
            RADIUS,
            **MATERIAL,
        )
        theirs.append(rod)
        theirs.add_forcing_to(rod).using(
            ea.GravityForces, acc_gravity=np.asarray([0.0, 0.0, -GRAVITY])
        )
        theirs.dampen(rod).using(
            ea.AnalyticalLinearDamper,
            uniform_damping_constant=RATE,
            time_step=dt,
        )
        their_rods.append(rod)
    for pair in itertools.combinations(their_rods, 2):
        theirs.detect_contact_between(*pair).using(
            ea.RodRodContact, k=stiffness, nu=dashpot
        )
    ground = ea.Plane(np.zeros(3), np.asarray([0.0, 0.0, 1.0]))
    theirs.append(ground)
    for rod in their_rods:
        theirs.detect_contact_between(rod, ground).using(
            ea.RodPlaneContact, k=floor * LENGTH / n, nu=floor_dashpot * LENGTH / n
        )
    step = stepping(theirs, dt)
    return Scene(system, state, dt, step, dt, tuple(their_rods))


SCENE = ContactScene(nest, DURATION, LENGTH, 4, (8, 12, 16, 24), (48, 4.0))
