"""A custom body shape: a torus, on which a rod comes to rest.

Run it with `python examples/own_shape.py`; it writes a page.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.extend import pytree


@pytree
class Torus(jaxrod.shapes.Body):
    """A ring of circular section around the z axis."""

    radius: jax.Array  # of the circle at the middle of the section [m]
    thickness: jax.Array  # radius of the section [m]

    def surface(self, points):
        """Distance from the circle minus the thickness, and its gradient."""
        x, y, z = points
        from_axis = jnp.sqrt(x * x + y * y + 1e-12)
        outwards = from_axis - self.radius
        distance = jnp.sqrt(outwards * outwards + z * z + 1e-12)
        share = outwards / (distance * from_axis)
        return distance - self.thickness, (share * x, share * y, z / distance)

    def mesh(self):
        """Triangles for pictures; without them the surface would be searched."""
        along, around = np.meshgrid(np.arange(60), np.arange(20), indexing="ij")
        a, b = np.pi * along / 30, np.pi * around / 10
        r = float(self.radius) + float(self.thickness) * np.cos(b)
        z = float(self.thickness) * np.sin(b)
        corners = np.stack([r * np.cos(a), r * np.sin(a), z], axis=-1).reshape(-1, 3)
        at = lambda i, k: 20 * ((along + i) % 60) + (around + k) % 20
        one = np.stack([at(0, 0), at(1, 0), at(1, 1)], axis=-1)
        two = np.stack([at(0, 0), at(1, 1), at(0, 1)], axis=-1)
        return corners, np.concatenate([one, two]).reshape(-1, 3)


def laid(seconds=0.4):
    """A scene, the states of a rod released above the ring, and their times."""
    material = {"radius": 0.008, "density": 1000.0, "youngs_modulus": 2e7}
    place = {"start": (-0.25, 0.0, 0.04), "direction": (1.0, 0.0, 0.0)}
    rod, state = jaxrod.straight_rod(30, length=0.5, **place, **material)
    ring = jaxrod.contact(Torus(0.15, 0.02), stiffness=3e4)
    effects = (jaxrod.gravity(), jaxrod.exponential_damping(20.0), ring)
    scene = jaxrod.make_scene(rod, *effects)
    dt = float(jaxrod.stable_dt(scene).dt)
    steps = 50 * int(seconds / (50 * dt))
    every = steps // 50
    states = jaxrod.rollout(scene, state, dt, steps, every=every)
    return scene, states, jaxrod.rollout_times(dt, steps, every=every)


if __name__ == "__main__":
    jaxrod.configure_cpu()
    jaxrod.viz.show(*laid(), "own_shape.html", title="A rod on a torus")
