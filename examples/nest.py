"""A nest: rods laid into a cylinder, layer upon layer, fall and settle on each other.

What floor and wall bear in the end is their weight. Run it with
`python examples/nest.py`; how fast the nest of any size runs `benchmarks/nest_speed.py`
measures.
"""

import gallery
import jax
import jax.numpy as jnp

import jaxrod

N_ELEMENTS, LENGTH, RADIUS, WALL, PER_LAYER = 8, 0.1, 0.002, 0.08, 10
DENSITY, END = 1e3, 1.6  # [kg/m^3], [s]
NUMBER = "N that floor and wall bear in the end, and the weight"
LOOK = {"frame": -1, "azimuth": 30, "elevation": 35, "field": "speed [m/s]"}


def into_wall(point, radius):
    """Distance from the inside of a cylinder about the z axis [m]."""
    return radius - jnp.sqrt(point[0] ** 2 + point[1] ** 2 + 1e-12)


def rod_in_layer(number):
    """A rod of a layer of parallel ones, layers turned by the golden angle."""
    layer, place = jnp.divmod(number, PER_LAYER)
    c, s, aside = jnp.cos(2.4 * layer), jnp.sin(2.4 * layer), 0.008 * (place - 4.5)
    along = jnp.stack([c, s, 0.01 * jnp.sin(3.0 * number)])
    middle = jnp.stack([-aside * s, aside * c, (1.2 + 2.2 * layer) * RADIUS])
    shape = {"length": LENGTH, "radius": RADIUS, "direction": along}
    shape["start"] = middle - 0.5 * LENGTH * along
    return jaxrod.straight_rod(N_ELEMENTS, density=DENSITY, youngs_modulus=1e6, **shape)


def scene(rod):
    """A rod under gravity between floor and wall, in some air."""
    touch = {"stiffness": 5000.0, "damping": 1.0, "friction": 0.3}
    sides = jaxrod.signed_distance(into_wall, WALL), jaxrod.plane()
    effects = [jaxrod.contact(side, **touch) for side in sides]
    effects += [jaxrod.gravity(), jaxrod.exponential_damping(10.0)]
    return jaxrod.make_scene(rod, *effects)


def nest(n_rods=200):
    """The system, its state and a stable step."""
    rods, state = jax.vmap(rod_in_layer)(jnp.arange(n_rods))
    lists = jaxrod.neighbour_lists(skin=1.0, refresh_every=24)
    touch = {"stiffness": 50.0, "damping": 0.02, "friction": 0.3, "partners": 4}
    contact = jaxrod.crossing_contact("rods", **touch, lists=lists)
    scenes, state = {"rods": jax.vmap(scene)(rods)}, {"rods": state}
    system = jaxrod.make_system(scenes, contact, state=state)
    return system, state, jaxrod.stable_dt(system).dt


def build(n_rods=150):
    """The nest, its state and the time step."""
    system, state, dt = nest(n_rods)
    return system, state, float(dt)


def run(share=1.0):
    """A replay, the vertical force on all rods together, and their weight."""
    system, state, dt = build()
    every = int(END / dt / 120)
    n = int(120 * share) * every
    states = jaxrod.rollout(system, state, dt, n, every)
    times = jaxrod.rollout_times(dt, n, every)
    fields = {"speed [m/s]": jaxrod.viz.speed}
    shown = {"fields": fields, "forces": True, "title": "Nest"}
    replay = jaxrod.viz.Replay.from_states(system, states, times, **shown)
    # What rods do to each other adds up to nothing.
    late = replay.arrows[0].vectors[-len(times) // 4 :, :, 2]
    rods = system.members["rods"].rod
    mass = jnp.sum(rods.linear_density * rods.rest_lengths)
    return replay, float(late.sum(axis=1).mean()), float(9.81 * mass)


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
