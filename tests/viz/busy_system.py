"""A system with one of everything that a replay can show, and a run of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.viz import Replay, speed


def torus(parameters, point):
    ring, thickness = parameters
    across = jnp.sqrt(point[0] ** 2 + point[1] ** 2 + 1e-12) - ring
    return jnp.sqrt(across**2 + point[2] ** 2 + 1e-12) - thickness


def busy_system():
    """Two kinds of rods and five kinds of bodies over a floor and a slope."""
    floor = jaxrod.shapes.plane((0, 0, 0), (0, 0, 1))
    slope = jaxrod.shapes.plane((0, -0.3, 0), (0, 1, 1))
    post = jaxrod.shapes.cylinder((0.3, 0.3, 0), (0.3, 0.3, 0.3), 0.03)
    touch = lambda body: jaxrod.contact(body, stiffness=5e3, damping=5.0)

    def hair(y):
        rod, state = jaxrod.straight_rod(
            6,
            length=0.3,
            radius=0.01,
            density=1000.0,
            youngs_modulus=1e5,
            start=jnp.stack([0 * y, y, 0.015 + 0 * y]),
            direction=(1.0, 0.0, 0.0),
        )
        effects = (jaxrod.gravity(), touch(floor), touch(slope))
        return jaxrod.make_scene(rod, *effects), state

    hairs, of_hairs = jax.vmap(hair)(jnp.linspace(-0.1, 0.1, 3))
    arm, of_arm = jaxrod.straight_rod(
        10,
        length=0.4,
        radius=(0.02, 0.01),
        density=1000.0,
        youngs_modulus=1e5,
        start=(0.0, 0.3, 0.2),
        direction=(1.0, 0.0, 0.0),
    )
    scene = jaxrod.make_scene(arm, jaxrod.clamp(of_arm), jaxrod.gravity(), touch(post))
    capsule = jaxrod.shapes.capsule((0.0, -0.3, 0.2), (0.1, -0.3, 0.2), 0.03)
    box = jaxrod.shapes.box((0.3, -0.3, 0.2), (0.05, 0.03, 0.02))
    drum = jaxrod.shapes.cylinder((0.5, -0.3, 0.2), (0.5, -0.3, 0.3), 0.04)
    ball = jaxrod.shapes.sphere((0.15, 0.0, 0.05), 0.03)
    numbers = (jnp.asarray(0.05), jnp.asarray(0.02))
    ring = jaxrod.shapes.signed_distance(lambda p, q: torus(q, p), numbers)
    bodies = {
        "capsule": jaxrod.systems.rigid_body(
            capsule, density=500.0, angular_velocity=(0.0, 8.0, 3.0)
        ),
        "box": jaxrod.systems.rigid_body(
            box, density=500.0, angular_velocity=(5.0, 1.0, 9.0)
        ),
        "drum": jaxrod.systems.rigid_body(
            drum, density=500.0, velocity=(-0.2, 0.0, 0.1)
        ),
        "ball": jaxrod.systems.rigid_body(
            ball, density=500.0, effects=(jaxrod.gravity(),)
        ),
        "ring": jaxrod.systems.rigid_body(
            ring,
            mass=0.1,
            inertia=(2e-4, 2e-4, 3e-4),
            position=(0.7, 0.0, 0.2),
            angular_velocity=(6.0, 0.0, 1.0),
        ),
    }
    members = {"arm": scene, "hairs": hairs} | {k: b for k, (b, _) in bodies.items()}
    state = {"arm": of_arm, "hairs": of_hairs} | {k: s for k, (_, s) in bodies.items()}
    contact = jaxrod.systems.body_contact("hairs", "ball", stiffness=5e3, damping=5.0)
    return jaxrod.make_system(members, contact), state


def busy_run(frames=21):
    """The system, its states and their times, over 0.2 s."""
    system, state = busy_system()
    dt = float(jaxrod.stable_dt(system).dt)
    every = max(1, round(0.2 / dt / (frames - 1)))
    count = every * (frames - 1)
    states = jaxrod.rollout(system, state, dt, count, every)
    return system, states, jaxrod.rollout_times(dt, count, every)


def busy_replay(run=None):
    """All of it as a replay, with contact forces and two fields."""
    system, states, times = run or busy_run()
    share = np.linspace(0, 1, 10)
    return Replay.from_states(
        system,
        states,
        times,
        fields={"speed [m/s]": speed, "share [1]": {"arm": share}},
        forces=True,
        readouts={"height [m]": states["ball"].positions[:, 2, 0]},
        title="One of everything",
    )
