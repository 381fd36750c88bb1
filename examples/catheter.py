"""A catheter: a rod is pushed through a curved vessel, which is a mesh of triangles."""

import gallery
import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod import shapes

N_ELEMENTS, LENGTH, RADIUS = 40, 0.16, 0.001
LUMEN, BEND, STRAIGHT = 0.0025, 0.05, 0.17  # radii of vessel and bend, way to it [m]
MODULUS, SPEED, END = 1e9, 0.1, 1.2  # [Pa], [m/s], [s]
NUMBER = "energy per metre of push, and per metre of a bent rod [J/m]"
LOOK = {"frame": -1, "azimuth": 20, "elevation": 30, "field": "bending [1/m]"}


def vessel(rings=81, around=32):
    """Vertices and triangles of a tube: a straight part, then an arc."""
    way = np.linspace(-0.01, STRAIGHT + 2.9 * BEND, rings)
    # The first and the last ring are points, which close the tube.
    way, radii = np.pad(way, 1, "edge")[:, None], np.pad(np.full(rings, LUMEN), 1)
    turn = np.maximum(way - STRAIGHT, 0) / BEND
    angle = 2 * np.pi * np.arange(around) / around
    aside, up = radii[:, None] * np.cos(angle), radii[:, None] * np.sin(angle)
    x = np.minimum(way, STRAIGHT) + (BEND - aside) * np.sin(turn)
    y = BEND - (BEND - aside) * np.cos(turn)
    k, i = np.divmod(np.arange((rings + 1) * around), around)
    a, b = around * k + i, around * k + (i + 1) % around
    faces = [
        np.stack([a, b + around, b], -1),
        np.stack([a, a + around, b + around], -1),
    ]
    return np.stack([x, y, up], axis=-1).reshape(-1, 3), np.concatenate(faces)


def build():
    """The scene, its state and the time step."""
    material = {"radius": RADIUS, "density": 1200.0, "youngs_modulus": MODULUS}
    rod, state = jaxrod.straight_rod(
        N_ELEMENTS, length=LENGTH, direction=(1.0, 0.0, 0.0), **material
    )
    way = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (SPEED * END, 0.0, 0.0), END)
    push = jaxrod.driven(state, displacement=way)
    wall = shapes.from_mesh(*vessel(), spacing=RADIUS, margin=2 * RADIUS).complement()
    touch = jaxrod.contact(wall, stiffness=1e7, damping=3.0)
    scene = jaxrod.make_scene(rod, push, jaxrod.exponential_damping(50.0), touch)
    return scene, state, float(jaxrod.stable_dt(scene).dt)


def run(share=1.0):
    """A replay, the growth of energy per way, and that of a rod bent as the vessel."""
    scene, state, dt = build()
    every = int(END / dt / 240)
    n = int(240 * share) * every
    states = jaxrod.rollout(scene, state, dt, n, every)
    times = jnp.asarray(jaxrod.rollout_times(dt, n, every))
    energy = lambda state, time: scene.at(time).total_energy(state)
    energies = jax.vmap(energy)(states, times)
    # From half of the way on, the tip moves along the bend, and the bent part grows.
    half = len(times) // 2
    gained = (energies[-1] - energies[half]) / (SPEED * (times[-1] - times[half]))
    # There it rests on the inner side.
    bend = BEND - LUMEN + RADIUS
    theory = MODULUS * np.pi * RADIUS**4 / 4 / (2 * bend**2)
    # Drawn without its upper half, so that one sees the catheter.
    vertices, faces = vessel()
    lower = faces[np.max(vertices[faces, 2], axis=1) < 1e-9]
    shown = {"fields": {"bending [1/m]": jaxrod.viz.bending}, "title": "Catheter"}
    shown["meshes"] = [
        jaxrod.viz.Mesh(vertices, lower, name="vessel", colour="#e3a59b")
    ]
    bare = jaxrod.make_scene(scene.rod, *scene.effects[:2])
    replay = jaxrod.viz.Replay.from_states(bare, states, times, **shown)
    return replay, float(gained), theory


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)
