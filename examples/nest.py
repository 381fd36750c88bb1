"""A nest: rods laid into a cylinder, layer upon layer, fall and settle on each other.

`python -m benchmarks nest_speed` measures its speed.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import shapes, systems

N_ELEMENTS, LENGTH, RADIUS, WALL, PER_LAYER = 8, 0.1, 0.002, 0.08, 10
DENSITY, END = 1e3, 2.0  # [kg/m^3], [s]
NUMBER = "deepest contact at the end in radii, and zero"
LOOK = {"frame": -1, "azimuth": 30, "elevation": 68, "field": "height [m]"}


def into_wall(point, radius):
    """Distance from the inner surface of a cylinder about the z axis [m]."""
    return radius - jnp.sqrt(point[0] ** 2 + point[1] ** 2 + 1e-12)


def rod_in_layer(number):
    """A rod in a layer of parallel rods; layers are rotated by the golden angle."""
    layer, place = jnp.divmod(number, PER_LAYER)
    c, s, aside = jnp.cos(2.4 * layer), jnp.sin(2.4 * layer), 0.008 * (place - 4.5)
    along = jnp.stack([c, s, 0.01 * jnp.sin(3.0 * number)])
    middle = jnp.stack([-aside * s, aside * c, (1.2 + 2.2 * layer) * RADIUS])
    shape = {"length": LENGTH, "radius": RADIUS, "direction": along}
    shape["start"] = middle - 0.5 * LENGTH * along
    return jaxrod.straight_rod(N_ELEMENTS, density=DENSITY, youngs_modulus=1e6, **shape)


def scene(rod):
    """A rod under gravity between floor and wall, with air drag."""
    touch = {"stiffness": 2e4, "damping": 1.0, "friction": 0.3}
    sides = shapes.signed_distance(into_wall, WALL), shapes.plane()
    effects = [jaxrod.contact(side, **touch) for side in sides]
    effects += [jaxrod.gravity(), jaxrod.exponential_damping(10.0)]
    return jaxrod.make_scene(rod, *effects)


def nest(n_rods=200):
    """The system, its state and a stable step."""
    rods, state = jax.vmap(rod_in_layer)(jnp.arange(n_rods))
    # For the nest that it becomes, which is denser than what is laid in.
    room = {"pairs": 80 * n_rods, "candidates": 320 * n_rods}
    lists = systems.neighbour_lists(skin=1.0, refresh_every=10, **room)
    touch = {"stiffness": 1e3, "damping": 0.02, "friction": 0.3, "max_contacts": 4}
    contact = systems.crossing_contact("rods", **touch, lists=lists)
    scenes, state = {"rods": jax.vmap(scene)(rods)}, {"rods": state}
    system = jaxrod.make_system(scenes, contact, state=state)
    return system, state, jaxrod.stable_dt(system).dt


def build(n_rods=150):
    """The nest, its state and the time step."""
    system, state, dt = nest(n_rods)
    return system, state, float(dt)


def run(share=1.0):
    """A replay, and the final penetration depth of the rods."""
    system, state, dt = build()
    every = int(END / dt / 120)
    n = int(120 * share) * every
    states = jaxrod.rollout(system, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    height = lambda scene, rod: rod.positions[2]
    shown = {"fields": {"height [m]": height}, "title": "Nest"}
    replay = jaxrod.viz.Replay.from_states(system, states, times, **shown)
    health = jaxrod.health(system, jax.tree.map(lambda x: x[-1], states), dt)
    # Not a number where a contact may have been missed, or anything else is wrong.
    deepest = jnp.where(health.flagged, jnp.nan, health.largest_violation)
    return replay, float(deepest), 0.0


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
