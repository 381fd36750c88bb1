"""An octopus: eight soft arms on a rigid head, curled by muscles along them.

All arms are one member of a system. A joint attaches them to the head. Muscles on the
lower side of each arm contract. The animal is free, so its momentum stays zero.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, schedules, shapes, systems

N_ARMS, N_ELEMENTS, LENGTH, HEAD = 8, 12, 0.2, 0.03  # [1], [1], [m], [m]
NUMBER = "drift of the centre of mass in a second, in arm lengths, and zero"
LOOK = {"frame": 44, "azimuth": 25, "elevation": 22}


def arm(angle):
    """A tapered arm at the side of the head, with its muscle, and its state."""
    outwards = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(())])
    rod, state = jaxrod.straight_rod(
        N_ELEMENTS,
        length=LENGTH,
        radius=(0.012, 0.003),
        density=1050.0,
        youngs_modulus=2e4,
        start=HEAD * outwards,
        direction=outwards,
        normal=(0.0, 0.0, 1.0),
    )
    # Full force where the arm is thick, on the lower side, within half a second.
    force = 4e3 * jnp.pi * rod.radii**2
    contraction = schedules.ramp(0.0, 0.25, 0.5)
    offset = jnp.stack([-0.5 * jnp.mean(rod.radii), jnp.zeros(())])
    muscle = actuation.muscle(rod, force[None], contraction, offsets=offset[None])
    return jaxrod.make_scene(rod, muscle, jaxrod.internal_damping(2e-3)), state


def octopus():
    """The animal and its state at rest."""
    angles = 2 * jnp.pi * jnp.arange(N_ARMS) / N_ARMS
    arms, of_arms = jax.vmap(arm)(angles)
    head, of_head = systems.rigid_body(shapes.sphere((0, 0, 0), HEAD), density=1050.0)
    state = {"arms": of_arms, "head": of_head}
    roots = [("arms", k, "base") for k in range(N_ARMS)]
    together = systems.attach(roots, ("head",), state)
    return jaxrod.make_system({"arms": arms, "head": head}, together), state


def curl(seconds=1.0):
    """The state after a while, and the system."""
    system, state = octopus()
    dt = float(jaxrod.stable_dt(system).dt)
    return system, jaxrod.advance(system, state, dt, int(seconds / dt)), dt


def build():
    """The animal, its state and the time step."""
    system, state = octopus()
    return system, state, float(jaxrod.stable_dt(system).dt)


def run(share=1.0):
    """A replay of one second, the drift of the animal in arm lengths, and zero."""
    system, state, dt = build()
    every = max(1, int(1.0 / dt / 60))
    n = int(60 * share) * every
    states = jaxrod.rollout(system, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    replay = jaxrod.viz.Replay.from_states(system, states, times, title="Octopus")
    mass = jnp.sum(system.members["head"].masses)
    mass += jnp.sum(system.members["arms"].rod.linear_density) * LENGTH / N_ELEMENTS
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    speed = jnp.linalg.norm(system.momentum(last)) / mass
    return replay, float(speed * n * dt / LENGTH), 0.0


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
