"""A pendulum whose pivot is shaken: an upside-down rod stands up (Kapitza, 1951).

The upright position is stable if amplitude x angular frequency > sqrt(2 g l), with
l = 2/3 of the length of a uniform rod. The pivot's work changes the rod's energy.
"""

import math

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import schedules

LENGTH, AMPLITUDE, TILT, SHARE = 0.3, 0.01, 0.1, 2.0  # [m], [m], [rad], [1]
CRITICAL = math.sqrt(2 * 9.81 * LENGTH * 2 / 3) / (2 * math.pi * AMPLITUDE)  # [Hz]
NUMBER = "growth of the energy, and work of the pivot [J]"
LOOK = {"frame": (0, 42), "azimuth": -90, "elevation": 8, "zoom": 0.85}


def build(share=SHARE):
    """The rod on its pivot, its state and the time step."""
    rod, state = jaxrod.straight_rod(
        3,
        length=LENGTH,
        radius=0.01,
        density=500.0,
        youngs_modulus=4e8,
        direction=(math.sin(TILT), 0.0, math.cos(TILT)),
        normal=(0.0, 1.0, 0.0),
    )
    up = jnp.asarray([0.0, 0.0, AMPLITUDE])
    # A cosine: the pivot begins at rest.
    shake = schedules.sine(up, 1 / (share * CRITICAL), phase=0.25, mean=-up)
    pivot = jaxrod.driven(state, displacement=shake, axes="xz", free_to_turn=True)
    scene = jaxrod.make_scene(rod, pivot, jaxrod.gravity(), method=jaxrod.planar("zx"))
    return scene, state, float(jaxrod.stable_dt(scene).dt)


def simulate(share, seconds=1.5):
    """Tilt [rad], energy and work of the pivot over time [J]."""
    scene, state, dt = build(share)
    n = int(seconds / dt)
    records = jaxrod.rollout(scene, state, dt, n)

    def measured(state, time):
        now = scene.at(time)
        return now.total_energy(state), jaxrod.reactions(now, state)[0].power

    energy, power = jax.vmap(measured)(records, jaxrod.rollout_times(dt, n))
    work = dt * jnp.cumsum(jnp.append(0.0, (power[1:] + power[:-1]) / 2))
    x, _, z = jnp.moveaxis(records.tip - records.positions[:, :, 0], 1, 0)
    return jnp.arctan2(x, z), energy, work


def run(share=1.0):
    """A replay, the largest growth of energy, and the work of the pivot until then."""
    scene, state, dt = build()
    every = int(1.5 / dt / 240)
    n = int(240 * share) * every
    states = jaxrod.rollout(scene, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    pivot = jaxrod.viz.Sphere(states.positions[:, :, 0], 0.016, "pivot")
    shown = {"spheres": [pivot], "title": "Upside-down pendulum"}
    replay = jaxrod.viz.Replay.from_states(scene, states, times, **shown)
    _, energy, work = simulate(SHARE)
    most = jnp.argmax(energy)
    return replay, float(energy[most] - energy[0]), float(work[most])


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
    for share in (0.5, 2.0):
        largest = float(jnp.max(jnp.abs(simulate(share)[0])))
        print(f"{share} x critical: leans {largest:.2f} rad")
