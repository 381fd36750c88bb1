"""Three soft fingers close around a ball and lift it.

Chambers on the outer side of each finger bend it inwards. The fingers are one member
and the ball is another; the ground is a fixed body. Run it with
`python examples/gripper.py`.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, schedules, shapes, systems

N, LENGTH, RADIUS, BALL = 10, 0.1, 0.008, 0.03  # [1], [m], [m], [m]
CLOSED, HELD, LIFTED, END = 0.6, 1.6, 2.6, 3.2  # [s]
LIFT, PRESSURE = 0.08, 1e5  # [m], [Pa]
NUMBER = "rise of the ball, and rise of the fingers [m]"
LOOK = {"frame": -1, "azimuth": 30, "elevation": 12, "field": "bending [1/m]"}
LAW = {"damping": 10.0, "friction": 0.8, "friction_drag": 10.0}


def finger(angle):
    """A finger beside the ball, and its state."""
    outwards = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(())])
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1100.0,
        youngs_modulus=5e5,
        start=0.046 * outwards + jnp.asarray([0.0, 0.0, 0.11]),
        direction=(0.0, 0.0, -1.0),
        normal=outwards,
    )
    lift = schedules.ramp((0.0,) * 3, (0.0, 0.0, LIFT), LIFTED - HELD, start=HELD)
    pressure = schedules.ramp(0.0, PRESSURE, CLOSED)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.driven(state, displacement=lift),
        actuation.chamber(rod, pressure, 4e-5, offsets=(5e-3, 0.0)),
        jaxrod.gravity(),
        jaxrod.exponential_damping(15.0),
        jaxrod.contact(shapes.plane(), stiffness=5e3, **LAW),
    )
    return scene, state


def build():
    """Fingers and ball, their states and the time step."""
    fingers, of_fingers = jax.vmap(finger)(2 * jnp.pi * jnp.arange(3) / 3)
    effects = jaxrod.gravity(), jaxrod.exponential_damping(0.2, 1.0)
    shape = shapes.sphere((0.0, 0.0, BALL), BALL)
    ball, of_ball = systems.rigid_body(shape, density=200.0, effects=effects)
    state = {"fingers": of_fingers, "ball": of_ball}
    system = jaxrod.make_system(
        {"fingers": fingers, "ball": ball},
        systems.body_contact("fingers", "ball", stiffness=5e3, **LAW),
        systems.rigid_contact("ball", fixed=shapes.plane(), stiffness=5e2, damping=1.0),
        state=state,
    )
    return system, state, 0.95 * float(jaxrod.stable_dt(system).dt)


def run(share=1.0):
    """A replay, the rise of the ball after the grasp, and the rise of the fingers."""
    system, state, dt = build()
    every = int(END / dt / 160)
    n = int(160 * share) * every
    states = jaxrod.rollout(system, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    shown = {"fields": {"bending [1/m]": jaxrod.viz.bending}, "title": "Gripper"}
    replay = jaxrod.viz.Replay.from_states(system, states, times, forces=True, **shown)
    height = states["ball"].positions[:, 2, 0]
    held = min(int(HELD / dt / every), len(height) - 1)
    return replay, float(height[-1] - height[held]), LIFT


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
