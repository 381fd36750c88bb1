"""A nest: rods laid into a cylinder in layers settle. `python examples/nest.py 500`."""

import sys
import time

import jax
import jax.numpy as jnp

import jaxrod

N_ELEMENTS, LENGTH, RADIUS, WALL, PER_LAYER = 8, 0.1, 0.002, 0.08, 10


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
    return jaxrod.straight_rod(N_ELEMENTS, density=1e3, youngs_modulus=1e6, **shape)


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


if __name__ == "__main__":
    jaxrod.configure_cpu()
    system, state, dt = nest(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
    for _ in range(5):
        begin = time.perf_counter()
        state = jax.block_until_ready(jaxrod.advance(system, state, dt, 500))
        took = time.perf_counter() - begin
        print(f"{500 / took:.0f} steps/s, {state['neighbours'].used:.0f} pairs listed")
    print("flagged:", bool(jaxrod.health(system, state, dt).flagged))
