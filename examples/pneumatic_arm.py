"""A soft arm that two chambers curl, one after another.

A chamber of area A at the offset x from the axis, under the pressure p, gives an arm
the uniform curvature p A x / EI. Run it with `python examples/pneumatic_arm.py`.
"""

import gallery
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, schedules

N, LENGTH, RADIUS, YOUNG = 30, 0.3, 0.012, 1e6  # [1], [m], [m], [Pa]
PRESSURE, AREA, OFFSET = 4e5, 5e-5, 0.007  # [Pa], [m^2], [m]
NUMBER = "turn of the tip, and p A x L / EI [rad]"
LOOK = {"frame": (0, 12, 20, 28, 40), "azimuth": -90, "elevation": 14}


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
    wall = jaxrod.clamp(state)
    pressure = schedules.table(
        (0.0, 1.0, 1.6, 3.0),
        PRESSURE * jnp.asarray([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
    )
    offsets = OFFSET * jnp.asarray([[-1.0, 0.0], [1.0, 0.0]])
    chambers = actuation.chamber(rod, pressure, AREA, offsets=offsets, into=wall)
    scene = jaxrod.make_scene(rod, wall, chambers, jaxrod.exponential_damping(12.0))
    return scene, state, 0.9 * float(jaxrod.stable_dt(scene).dt)


def run(share=1.0):
    """A replay, the rotation of the tip with one full chamber, and p A x L / EI."""
    scene, state, dt = build()
    every = int(4.0 / dt / 100)
    n = int(100 * share) * every
    states = jaxrod.rollout(scene, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)

    def pressure(scene, state):
        return scene.effects[1].pressure[1] / 1e3

    replay = jaxrod.viz.Replay.from_states(
        scene, states, times, fields={"pressure [kPa]": pressure}, title="Pneumatic arm"
    )
    full = min(int(1.6 / dt / every), len(times) - 1)
    orientation = states.orientations[full, :, -1]
    turn = 2 * jnp.arctan2(jnp.linalg.norm(orientation[1:]), jnp.abs(orientation[0]))
    second_moment = jnp.pi * RADIUS**4 / 4
    # The last element lies half of one before the tip.
    whole = LENGTH * (1 - 0.5 / N)
    return (
        replay,
        float(turn),
        float(PRESSURE * AREA * OFFSET / (YOUNG * second_moment) * whole),
    )


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
