"""A race of flagella in a viscous fluid: the steeper wave swims faster.

A bending wave with a tangent amplitude of a runs along each rod. Resistive-force theory
gives the speed of an infinite wave over its wave speed, 1 / (1 + (q - 1) <sin^2>) - 1,
with the ratio q of drag across and along. Run it with `python examples/flagella.py`.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, fluids

jax.config.update("jax_enable_x64", True)  # steps are a billionth of the length

N, LENGTH, RADIUS, WAVES, PERIOD = 48, 0.06, 5e-4, 4, 1.0  # [1], [m], [m], [1], [s]
ANGLES = (0.2, 0.36, 0.52, 0.68, 0.84, 1.0)  # [rad]
VISCOSITY, YOUNG = 0.5, 2e6  # [Pa s], [Pa]
NUMBER = "lengths that the steepest wave and an endless one swim in a period"
LOOK = {"frame": -1, "azimuth": -70, "elevation": 48, "field": "speed [m/s]"}


def swimmer(lane, angle):
    """One flagellum: its scene and its state."""
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=YOUNG,
        start=jnp.stack([0.0 * lane, 0.012 * lane, 0.0 * lane]),
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    stiffness = rod.bend_twist_stiffness[0, 0]
    couple = stiffness * angle * 2 * jnp.pi * WAVES / LENGTH
    wave = actuation.travelling_wave(
        rod, couple, period=PERIOD, wavelength=LENGTH / WAVES, ramp_up=PERIOD / 2
    )
    along, across, turning = fluids.slender_cylinder(VISCOSITY, LENGTH, RADIUS)
    fluid = fluids.stokes_drag(along, across, turning)
    return jaxrod.make_scene(rod, wave, fluid), state


def build():
    """All flagella as one member, their states and the time step."""
    lanes = jnp.arange(float(len(ANGLES)))
    scenes, states = jax.vmap(swimmer)(lanes, jnp.asarray(ANGLES))
    system = jaxrod.make_system({"flagella": scenes})
    return system, {"flagella": states}, 0.9 * float(jaxrod.stable_dt(system).dt)


def endless(angle):
    """Lengths per period that an infinite wave of the same kind swims [1]."""
    phase = 2 * jnp.pi * jnp.arange(64) / 64
    along, across, _ = fluids.slender_cylinder(VISCOSITY, LENGTH, RADIUS)
    sines = jnp.mean(jnp.sin(angle * jnp.sin(phase)) ** 2)
    wave = jnp.mean(jnp.cos(angle * jnp.sin(phase))) / WAVES
    return wave * (1 - 1 / (1 + (across / along - 1) * sines))


def run(share=1.0):
    """A replay, the lengths swum in the last period, and those of an infinite wave."""
    system, state, dt = build()
    every = int(PERIOD / dt / 40)
    n = int(120 * share) * every
    states = jaxrod.rollout(system, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    fields = {"speed [m/s]": jaxrod.viz.speed}
    show = jaxrod.viz.Replay.from_states
    replay = show(system, states, times, fields=fields, title="Flagella")
    middle = jnp.mean(states["flagella"].positions[:, -1, 0], axis=-1)
    swum = jnp.abs(middle[-1] - middle[-41]) / LENGTH * PERIOD / (40 * every * dt)
    return replay, float(swum), float(endless(ANGLES[-1]))


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
