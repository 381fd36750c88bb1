"""A loose overhand knot is pulled tight, in both libraries.

The rod is straight at rest and begins as a circle with two tails that wind around each
other. Forces on both ends pull for a short time. There is no friction. The laws of self
contact differ: jaxrod's is a force per length, PyElastica's one force for every two
elements that touch. The reference is the limit of hard contact.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import jaxrod
from benchmarks.shared.files import example
from benchmarks.system_accuracy.contact_scenes import ContactScene, whole_step
from benchmarks.system_speed.run import Scene, simulator, stepping
from jaxrod import schedules, systems

LENGTH, RADIUS, LOOP = 0.8, 0.005, 0.07
PULL, DURATION, RATE = 8.0, 0.3, 40.0
MATERIAL: dict[str, Any] = {
    "density": 1000.0,
    "youngs_modulus": 1e6,
    "shear_modulus": 1e6 / 3,
}
BENDING = MATERIAL["youngs_modulus"] * np.pi * RADIUS**4 / 4
LINE = MATERIAL["density"] * np.pi * RADIUS**2


def loose(n: int) -> np.ndarray:
    """Nodes of the loose knot, of elements of one length `LENGTH / n` [m]."""
    overhand = example("knot").overhand
    tail = 0.5 * (LENGTH - 2 * np.pi * LOOP) / LOOP
    for _ in range(4):
        nodes = overhand(n, RADIUS, LOOP, tail)
        missing = LENGTH - np.sum(np.linalg.norm(np.diff(nodes), axis=0))
        tail += 0.5 * missing / LOOP
    return nodes - nodes[:, n // 2 : n // 2 + 1]


def knot(n: int, contact: float = 1.0, share: float = 1.0, nudge: float = 0.0) -> Scene:
    """The knot in both libraries; `nudge` moves its base across [m]."""
    import elastica as ea

    nodes = loose(n)
    nodes[2] += nudge * np.linspace(1, 0, n + 1) ** 2
    rod, _ = jaxrod.straight_rod(n, length=LENGTH, radius=RADIUS, **MATERIAL)
    state = {"rope": jaxrod.rod_along(nodes, radius=RADIUS, **MATERIAL)[1]}
    force = np.asarray([PULL * BENDING / (2 * LOOP**2), 0.0, 0.0])
    stiffness = contact * 300 * BENDING / (LOOP * RADIUS) ** 2
    dashpot = 0.1 * np.sqrt(stiffness * LINE)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.end_load(schedules.ramp(0 * force, force, DURATION / 2)),
        jaxrod.end_load(schedules.ramp(0 * force, -force, DURATION / 2), end="base"),
        jaxrod.exponential_damping(RATE),
    )
    touch = systems.rod_contact(
        "rope",
        stiffness=stiffness,
        damping=dashpot,
        self_contact=True,
        lists=systems.neighbour_lists(
            skin=1.0,
            refresh_every=max(4, n // 24),
            pairs=3 * n + n * n // 24,
            candidates=6 * n + n * n // 10,
            cell_slots=0,
        ),
    )
    system = jaxrod.make_system({"rope": scene}, touch, state=state)
    dt = whole_step(system, DURATION, share)
    theirs = simulator("Forcing", "Damping", "Contact")
    their_rod = ea.CosseratRod.straight_rod(
        n,
        nodes[:, 0],
        np.asarray([1.0, 0.0, 0.0]),
        np.asarray([0.0, 0.0, 1.0]),
        LENGTH,
        RADIUS,
        **MATERIAL,
    )
    their_rod.position_collection[:] = nodes
    their_rod.director_collection[:] = np.asarray(state["rope"].directors)
    theirs.append(their_rod)
    theirs.add_forcing_to(their_rod).using(
        ea.EndpointForces, -force, force, ramp_up_time=DURATION / 2
    )
    theirs.dampen(their_rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=RATE, time_step=dt
    )
    theirs.detect_contact_between(their_rod, their_rod).using(
        ea.RodSelfContact, k=stiffness * LENGTH / n, nu=dashpot * LENGTH / n
    )
    step = stepping(theirs, dt)
    return Scene(system, state, dt, step, dt, (their_rod,))


SCENE = ContactScene(knot, DURATION, LENGTH, 16, (48, 64, 96, 128), (256, 4.0))
