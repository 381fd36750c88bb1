"""An overhand knot: without friction, B kappa^2 / 2 + tension equals the pull."""

import gallery
import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod import systems

N, RADIUS, LOOP = 160, 0.005, 0.1  # [1], [m], [m]
NUMBER = "B kappa^2 / 2 + tension at the top of the loop, and the pull [N]"
LOOK = {"frame": -1, "azimuth": -80, "elevation": 40, "field": "bending [1/m]"}


def overhand(n, radius, loop, tail=4.0):
    """Nodes of a circle with two straight tails that wind around each other."""
    around, gap = 2 * np.pi * loop, 1.25 * radius
    s = np.linspace(-tail * loop, around + tail * loop, 20 * n)
    turn = np.clip(s / loop, 0, 2 * np.pi)
    x = loop * np.sin(turn) + np.minimum(s, 0) + np.maximum(s - around, 0)
    y, z = loop * (1 - np.cos(turn)), 0 * s
    half = 2.0 * np.sqrt(gap * loop)  # Length of the winding, one and a half turns.
    for u, side in ((s, 1), (around - s, -1)):
        angle = np.pi * (2.5 + 1.5 * np.tanh(u / half))
        size = gap * np.exp(-0.5 * np.maximum(np.abs(u) / half - 1, 0) ** 2)
        y, z = y + size * np.cos(angle), z + side * size * np.sin(angle)
    nodes = np.stack([x, y, z])
    for _ in range(5):  # Until all elements are of one length.
        along = np.append(0, np.cumsum(np.linalg.norm(np.diff(nodes), axis=0)))
        even = np.linspace(0, along[-1], n + 1)
        nodes = np.stack([np.interp(even, along, line) for line in nodes])
    return nodes


def build(n=N, radius=RADIUS, loop=LOOP, pull=1.0, friction=None):
    """The knot under `pull` times B / (2 R^2), its state and the time step."""
    material = {"radius": radius, "density": 1000.0, "youngs_modulus": 1e6}
    bent, state = jaxrod.rod_along(overhand(n, radius, loop), **material)
    rod, _ = jaxrod.straight_rod(n, length=float(bent.length), **material)
    bending, line = rod.bend_twist_stiffness[0, 0], rod.linear_density[0]
    force = jnp.asarray([pull * bending / (2 * loop**2), 0.0, 0.0])
    pulls = jaxrod.end_load(force), jaxrod.end_load(-force, end="base")
    slow = jaxrod.exponential_damping(0.6 * jnp.sqrt(bending / line) / loop**2)
    stiffness = 300.0 * bending / (loop * radius) ** 2
    law = {"damping": 0.1 * jnp.sqrt(stiffness * line), "friction": friction}
    scene, state = jaxrod.make_scene(rod, *pulls, slow), {"rope": state}
    law |= {"lists": systems.neighbour_lists(skin=1.0, refresh_every=8)}
    touch = systems.rod_contact("rope", stiffness=stiffness, self_contact=True, **law)
    system = jaxrod.make_system({"rope": scene}, touch, state=state)
    return system, state, float(jaxrod.stable_dt(system).dt)


def balance(system, state):
    """Stored energy per length plus tension in the middle, and B / (2 R^2) [N]."""
    rod = system.members["rope"].rod
    middle, rest = rod.n_elements // 2, rod.rest_lengths[0]
    edges = jnp.diff(state.positions)[:, middle - 1 : middle + 1] / rest
    bent = jnp.sum((edges[:, 1] - edges[:, 0]) ** 2) / rest**2
    stretch = jnp.mean(jnp.linalg.norm(edges, axis=0)) - 1
    bending, axial = rod.bend_twist_stiffness[0, 0], rod.shear_stretch_stiffness[2, 0]
    return 0.5 * bending * bent + axial * stretch, 0.5 * bending / LOOP**2


def run(share=1.0):
    """A replay of the knot as it settles, the balance at its top, and the pull."""
    system, state, dt = build()
    every = int(share * 5.0 / dt / 160)
    states = jaxrod.rollout(system, state, dt, 160 * every, every)
    times, shown = jaxrod.rollout_times(dt, 160 * every, every), {"title": "Knot"}
    shown["fields"] = {"bending [1/m]": jaxrod.viz.bending}
    replay = jaxrod.viz.Replay.from_states(system, states, times, **shown)
    late = jax.tree.map(lambda x: x[80:], states["rope"])  # It trembles: a mean.
    found, pull = jax.vmap(balance, in_axes=(None, 0))(system, late)
    return replay, float(jnp.mean(found)), float(pull[0])


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
