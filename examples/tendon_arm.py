"""Four tendons move the tip of an arm along a figure eight.

One tendon of tension T at the offset a bends an arm to the curvature T a / EI. If it is
straight between 20 eyelets, the curvature is 3 % larger.
"""

import math

import gallery
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, schedules

N, LENGTH, RADIUS, YOUNG = 20, 0.25, 0.008, 1e6  # [1], [m], [m], [Pa]
OFFSET, PULL, HELD, LOOP = 0.007, 2.5, 1.5, 4.0  # [m], [N], [s], [s]
NUMBER = "turn of the tip under one tendon, and 19 times that of a joint [rad]"
LOOK = {"frame": (60, 75, 90, 105), "azimuth": -55, "elevation": 20}


def tensions():
    """Tensions of the four tendons over time: one is pulled and held, then the loop."""
    phase = jnp.linspace(0.0, 2 * jnp.pi, 121)
    way = PULL * jnp.stack([jnp.cos(phase), jnp.sin(2 * phase)])
    first = jnp.asarray([[0.0, PULL, PULL], [0.0, 0.0, 0.0]])
    both = jnp.concatenate([first, way], axis=1)
    four = jnp.clip(jnp.stack([both[0], both[1], -both[0], -both[1]]), 0, None)
    start = jnp.asarray([0.0, 0.7, HELD])
    times = jnp.concatenate([start, 1e-3 + HELD + LOOP * phase / (2 * jnp.pi)])
    return schedules.table(times, four.T)


def build():
    """The arm, its state and the time step."""
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1100.0,
        youngs_modulus=YOUNG,
        direction=(0.0, 0.0, 1.0),
        normal=(1.0, 0.0, 0.0),
    )
    sides = OFFSET * jnp.asarray([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    tendons = actuation.tendon(rod, sides, tension=tensions())
    effects = jaxrod.clamp(state), tendons, jaxrod.exponential_damping(12.0)
    scene = jaxrod.make_scene(rod, *effects)
    return scene, state, 0.9 * float(jaxrod.stable_dt(scene).dt)


def run(share=1.0):
    """A replay, the rotation of the tip under one tendon, and T a L / EI."""
    scene, state, dt = build()
    every = int((HELD + LOOP) / dt / 160)
    n = int(160 * share) * every
    states = jaxrod.rollout(scene, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    replay = jaxrod.viz.Replay.from_states(scene, states, times, title="Tendon arm")
    path = jnp.broadcast_to(states.tip.T, (len(times), 3, len(times)))
    trace = jaxrod.viz.Replay.from_rollout(path, 1e-3, times, name="way of the tip")
    replay = replay.together(trace)
    held = min(int(HELD / dt / every), len(times) - 1)
    orientation = states.orientations[held, :, -1]
    turn = 2 * jnp.arctan2(jnp.linalg.norm(orientation[1:]), jnp.abs(orientation[0]))
    return replay, float(turn), (N - 1) * joint_angle()


def joint_angle():
    """Rotation between two eyelets, from the balance of moments about the joint."""
    bending, axial = YOUNG * math.pi * RADIUS**4 / 4, YOUNG * math.pi * RADIUS**2
    spacing, angle = LENGTH / N, 0.0
    for _ in range(50):
        half = 0.5 * spacing * (1 - PULL / axial)
        arm = half * math.sin(angle / 2) + OFFSET * math.cos(angle / 2)
        angle = spacing * PULL * arm / bending
    return angle


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
