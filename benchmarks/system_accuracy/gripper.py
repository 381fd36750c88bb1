"""Three soft fingers close around a free ball, in both libraries.

The fingers hang from their clamped ends. Couples along each bend it inwards, and grow
for the first half of the time. The ball is weightless and off the middle, where the
fingers push it. There is no friction: PyElastica's would not turn the ball. Contact is
one law in both, a force per length, of a spring and a dashpot. PyElastica's numbers are
those of an element. Its error is of first order, because it looks for contact from the
middle of an element to the middle of the next.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.system_accuracy.contact_scenes import ContactScene, whole_step
from benchmarks.system_speed.run import Scene, simulator, stepping
from jaxrod import schedules, shapes, systems

LENGTH, RADIUS, APART = 0.1, 0.005, 0.04
BALL, CENTRE, DENSITY = 0.02, (0.004, 0.002, -0.07), 300.0
COUPLE, DURATION, RATE = 0.02, 0.6, 10.0
STIFFNESS, DASHPOT = 2e4, 5.0
MATERIAL: dict[str, Any] = {
    "density": 1100.0,
    "youngs_modulus": 5e5,
    "shear_modulus": 5e5 / 3,
}


def finger(n: int, angle: Any) -> tuple[Any, Any]:
    """A finger and its state."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    rod, state = jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        start=APART * jnp.stack([c, s, 0 * c]),
        direction=(0.0, 0.0, -1.0),
        normal=jnp.stack([c, s, 0 * c]),
        **MATERIAL,
    )
    couple = COUPLE * jnp.stack([-s, c, 0 * c])
    closing = schedules.ramp(0 * couple, couple, DURATION / 2)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.uniform_load(couple_per_length=closing),
        jaxrod.exponential_damping(RATE),
    )
    return scene, state


def gripper(
    n: int, contact: float = 1.0, share: float = 1.0, nudge: float = 0.0
) -> Scene:
    """The fingers and the ball in both libraries; `nudge` moves the ball [m]."""
    import elastica as ea

    angles = 2 * jnp.pi * jnp.arange(3) / 3
    scenes, states = jax.vmap(lambda angle: finger(n, angle))(angles)
    centre = np.asarray(CENTRE) + np.asarray([nudge, 0.0, 0.0])
    ball, of_ball = systems.rigid_body(
        shapes.sphere(centre, BALL),
        density=DENSITY,
        effects=(jaxrod.exponential_damping(RATE),),
    )
    state = {"fingers": states, "ball": of_ball}
    law = {"stiffness": contact * STIFFNESS, "damping": np.sqrt(contact) * DASHPOT}
    touch = systems.body_contact(
        "fingers",
        "ball",
        touching=0.5 * LENGTH,
        points_per_element=int(np.ceil(2 * LENGTH / (n * RADIUS))),
        **law,
    )
    system = jaxrod.make_system({"fingers": scenes, "ball": ball}, touch, state=state)
    dt = whole_step(system, DURATION, share)

    class Closing(ea.NoForces):
        """A couple per length that grows."""

        def __init__(self, couple: Any) -> None:
            super().__init__()
            self.couple = couple

        def apply_torques(self, system: Any, time: Any = 0.0) -> None:
            """Adds the couple of each element, in its frame."""
            now = min(1.0, float(time) / (DURATION / 2)) * LENGTH / n * self.couple
            frames = system.director_collection
            system.external_torques += np.einsum("ijk,j->ik", frames, now)

    theirs = simulator("Constraints", "Forcing", "Damping", "Contact")
    sphere = ea.Sphere(centre, BALL, DENSITY)
    theirs.append(sphere)
    rods = []
    for angle in np.asarray(angles):
        out = np.asarray([np.cos(angle), np.sin(angle), 0.0])
        rod = ea.CosseratRod.straight_rod(
            n,
            APART * out,
            np.asarray([0.0, 0.0, -1.0]),
            out,
            LENGTH,
            RADIUS,
            **MATERIAL,
        )
        theirs.append(rod)
        theirs.constrain(rod).using(
            ea.OneEndFixedBC,
            constrained_position_idx=(0,),
            constrained_director_idx=(0,),
        )
        around = np.asarray([-out[1], out[0], 0.0])
        theirs.add_forcing_to(rod).using(Closing, COUPLE * around)
        theirs.detect_contact_between(rod, sphere).using(
            ea.RodSphereContact,
            k=law["stiffness"] * LENGTH / n,
            nu=law["damping"] * LENGTH / n,
        )
        rods.append(rod)
    for each in (*rods, sphere):
        theirs.dampen(each).using(
            ea.AnalyticalLinearDamper,
            uniform_damping_constant=RATE,
            time_step=dt,
        )
    step = stepping(theirs, dt)
    return Scene(system, state, dt, step, dt, (*rods, sphere))


SCENE = ContactScene(gripper, DURATION, LENGTH, 4, (8, 16, 32, 64, 96), (192, 1.0))
