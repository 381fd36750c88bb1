"""A pendulum whose pivot is shaken: an upside-down rod stands up (Kapitza, 1951).

Upright is stable if amplitude x angular frequency > sqrt(2 g l), with l = 2/3 of the
length of a uniform rod. At s times that frequency the rod swings slowly about it with
the angular frequency sqrt((s^2 - 1) g / l).
"""

import math

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import schedules

LENGTH, AMPLITUDE, TILT, SHARE = 0.3, 0.01, 0.1, 2.0  # [m], [m], [rad], [1]
CRITICAL = math.sqrt(2 * 9.81 * LENGTH * 2 / 3) / (2 * math.pi * AMPLITUDE)  # [Hz]
NUMBER = "swings per second about the upright, and those of an averaged pivot [Hz]"
LOOK = {"frame": (-1, 30, 36, 42), "azimuth": -90, "elevation": 8}


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
    gravity = jaxrod.gravity((0.0, 0.0, -9.81))
    scene = jaxrod.make_scene(rod, pivot, gravity, method=jaxrod.planar("zx"))
    return scene, state, float(jaxrod.stable_dt(scene).dt)


def simulate(share, seconds=1.5):
    """Tilt of the rod over time [rad], and the error of its energy balance [1]."""
    scene, state, dt = build(share)
    n = int(seconds / dt)
    records = jaxrod.rollout(scene, state, dt, n)

    def measured(state, time):
        now = scene.at(time)
        return now.total_energy(state), jaxrod.reactions(now, state)[0].power

    energy, power = jax.vmap(measured)(records, jaxrod.rollout_times(dt, n))
    work = dt * jnp.sum((power[1:] + power[:-1]) / 2)
    gap = jnp.abs(work - (energy[-1] - energy[0])) / jnp.ptp(energy)
    x, _, z = jnp.moveaxis(records.tip - records.positions[:, :, 0], 1, 0)
    return jnp.arctan2(x, z), gap


def run(share=1.0):
    """A replay, the measured slow frequency, and that of an averaged pivot."""
    scene, state, dt = build()
    n, every = int(1.5 * share / dt), int(1.5 / dt / 240)
    states = jaxrod.rollout(scene, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    replay = jaxrod.viz.Replay.from_states(scene, states, times, title="Pendulum")
    tilt, _ = simulate(SHARE)
    shake = round(1 / (SHARE * CRITICAL) / dt)  # averaged out
    slow = jnp.convolve(tilt, jnp.ones(shake) / shake, mode="valid")
    upright = jnp.nonzero(slow[1:] * slow[:-1] < 0)[0]
    measured = (len(upright) - 1) / 2 / (float(upright[-1] - upright[0]) * dt)
    slowly = math.sqrt((SHARE**2 - 1) * 9.81 / (LENGTH * 2 / 3)) / (2 * math.pi)
    return replay, measured, slowly


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
    for share in (0.5, 2.0):
        tilt, _ = simulate(share)
        print(f"{share} x critical: leans {float(jnp.max(jnp.abs(tilt))):.2f} rad")
