"""Rigid bodies that touch: one on the ground, two that fly at each other."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxrod

G = 9.81
SHAPES = {
    "sphere": lambda: jaxrod.shapes.sphere((0, 0, 0), 0.1),
    "capsule": lambda: jaxrod.shapes.capsule((0, 0, -0.1), (0, 0, 0.1), 0.07),
    "cylinder": lambda: jaxrod.shapes.cylinder((0, 0, -0.12), (0, 0, 0.12), 0.08),
    "box": lambda: jaxrod.shapes.box((0, 0, 0), (0.1, 0.07, 0.12)),
}


def body(shape, **options):
    return jaxrod.systems.rigid_body(
        shape, **{"density": 500.0, "dtype": jnp.float64} | options
    )


def alone(shape, fixed=None, slope=0.0, body_options=(), **law):
    """One body on the ground, which may slope downwards along x; and its state."""
    down = (G * np.sin(slope), 0.0, -G * np.cos(slope))
    one, state = body(shape, effects=(jaxrod.gravity(down),), **dict(body_options))
    law = {"stiffness": 1e5, "damping": 100.0, "onset": 1e-4} | law
    ground = jaxrod.shapes.plane() if fixed is None else fixed
    system = jaxrod.make_system(
        {"body": one}, jaxrod.systems.rigid_contact("body", fixed=ground, **law)
    )
    return system, {"body": state}


def moved(state, **fields):
    return {"body": replace(state["body"], **fields)}


def pressed(system, state, slope=0.0, contacts=1):
    """A state on the ground where contact carries the weight."""
    mass, law = system.members["body"].masses[0], system.couplings[0]
    depth = mass * G * np.cos(slope) / law.stiffness / contacts
    down = state["body"].positions.at[2].add(-depth)
    return moved(state, positions=down)


def pair(one, two, **law):
    (a, of_a), (b, of_b) = one, two
    system = jaxrod.make_system(
        {"a": a, "b": b},
        jaxrod.systems.rigid_contact("a", "b", **{"stiffness": 2e4} | law),
    )
    return system, {"a": of_a, "b": of_b}


def thrown(first, second):
    """Two bodies, turning, of which the second flies at the first."""
    rng = np.random.default_rng(3)
    made = []
    for kind, place in ((first, (0, 0, 0)), (second, (0.2, 0.02, 0.01))):
        made.append(
            body(
                SHAPES[kind](),
                position=place,
                orientation=rng.normal(size=4),
                velocity=0.3 * rng.normal(size=3),
                angular_velocity=2 * rng.normal(size=3),
            )
        )
    two, of_two = made[1]
    fast = of_two.velocities - jnp.array([[2.0], [0.0], [0.0]])
    return made[0], (two, replace(of_two, velocities=fast))
