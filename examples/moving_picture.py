"""An arm that plans with itself chases a target: the moving picture of the README.

Every 22 ms one Gauss-Newton step through the simulation of the arm improves the plan
for the next 134 ms. The target turns at random. No policy was trained. Run it
with `python examples/moving_picture.py`; it writes docs/arm.gif.
"""

from pathlib import Path

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod.viz import Replay, Sphere, film

SECONDS, EVERY = 3.6, 36  # [s]; control steps from frame to frame
PICTURE = Path(__file__).parents[1] / "docs" / "arm.gif"


def chase(seconds):
    """Frames of an episode: nodes, target, radii, and the period."""
    env = jaxrod.envs.make("tracking", variant="clean", n_elements=20)
    params = env.default_params()
    steps = round(seconds / (EVERY * env.control_period)) * EVERY
    key = jax.random.key(4)

    @jax.jit
    def episode(start):
        look = lambda state: (state.arm.positions, state.target.position)
        policy = jaxrod.control.mpc(env, params)
        return jaxrod.envs.rollout(
            env, start, policy, params, steps, key=key, collect=look
        ).collected

    nodes, target = episode(env.reset(key, params))
    nodes = jnp.swapaxes(nodes[::EVERY], 1, 2)
    return nodes, target[::EVERY], params.arm.rod.radii, EVERY * env.control_period


if __name__ == "__main__":
    jaxrod.configure_cpu()
    nodes, target, radii, period = chase(SECONDS)
    away = jnp.linalg.norm(nodes[:, -1] - target, axis=-1)
    print(f"the tip is {1e3 * float(jnp.median(away)):.1f} mm off in the median")
    replay = Replay.from_nodes(
        nodes,
        radii,
        period * jnp.arange(len(nodes)),
        spheres=[Sphere(target, 0.04, "target")],
        up="y",
    )
    film(replay, PICTURE, width=480, height=360, speed=0.7, zoom=1.3, captions=False)
    print(PICTURE)
