"""A snake on the ground: the gradient of the distance improves its gait.

PyElastica's snake (Gazzola et al., R. Soc. Open Sci. 5, 2018).
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, shapes

N, LENGTH, PERIOD, G, FROUDE = 30, 0.35, 2.0, 9.80665, 0.1  # [1], [m], [s], [m/s^2]
RADIUS = 0.011 * LENGTH
COUPLES = (3.4e-3, 3.3e-3, 4.2e-3, 2.6e-3, 3.6e-3, 3.5e-3)  # [N m]
NUMBER = "lengths moved in the fourth period, here and in PyElastica"
LOOK = {"frame": (40, 80, 120, 160), "azimuth": -65, "elevation": 40}


def build(gait=(2 * jnp.pi, 0.0), couples=COUPLES):
    """The snake with a wave number and tilt of its couples, its state and the step."""
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        start=(0.0, 0.0, 0.95 * RADIUS),
    )
    mass = float(jnp.pi * RADIUS**2 * 1000.0)  # per length [kg/m]
    ground = jaxrod.contact(
        shapes.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        stiffness=mass * G / (0.05 * RADIUS),
        damping=300.0 * mass,
        friction=LENGTH / (PERIOD**2 * G * FROUDE) * jnp.asarray([1.0, 1.5, 2.0]),
        friction_drag=1000.0 * mass,
    )
    tilted = jnp.asarray(couples) * (1 + gait[1] * jnp.linspace(-1.0, 1.0, 6))
    wave = actuation.muscle_torques(
        rod,
        tilted * jnp.sqrt(sum(c * c for c in couples) / jnp.sum(tilted**2)),
        period=PERIOD,
        wave_number=gait[0],
        direction=(0.0, 0.0, 1.0),
        ramp_up_time=PERIOD,
    )
    damping = jaxrod.exponential_damping(2e-3, 8e-3 / RADIUS**2)
    scene = jaxrod.make_scene(rod, jaxrod.gravity(), wave, ground, damping)
    return scene, state, PERIOD / 16000


def way(gait, periods=2):
    """Lengths moved in the last of some periods."""
    scene, state, dt = build(gait)
    first = (periods - 1) * 16000
    before = jaxrod.advance(scene, state, dt, first)
    after = jaxrod.advance(scene, before, dt, 16000, first=first)
    return jnp.linalg.norm(jnp.mean(after.positions - before.positions, 1)) / LENGTH


def run(share=1.0):
    """A replay, the lengths moved in the last period and PyElastica's."""
    scene, state, dt = build()
    n = int(4 * 40 * share) * 400
    states = jaxrod.rollout(scene, state, dt, n, 400)
    times = jaxrod.rollout_times(dt, n, 400)
    replay = jaxrod.viz.Replay.from_states(scene, states, times, title="Snake")
    moved = jnp.mean(states.positions[-1] - states.positions[-41], axis=1)
    return replay, float(jnp.linalg.norm(moved)) / LENGTH, 0.1590


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
    gait = jnp.asarray([2 * jnp.pi, 0.0])
    for _ in range(4):
        slope = jax.jacfwd(way)(gait)
        print(f"gait {gait}: {way(gait):.4f} in the second period, slope {slope}")
        gait = gait + 0.4 * slope / jnp.linalg.norm(slope)
