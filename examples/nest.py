"""A nest: rods laid into a cylinder in layers, settling on each other under gravity.

Every crossing counts once, however long the elements are for their radius, and only
elements on lists of neighbours are looked at. Run it with `python examples/nest.py`,
or with a number of rods.
"""

import sys
import time

import jax
import jax.numpy as jnp

import jaxrod

N_ELEMENTS, LENGTH, RADIUS = 8, 0.1, 0.002  # [1], [m], [m]
WALL, PER_LAYER = 0.08, 10  # [m], [1]


def into_wall(point, radius):
    """Distance from the inside of a cylinder about the z axis [m]."""
    return radius - jnp.sqrt(point[0] ** 2 + point[1] ** 2 + 1e-12)


def rod_in_layer(number):
    """A rod of a layer of parallel ones, layers turned by the golden angle."""
    layer, place = number // PER_LAYER, number % PER_LAYER
    angle, aside = 2.4 * layer, (place - 0.5 * (PER_LAYER - 1)) * 4 * RADIUS
    along = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.01 * jnp.sin(3.0 * number)])
    across = jnp.stack([-jnp.sin(angle), jnp.cos(angle), jnp.zeros(())])
    up = jnp.stack([jnp.zeros(()), jnp.zeros(()), (1.2 + 2.2 * layer) * RADIUS])
    start = aside * across - 0.5 * LENGTH * along + up
    material = {"radius": RADIUS, "density": 1000.0, "youngs_modulus": 1e6}
    return jaxrod.straight_rod(
        N_ELEMENTS, length=LENGTH, start=start, direction=along, **material
    )


def scene(rod):
    """A rod under gravity between floor and wall, in some air."""
    touch = {"stiffness": 5000.0, "damping": 1.0, "friction": 0.3}
    wall = jaxrod.contact(jaxrod.signed_distance(into_wall, WALL), **touch)
    floor = jaxrod.contact(jaxrod.plane(), **touch)
    air = jaxrod.exponential_damping(10.0)
    return jaxrod.make_scene(rod, jaxrod.gravity(), wall, floor, air)


def nest(n_rods=200):
    """The system, its state and a stable step."""
    rods, state = jax.vmap(rod_in_layer)(jnp.arange(n_rods))
    lists = jaxrod.neighbour_lists(skin=1.0, refresh_every=24)
    touch = {"stiffness": 50.0, "damping": 0.02, "friction": 0.3, "lists": lists}
    contact = jaxrod.crossing_contact("rods", partners=4, **touch)
    members, states = {"rods": jax.vmap(scene)(rods)}, {"rods": state}
    system = jaxrod.make_system(members, contact, state=states)
    return system, states, float(jaxrod.stable_dt(system).dt)


if __name__ == "__main__":
    jaxrod.configure_cpu()
    system, state, dt = nest(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
    for _ in range(5):
        begin = time.perf_counter()
        state = jax.block_until_ready(jaxrod.advance(system, state, dt, 500))
        seconds = time.perf_counter() - begin
        (near,) = jaxrod.neighbours(system, state)
        print(f"{500 / seconds:.0f} steps/s, {near.pairs[0]} pairs listed")
    print("flagged:", bool(jaxrod.health(system, state, dt).flagged))
