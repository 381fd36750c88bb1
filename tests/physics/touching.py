"""Arms that touch something: on floors, in the way of bodies, and their loads."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.geometry import vectors
from jaxrod.loaded_rod import external_loads
from jaxrod.methods.laws import IN_SPACE
from jaxrod.rods.motion import motion_of
from physics.rods import AREA, DENSITY, RADIUS, arm, deformed, random_rod

G = 9.81
LINE = DENSITY * AREA  # mass per length [kg/m]
DEPTH = 0.05 * RADIUS  # at which the arm rests on a floor [m]
STIFFNESS = LINE * G / DEPTH
RATE = 200.0  # of damping and of friction's drag [1/s]
FRICTION = 0.3


def floor_contact(slope=0.0, friction=FRICTION, **changes):
    """A plane that touches an arm along z, and rises along -x by an angle [rad]."""
    normal = np.array([np.sin(slope), np.cos(slope), 0.0])
    numbers = {
        "stiffness": STIFFNESS,
        "damping": RATE * LINE,
        "friction": friction,
    }
    body = jaxrod.shapes.plane(-RADIUS * normal, normal)
    return jaxrod.contact(body, **numbers | changes)


def on_the_floor(slope=0.0, n=3, mode="consistent", **changes):
    """An arm in equilibrium with a floor, but for what draws it down the slope."""
    rod, state = arm(n)
    sunk = -DEPTH * np.cos(slope) * np.array([np.sin(slope), np.cos(slope), 0.0])
    state = replace(state, positions=state.positions + jnp.asarray(sunk)[:, None])
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, -G, 0.0)),
        floor_contact(slope, **changes),
        method=IN_SPACE[mode],
    )
    return scene, state


@jax.jit
def contact_loads(contact, rod, state):
    """Forces on nodes and couples on elements, world frame for both [N, N m]."""
    motion = motion_of(state)
    zero = jax.tree.map(jnp.zeros_like, (motion.velocity, motion.spin))
    loads = external_loads(jaxrod.make_scene(rod, contact), motion, *zero)
    frame = jaxrod.geometry.rotations.directors(motion.orientation)
    couples = jaxrod.geometry.rotations.to_world(frame, loads.couples)
    return vectors.join(loads.forces), vectors.join(couples)


@jax.jit
def rolled(scene, state, dt, n_steps):
    """Mean velocity along x and spin about z of an arm, later."""
    after = jaxrod.advance(scene, state, dt, n_steps)
    spin = jaxrod.angular_velocities(scene.rod, after)[2]
    return after, jnp.mean(after.velocities[0]), jnp.mean(spin)


def moving_arm(seed=0, speed=0.5):
    """A random rod in the way of every body, moving and turning."""
    rod, _ = random_rod(4, 6, length=0.6)
    return rod, deformed(rod, seed, speed=speed)


def rubbing(body, **changes):
    numbers = {"stiffness": 1e5, "damping": 10.0, "friction": 0.5, "onset": 0.5}
    return jaxrod.contact(body, **numbers | changes)
