"""Three soft fingers close around a ball and lift it.

Chambers on the outer side of each finger bend it inwards. The fingers are one member,
the ball is another; its weight comes upon them as they close. Run it with
`python examples/gripper.py`.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod

N, LENGTH, RADIUS, BALL, LIFT = 14, 0.12, 0.008, 0.032, 0.08  # [1], [m], [m], [m], [m]
CLOSED, LIFTED, END = 0.8, 1.8, 2.3  # [s]
PRESSURE = 1e5  # [Pa]
NUMBER = "metres the ball was lifted, and the fingers"
LOOK = {"frame": -1, "azimuth": 30, "elevation": 12, "field": "bending [1/m]"}


def finger(angle):
    """A finger that hangs beside the ball, and its state."""
    outwards = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(())])
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1100.0,
        youngs_modulus=4e5,
        start=0.046 * outwards + jnp.asarray([0.0, 0.0, 0.07]),
        direction=(0.0, 0.0, -1.0),
        normal=outwards,
    )
    up = jnp.asarray([0.0, 0.0, LIFT])
    lift = jaxrod.ramp(0 * up, up, LIFTED - CLOSED, start=CLOSED)
    chamber = jaxrod.chamber(
        rod,
        jaxrod.ramp(0.0, PRESSURE, CLOSED),
        4e-5,
        offsets=jnp.asarray([0.6 * RADIUS, 0.0]),
    )
    effects = jaxrod.driven(state, displacement=lift), chamber, jaxrod.gravity()
    return jaxrod.make_scene(rod, *effects, jaxrod.exponential_damping(15.0)), state


def build():
    """Fingers and ball, their states and the time step."""
    fingers, of_fingers = jax.vmap(finger)(2 * jnp.pi * jnp.arange(3) / 3)
    down = jnp.asarray([0.0, 0.0, -9.81])
    weight = jaxrod.gravity(jaxrod.ramp(0 * down, down, 0.3, start=0.5))
    ball, of_ball = jaxrod.rigid_body(
        jaxrod.sphere((0.0, 0.0, 0.0), BALL), density=300.0, effects=(weight,)
    )
    law = {"stiffness": 2e4, "damping": 20.0, "friction": 0.9, "friction_drag": 40.0}
    grip = jaxrod.body_contact("fingers", "ball", **law)
    system = jaxrod.make_system({"fingers": fingers, "ball": ball}, grip)
    state = {"fingers": of_fingers, "ball": of_ball}
    return system, state, 0.9 * float(jaxrod.stable_dt(system).dt)


def run(share=1.0):
    """A replay, how far the ball rose after the grasp, and how far the fingers did."""
    system, state, dt = build()
    every = max(1, int(END / dt / 115))
    n = int(115 * share) * every
    states = jaxrod.rollout(system, state, dt, n, every)
    replay = jaxrod.viz.Replay.from_states(
        system,
        states,
        jaxrod.rollout_times(dt, n, every),
        fields={"bending [1/m]": jaxrod.viz.bending},
        forces=True,
        title="Gripper",
    )
    height = states["ball"].positions[:, 2, 0]
    return replay, float(height[-1] - height[int(CLOSED / dt / every)]), LIFT


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
