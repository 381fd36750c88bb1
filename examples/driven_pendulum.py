"""A pendulum whose pivot is shaken: an upside-down rod stands up (Kapitza, 1951).

A slender, nearly rigid rod stands on a pivot that is driven up and down. The inverted
position is stable if amplitude x angular frequency > sqrt(2 g l), with l = 2/3 of the
length of a uniform rod. Run it with `python examples/driven_pendulum.py`.
"""

import math

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import schedules

LENGTH, AMPLITUDE, TILT = 0.3, 0.01, 0.1  # [m], [m], [rad]
CRITICAL = math.sqrt(2 * 9.81 * LENGTH * 2 / 3) / (2 * math.pi * AMPLITUDE)  # [Hz]


def simulate(frequency, seconds=1.5):
    """Largest tilt of the rod [rad], and the error of its energy balance [1]."""
    rod, state = jaxrod.straight_rod(
        3,
        length=LENGTH,
        radius=0.01,
        density=500.0,
        youngs_modulus=4e8,
        direction=(math.sin(TILT), 0.0, math.cos(TILT)),
        normal=(0.0, 1.0, 0.0),
    )
    # A cosine: the pivot begins at rest.
    shake = schedules.sine(
        (0.0, 0.0, AMPLITUDE), 1 / frequency, phase=0.25, mean=(0.0, 0.0, -AMPLITUDE)
    )
    pivot = jaxrod.driven(state, displacement=shake, axes="xz", free_to_turn=True)
    scene = jaxrod.make_scene(
        rod, pivot, jaxrod.gravity((0.0, 0.0, -9.81)), method=jaxrod.planar("zx")
    )
    dt = float(jaxrod.stable_dt(scene).dt)
    n = int(seconds / dt)
    records = jaxrod.rollout(scene, state, dt, n)

    def measured(state, time):
        now = scene.at(time)
        return now.total_energy(state), jaxrod.reactions(now, state)[0].power

    energy, power = jax.vmap(measured)(records, jaxrod.rollout_times(dt, n))
    work = dt * jnp.sum((power[1:] + power[:-1]) / 2)
    gap = jnp.abs(work - (energy[-1] - energy[0])) / jnp.ptp(energy)
    along = records.tip - records.positions[:, :, 0]
    return jnp.max(jnp.abs(jnp.arctan2(along[:, 0], along[:, 2]))), gap


if __name__ == "__main__":
    jaxrod.configure_cpu()
    for share in (0.5, 2.0):
        lean, gap = simulate(share * CRITICAL)
        print(f"{share} x critical: leans {lean:.2f} rad; work off by {gap:.1e}")
