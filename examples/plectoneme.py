"""A twisted rope winds around itself: twist becomes writhe, and their sum is constant.

One end is turned and then moved towards the other; Lk = Tw + Wr (Calugareanu, White,
Fuller). Run it with `python examples/plectoneme.py`.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import schedules, systems, topology

N, LENGTH, RADIUS, TURNS = 48, 1.0, 0.011, 5.0  # [1], [m], [m], [1]
TWISTING, SHORTENING, REST = 3.0, 4.0, 1.0  # [s]
NUMBER = "sum of twist and writhe, and turns of the end"
LOOK = {"frame": -1, "azimuth": -75, "elevation": 18, "field": "bending [1/m]"}


def build():
    """The rope between its ends, its state and the time step."""
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    ahead = jnp.asarray([1.0, 0.0, 0.0])
    nearer = schedules.ramp(0 * ahead, -0.45 * ahead, SHORTENING, start=TWISTING)
    turn = schedules.ramp(0.0, 2 * jnp.pi * TURNS, TWISTING)
    moved = jaxrod.driven(state, "tip", displacement=nearer, axis=ahead, angle=turn)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        moved,
        jaxrod.gravity((0.0, 0.0, -0.2)),  # chooses where it buckles to
        jaxrod.exponential_damping(4.0),
    )
    touch = systems.rod_contact("rope", stiffness=6e5, damping=40.0, self_contact=True)
    system = jaxrod.make_system({"rope": scene}, touch)
    return system, {"rope": state}, 0.9 * float(jaxrod.stable_dt(system).dt)


def link(positions, directors, turned):
    """Twist and writhe [1] of the rope, extended into the walls at its ends."""
    step = jnp.asarray([LENGTH / N, 0.0, 0.0])
    ends = positions[:, :1] - step[:, None], positions[:, -1:] + step[:, None]
    curve = jnp.concatenate([ends[0], positions, ends[1]], axis=1)
    wall = jnp.asarray([0.0, 0.0, 1.0])
    far = jnp.stack([0 * turned, -jnp.sin(turned), jnp.cos(turned)])
    normals = jnp.concatenate([wall[:, None], directors[0], far[:, None]], axis=1)
    writhe = topology.writhe(curve, ends="next_tangent", extension=50.0)
    return topology.twist(curve, normals), writhe


def run(share=1.0):
    """A replay, the final sum of twist and writhe, and the applied turns."""
    system, state, dt = build()
    every = int(share * (TWISTING + SHORTENING + REST) / dt / 160)
    states = jaxrod.rollout(system, state, dt, 160 * every, every)
    times = jaxrod.rollout_times(dt, 160 * every, every)
    turned = 2 * jnp.pi * TURNS * jnp.clip(times / TWISTING, 0, 1)
    frames = jax.vmap(lambda state: state.directors)(states["rope"])
    twist, writhe = jax.vmap(link)(states["rope"].positions, frames, turned)
    replay = jaxrod.viz.Replay.from_states(
        system,
        states,
        times,
        fields={"bending [1/m]": jaxrod.viz.bending},
        readouts={"twist": twist, "writhe": writhe},
        title="Plectoneme",
    )
    return replay, float(twist[-1] + writhe[-1]), float(turned[-1] / (2 * jnp.pi))


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
