"""A carpet of magnetic cilia that beats in a wave, as a magnet turns below.

Magnetisation turns from column to column, so in a common rotating field the cilia
beat one after another. In a weak transverse field, the force F = m B at the tip of an
upright cilium deflects it by F L^3 / 3EI. Run it with `python examples/cilia.py`.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, fluids, schedules

N, LENGTH, RADIUS, YOUNG = 8, 6e-3, 2.5e-4, 2e5  # [1], [m], [m], [Pa]
COLUMNS, ROWS, GAP, PERIOD = 9, 4, 4e-3, 0.5  # [1], [1], [m], [s]
MOMENT, FIELD = 6e-3, 0.02  # per length [A m], [T]
NUMBER = "deflection over length in a weak field, and F L^2 / 3EI"
LOOK = {"frame": -10, "azimuth": -62, "elevation": 24, "field": "speed [m/s]"}


def cilium(place, angle, field):
    """One cilium, magnetised at an angle to its axis, and its state."""
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1200.0,
        youngs_modulus=YOUNG,
        start=place,
        direction=(0.0, 0.0, 1.0),
        normal=(1.0, 0.0, 0.0),
    )
    moment = MOMENT * jnp.stack([jnp.sin(angle), 0.0 * angle, jnp.cos(angle)])
    magnet = actuation.magnetisation(rod, moment, field)
    drag = fluids.stokes_drag(*fluids.slender_cylinder(0.05, LENGTH, RADIUS))
    return jaxrod.make_scene(rod, jaxrod.clamp(state), magnet, drag), state


def build():
    """The carpet, its state and the time step."""
    across, along = jnp.meshgrid(jnp.arange(COLUMNS), jnp.arange(ROWS))
    places = GAP * jnp.stack([1.7 * across, along, 0 * across], -1).reshape(-1, 3)
    angles = 2 * jnp.pi * across.ravel() / COLUMNS
    times = jnp.linspace(0.0, 4 * PERIOD, 129)
    turn = 2 * jnp.pi * times / PERIOD
    size = FIELD * jnp.clip(times / PERIOD, 0, 1)
    field = size[:, None] * jnp.stack([jnp.cos(turn), 0 * turn, jnp.sin(turn)], axis=-1)
    made = lambda place, angle: cilium(place, angle, schedules.table(times, field))
    cilia, states = jax.vmap(made)(places, angles)
    system = jaxrod.make_system({"cilia": cilia})
    return system, {"cilia": states}, 0.9 * float(jaxrod.stable_dt(system).dt)


def weak():
    """Deflection of one cilium in a weak transverse field, and the closed form [1]."""
    scene, state = cilium(jnp.zeros(3), jnp.zeros(()), (1e-4, 0.0, 0.0))
    bent = jaxrod.equilibrium(scene, state).state
    stiffness = YOUNG * jnp.pi * RADIUS**4 / 4
    return bent.tip[0] / LENGTH, MOMENT * 1e-4 * LENGTH**2 / (3 * stiffness)


def run(share=1.0):
    """A replay of four turns of the magnet, and both deflections in a weak field."""
    system, state, dt = build()
    every = max(1, int(4 * PERIOD / dt / 120))
    n = int(120 * share) * every
    states = jaxrod.rollout(system, state, dt, n, every)
    times, fields = (
        jaxrod.rollout_times(dt, n, every),
        {"speed [m/s]": jaxrod.viz.speed},
    )
    show = jaxrod.viz.Replay.from_states
    replay = show(system, states, times, fields=fields, title="Cilia")
    measured, reference = weak()
    return replay, float(measured), float(reference)


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
