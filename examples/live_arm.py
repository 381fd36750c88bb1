"""A tendon arm in the browser: pull on it, pull its tendons, or let it follow a ball.

Run it with `python examples/live_arm.py` and open the address that it prints. With the
gain above zero, tensions of the four tendons rise with the distance of the tip from the
ball. Ctrl-C ends it.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod import actuation, viz

LENGTH, RADIUS, OFFSET = 0.25, 0.008, 0.007  # [m]
WAYS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def build():
    """The arm with slack tendons, and its state."""
    rod, state = jaxrod.straight_rod(
        20,
        length=LENGTH,
        radius=RADIUS,
        density=1100.0,
        youngs_modulus=1e6,
        direction=(0.0, 0.0, 1.0),
        normal=(1.0, 0.0, 0.0),
    )
    tendons = actuation.tendon(rod, OFFSET * WAYS, tension=jnp.zeros(4))
    effects = jaxrod.clamp(state), tendons, jaxrod.exponential_damping(12.0)
    return jaxrod.make_scene(rod, *effects), state


def follow(scene, state, values):
    """The scene with tensions that pull the tip towards the ball, up to 4 N more."""
    way = values["goal"][:2] - state.tip[:2]
    more = jnp.clip(values["gain [N/m]"] * (WAYS @ way), 0.0, 4.0)
    wall, tendons, damping = scene.effects
    pulled = replace(tendons, tension=tendons.tension + more)
    return replace(scene, effects=(wall, pulled, damping))


def controls():
    """Sliders for a tendon along x, one along y and the gain; and the ball."""
    return {
        "tension along x [N]": viz.Slider(lambda s: s.effects[1].tension[0], 0.0, 4.0),
        "tension along y [N]": viz.Slider(lambda s: s.effects[1].tension[1], 0.0, 4.0),
        "gain [N/m]": viz.Slider(None, 0.0, 100.0),
        "goal": viz.Target(None, radius=0.01, start=(0.08, 0.05, 0.22)),
    }


if __name__ == "__main__":
    jaxrod.configure_cpu()
    page = viz.live(*build(), controls(), law=follow, title="Tendon arm", floor=0.0)
    page.wait()
